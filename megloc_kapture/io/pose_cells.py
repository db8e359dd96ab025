"""A pose in one cell of a table: ``qw qx qy qz tx ty tz``, as pose files have it."""

from __future__ import annotations

import math
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.values import RigidTransform

_UNIT = 1e-6  # of the length of a quaternion that is written with every digit


def pose_cell(pose: RigidTransform | None) -> str:
    """Quaternion, w first, and translation; every digit, so that it reads back the same."""
    if pose is None:
        return ""
    return " ".join(repr(float(value)) for value in (*pose.quat_wxyz, *pose.translation))


def read_pose_cell(text: str, column: str, *, path: Path | str, line: int) -> RigidTransform | None:
    """The pose in a cell; None where it is empty.

    Raises
    ------
    DataError : it is no pose; names the column, the file and the line.
    """
    if not text:
        return None
    try:
        w, x, y, z, a, b, c = (float(value) for value in text.split(" "))
    except ValueError:
        raise DataError(
            f"{column} {text!r} is not qw qx qy qz tx ty tz", path=path, line=line
        ) from None
    if not math.isfinite(a + b + c) or not abs(math.hypot(w, x, y, z) - 1.0) < _UNIT:
        raise DataError(
            f"{column} {text!r} is no pose: a unit quaternion and a finite translation",
            path=path,
            line=line,
        )
    return RigidTransform((w, x, y, z), (a, b, c))
