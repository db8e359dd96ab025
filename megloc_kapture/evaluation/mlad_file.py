"""Pose files of the MLAD challenges (4Seasons): ``src_ts tgt_ts tx ty tz qx qy qz qw`` per pair.

The pose is ``query_from_reference`` of the rectified left cameras: ``x_query = R x_ref + t``.
The translation stands first and the quaternion's w last, unlike everywhere else here. A file has
the name of the relocalization file it answers, and every pair of that one; the relocalization
file has the same rows without poses, or, for training recordings, with the true ones.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.pose_file import checked_pose, parse_number
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.text import read_text
from megloc_kapture.values import RigidTransform

COLUMNS = "src_ts tgt_ts tx ty tz qx qy qz qw"
# as an int it must be written again as it is, so there is no leading zero
_TIMESTAMP = re.compile("0|[1-9][0-9]{0,29}")


@dataclass(frozen=True, slots=True)
class RelativePose:
    """One row: a pair of keyframes by their timestamps, and the pose where the row has one."""

    reference: int
    query: int
    query_from_reference: RigidTransform | None = None


def timestamp_of(image: str) -> int:
    """The timestamp that an image of 4Seasons is named after (``.../1600000000000000000.png``).

    Raises
    ------
    DataError : the name is no timestamp.
    """
    stem = PurePosixPath(image).stem
    if not _TIMESTAMP.fullmatch(stem):
        raise DataError(f"image {image!r} is not named after a timestamp, as MLAD's rows need")
    return int(stem)


def relative_pose(
    query_from_world: RigidTransform, reference_from_world: RigidTransform, *, scale: float = 1.0
) -> RigidTransform:
    """``query_from_reference`` of two cameras; ``scale`` is metres per unit of the world."""
    # taken in the local frame: from ECEF, millions of metres would have to cancel
    pose = query_from_world @ reference_from_world.inverse()
    if scale == 1.0:
        return pose
    x, y, z = (float(v) for v in scale * np.array(pose.translation))
    return RigidTransform(pose.quat_wxyz, (x, y, z))


def format_mlad_file(rows: Iterable[RelativePose]) -> str:
    """The text of a pose file, in the order of ``rows``.

    Numbers have the fewest digits that read back to the same float64.

    Raises
    ------
    DataError : a row without a pose (every row needs one), a pose that is not finite or whose
        quaternion is off unit length by 1e-3 or more.
    """
    lines = []
    for row in rows:
        pair = f"{row.reference} {row.query}"
        if row.query_from_reference is None:
            raise DataError(f"pair {pair} has no pose; MLAD wants every row")
        given = row.query_from_reference
        pose = checked_pose(given.quat_wxyz, given.translation, f"pair {pair}")
        qw, *vector = pose.quat_wxyz
        lines.append(" ".join([pair, *(repr(float(v)) for v in (*pose.translation, *vector, qw))]))
    return "".join(f"{line}\n" for line in lines)


def write_mlad_file(path: Path | str, rows: Iterable[RelativePose]) -> None:
    """Write a pose file atomically; see :func:`format_mlad_file`.

    Raises
    ------
    DataError : a row that must not be handed in.
    OutputError : the file cannot be written.
    """
    write_bytes(path, format_mlad_file(rows).encode("ascii"))


def read_mlad_file(path: Path | str) -> list[RelativePose]:
    """Read a pose file or a relocalization file, ours or foreign, in its order.

    Runs of spaces, tabs and CRLF line ends are taken; empty lines are passed over. The last line
    may be without its end, as common tools write it.

    Raises
    ------
    DataError : not nine columns (or two, in every row: a list of pairs), a timestamp or number
        that is none, a pose that is not finite, a quaternion off unit length by 1e-3 or more, a
        pair given twice. Names file and line.
    """
    rows: list[RelativePose] = []
    known: set[tuple[int, int]] = set()
    columns = 0
    for number, line in enumerate(read_text(path).split("\n"), start=1):
        fields = line.split()
        if not fields:
            continue
        columns = columns or (2 if len(fields) == 2 else 9)
        try:
            row = _row(fields, columns)
        except DataError as error:
            raise DataError(error.message, path=path, line=number) from error
        pair = (row.reference, row.query)
        if pair in known:
            raise DataError(f"pair {pair[0]} {pair[1]} is given twice", path=path, line=number)
        known.add(pair)
        rows.append(row)
    return rows


def parse_timestamp(text: str) -> int:
    """A timestamp; raises DataError for anything that is not a whole number in plain digits."""
    if not _TIMESTAMP.fullmatch(text):
        raise DataError(f"{text!r} is not a timestamp (a whole number)")
    return int(text)


def _row(fields: list[str], columns: int) -> RelativePose:
    if len(fields) != columns:
        wanted = "9 (" + COLUMNS + ")" if columns == 9 else "2, as in the rows before"
        raise DataError(f"{len(fields)} columns instead of {wanted}")
    reference, query = (parse_timestamp(field) for field in fields[:2])
    if columns == 2:
        return RelativePose(reference, query)
    tx, ty, tz, qx, qy, qz, qw = (parse_number(field) for field in fields[2:])
    pose = checked_pose((qw, qx, qy, qz), (tx, ty, tz), f"pair {reference} {query}")
    return RelativePose(reference, query, pose)
