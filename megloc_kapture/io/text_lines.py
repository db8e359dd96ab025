"""Lines, numbers, transforms and camera lists of small text files.

Errors name file and line. A camera list has a row ``NAME MODEL WIDTH HEIGHT PARAMS...`` per image
(Aachen, hloc), or a single row for all images (COLMAP's cameras.txt).
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.files import check_relative, named, read_text
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

# tolerance of R^T R - I; published matrices have six decimals
MAX_ROTATION_ERROR = 1e-3


@contextlib.contextmanager
def reading_lines(path: Path, *, comments: bool = False) -> Iterator[Iterator[str]]:
    """Yield an iterator of the stripped lines that are not blank.

    With ``comments``, lines that begin with # are skipped. A DataError in the block gets file and
    line. A ValueError, as from ``float``, becomes a DataError with file and line.
    """
    texts = read_text(path).split("\n")
    number: int | None = None

    def lines() -> Iterator[str]:
        nonlocal number
        for number, text in enumerate(texts, start=1):  # noqa: B007  used in the message below
            if text.strip() and not (comments and text.strip().startswith("#")):
                yield text.strip()
        number = None

    try:
        yield lines()
    except (DataError, ValueError) as error:
        with named(path, number):
            raise error if isinstance(error, DataError) else DataError(str(error)) from error


def fields_of(text: str) -> list[str]:
    """Split a line at commas and blanks."""
    return text.replace(",", " ").split()


def numbers_of(fields: Sequence[str], form: str) -> list[float]:
    """Parse one finite number for each blank-separated name in ``form``."""
    try:
        values = list(map(float, fields))
    except ValueError:
        values = []
    require(
        len(values) == len(form.split()) and all(map(math.isfinite, values)),
        f"expected finite numbers {form}, got {' '.join(fields)!r}",
    )
    return values


def transform_of(elements: Sequence[str]) -> RigidTransform:
    """Parse the 16 elements of a 4x4 matrix, row by row."""
    require(len(elements) == 16, f"expected the 16 elements of a matrix, got {len(elements)}")
    matrix = np.array(list(map(float, elements))).reshape(4, 4)
    rotation = matrix[:3, :3]
    require(
        np.isfinite(matrix).all()
        and np.allclose(rotation.T @ rotation, np.eye(3), rtol=0, atol=MAX_ROTATION_ERROR)
        and np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), rtol=0, atol=MAX_ROTATION_ERROR)
        and np.linalg.det(rotation) > 0,
        "not a rotation and a translation, with the last row 0 0 0 1",
    )
    return RigidTransform.from_matrix(rotation, matrix[:3, 3])


def read_transform(path: Path, *, comments: bool = False) -> RigidTransform:
    """Read a 4x4 matrix of comma- or blank-separated numbers."""
    with reading_lines(path, comments=comments) as lines:
        return transform_of([field for line in lines for field in fields_of(line)])


# ------------------------------------------------------------------------------- camera lists


_ROW = re.compile(
    rf"(?P<name>\S.*?)[\s,]+(?P<model>{'|'.join(CAMERA_MODEL_NUM_PARAMS)})[\s,]+(?P<numbers>.*)"
)


def camera_of(model: str, numbers: Sequence[str]) -> Camera:
    """Parse width, height and parameters; some scripts write sizes as floats."""
    width, height, *params = map(float, numbers)
    require((width % 1, height % 1) == (0, 0), "the image size is not in whole pixels")
    return Camera(model, int(width), int(height), tuple(params))


def find_camera(cameras: Mapping[str, Camera], image: str, path: Path) -> Camera | None:
    """Return the camera of an image by its name and path from a list; None if no row fits.

    The row's name is the longest suffix of the path, in whole path components. Without such a row,
    the only row whose name ends with the image's name is taken.
    """
    parts = path.absolute().as_posix().split("/")
    suffixes = ("/".join(parts[start:]) for start in range(1, len(parts)))
    name = next((suffix for suffix in suffixes if suffix in cameras), None)
    if name is None:
        alike = [listed for listed in cameras if listed.endswith(f"/{image}")]
        name = alike[0] if len(alike) == 1 else None
    return None if name is None else cameras[name]


def read_cameras(path: Path) -> Camera | dict[str, Camera]:
    """Read a list; a single row with a number as its name (COLMAP's id) applies to all images."""
    cameras = read_camera_rows(path)
    if len(cameras) == 1 and next(iter(cameras)).isdigit():
        return next(iter(cameras.values()))
    return cameras


def read_camera_rows(path: Path) -> dict[str, Camera]:
    """Read the cameras of a list by image name, in file order."""
    cameras: dict[str, Camera] = {}
    with reading_lines(path, comments=True) as lines:
        for line in lines:
            row = _ROW.fullmatch(line)
            if row is None:
                raise DataError(
                    "expected a row NAME MODEL WIDTH HEIGHT PARAMS..., MODEL one of "
                    f"{', '.join(CAMERA_MODEL_NUM_PARAMS)}"
                )
            name = check_relative(row["name"].removeprefix("./").removeprefix("/"))
            require(name not in cameras, f"{name!r} is listed twice")
            cameras[name] = camera_of(row["model"], fields_of(row["numbers"]))
    require(cameras, "no camera in this list", path=path)
    return cameras
