"""The small text files of RobotCar Seasons: intrinsics, extrinsics, lists of queries.

CRLF line ends, blank lines and a missing end of the last line are accepted everywhere. Images are
named ``<condition>/<camera>/<microseconds>``; the files say ``.png`` or ``.jpg`` for the same
image, and some begin a name with ``./``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_csv import parse_float
from megloc_kapture.io.text import read_text
from megloc_kapture.values import RigidTransform

INTRINSICS_KEYS = ("fx", "fy", "cx", "cy")
# of R^T R from the identity; the published matrices have six decimals
MAX_ROTATION_ERROR = 1e-3
MAX_DISTANCE_M = 1e9

_BLANKS = re.compile(r"[ \t]+")
_PART = r"[A-Za-z0-9][A-Za-z0-9_-]*"
_IMAGE = re.compile(
    rf"(?:(?P<condition>{_PART})/)?(?P<camera>{_PART})/(?P<stem>[0-9]{{1,19}})\.(?:jpg|png)"
)

Matrix = NDArray[np.float64]
Entry = TypeVar("Entry")


@dataclass(frozen=True, slots=True)
class ImageKey:
    """What names an image of the dataset, whatever the file type says.

    Parameters
    ----------
    condition : of the traversal, ``""`` where a list leaves it out.
    camera : ``left``, ``rear`` or ``right``.
    stem : the file's name without its type: the time in microseconds.
    """

    condition: str
    camera: str
    stem: str

    @property
    def timestamp(self) -> int:
        """The time in microseconds."""
        return int(self.stem)

    @property
    def path(self) -> str:
        """Path below ``images/``, without the file type."""
        return f"{self.condition}/{self.camera}/{self.stem}"


@dataclass(frozen=True, slots=True)
class TrainPose:
    """A query image with a published pose; ``line`` is where the file says so."""

    image: ImageKey
    cam_from_world: RigidTransform
    line: int


@dataclass(frozen=True, slots=True)
class ListedImage:
    """An image of a list: its key, the text of the list, the line."""

    image: ImageKey
    text: str
    line: int


def parse_image(text: str) -> ImageKey | None:
    """The image a name stands for; None where it is no image name.

    ``./`` before it does not count. The condition may be absent (``rear/123.png``).
    """
    found = _IMAGE.fullmatch(text.removeprefix("./"))
    if found is None:
        return None
    return ImageKey(found["condition"] or "", found["camera"], found["stem"])


def read_intrinsics(path: Path) -> tuple[float, float, float, float]:
    """Read ``<camera>_intrinsics.txt``: fx, fy, cx, cy in pixels, whatever their order there.

    Raises
    ------
    DataError : a line that is no ``key value``, a key that is unknown, given twice or absent, a
        value that is no number; names file and line.
    """
    values: dict[str, float] = {}
    number = 1
    for number, text in _lines(path):
        fields = _BLANKS.split(text)
        if len(fields) != 2 or fields[0] not in INTRINSICS_KEYS:
            raise DataError(
                f"expected a line 'key value', key one of {', '.join(INTRINSICS_KEYS)}",
                path=path,
                line=number,
            )
        key = fields[0]
        if key in values:
            raise DataError(f"{key} is given twice", path=path, line=number)
        values[key] = parse_float(fields[1], key, path, number)
    absent = [key for key in INTRINSICS_KEYS if key not in values]
    if absent:
        raise DataError(f"{', '.join(absent)} missing; it ends here", path=path, line=number)
    fx, fy, cx, cy = (values[key] for key in INTRINSICS_KEYS)
    return fx, fy, cx, cy


def read_extrinsics(path: Path) -> RigidTransform:
    """Read ``<camera>_extrinsics.txt``, a 4x4 matrix between commas: ``car_from_cam``, metres.

    Raises
    ------
    DataError : not four lines of four numbers, or no rigid motion; names file and line.
    """
    rows: list[list[float]] = []
    number = 0
    for number, text in _lines(path):
        fields = [field.strip(" \t") for field in text.split(",")]
        if len(fields) != 4 or len(rows) == 4:
            raise DataError(
                f"expected four lines of four numbers between commas, got line {len(rows) + 1} "
                f"with {len(fields)}",
                path=path,
                line=number,
            )
        rows.append([parse_float(field, "matrix element", path, number) for field in fields])
    if len(rows) != 4:
        raise DataError(
            f"expected four lines of four numbers, got {len(rows)}", path=path, line=number + 1
        )
    return _rigid(np.array(rows), path, number)


def read_query_location(path: Path) -> list[ListedImage]:
    """Read ``queries_location_NNN.txt``: one image per line, in the list's order.

    Raises
    ------
    DataError : a line that is no ``condition/camera/time.jpg``, or no image; names file and line.
    """
    listed = [_listed(text, path, number, conditions=True) for number, text in _lines(path)]
    return _some(listed, path)


def read_test_list(path: Path) -> list[ListedImage]:
    """Read ``robotcar_v2_test.txt``: one image per line, in the list's order.

    The official list leaves the condition out (``rear/123.png``); a list that has it is read too.

    Raises
    ------
    DataError : a line that is no image, one given twice, or no image; names file and line.
    """
    listed: dict[tuple[str, str], ListedImage] = {}
    for number, text in _lines(path):
        entry = _listed(text, path, number, conditions=False)
        key = (entry.image.camera, entry.image.stem)
        if key in listed:
            raise DataError(f"{text!r} is listed twice", path=path, line=number)
        listed[key] = entry
    return _some(list(listed.values()), path)


def read_train_poses(path: Path) -> list[TrainPose]:
    """Read ``robotcar_v2_train.txt``: a name and the 4x4 matrix ``world_from_cam`` per line.

    Raises
    ------
    DataError : not 17 fields, no image name, no rigid motion, an image given twice, or none;
        names file and line.
    """
    poses: dict[ImageKey, TrainPose] = {}
    for number, text in _lines(path):
        fields = _BLANKS.split(text)
        if len(fields) != 17:
            raise DataError(
                f"expected a name and 16 matrix elements, got {len(fields)} fields",
                path=path,
                line=number,
            )
        image = _listed(fields[0], path, number, conditions=True).image
        if image in poses:
            raise DataError(f"{fields[0]!r} is given twice", path=path, line=number)
        values = [parse_float(field, "matrix element", path, number) for field in fields[1:]]
        world_from_cam = _rigid(np.array(values).reshape(4, 4), path, number)
        poses[image] = TrainPose(image, world_from_cam.inverse(), number)
    return _some(list(poses.values()), path)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(read_text(path).split("\n"), start=1):
        text = line.strip(" \t\r")
        if text:
            yield number, text


def _some(entries: list[Entry], path: Path) -> list[Entry]:
    if not entries:
        raise DataError("no image in the list", path=path, line=1)
    return entries


def _listed(text: str, path: Path, line: int, *, conditions: bool) -> ListedImage:
    image = parse_image(text)
    if image is None or (conditions and not image.condition):
        form = "condition/camera/time.jpg" if conditions else "camera/time.png"
        raise DataError(f"expected {form}, got {text[:80]!r}", path=path, line=line)
    return ListedImage(image, text, line)


def _rigid(matrix: Matrix, path: Path, line: int) -> RigidTransform:
    rotation = matrix[:3, :3]
    # huge elements may overflow; what comes of it is not below the limit
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotation.T @ rotation - np.eye(3)).max()
        if not error < MAX_ROTATION_ERROR or np.linalg.det(rotation) < 0:
            raise DataError(
                "the upper left 3x3 of the matrix is no rotation matrix", path=path, line=line
            )
    if not np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() < MAX_ROTATION_ERROR:
        raise DataError(
            f"the matrix' last row is {_shown(matrix[3])}, expected 0 0 0 1", path=path, line=line
        )
    if np.abs(matrix[:3, 3]).max() > MAX_DISTANCE_M:
        raise DataError(
            f"the position {_shown(matrix[:3, 3])} is nowhere on earth", path=path, line=line
        )
    return RigidTransform.from_matrix(rotation, matrix[:3, 3])


def _shown(row: Matrix) -> str:
    return " ".join(f"{value:g}" for value in row)
