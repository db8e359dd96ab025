"""The text files of RobotCar Seasons: intrinsics and lists of queries; extrinsics are a matrix.

Images are named ``<condition>/<camera>/<microseconds>``; the files say ``.png`` or ``.jpg`` for the
same image, and some begin a name with ``./``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from megloc_kapture.datasets.formats.text_lines import Line, read_lines, shown
from megloc_kapture.errors import DataError
from megloc_kapture.values import RigidTransform

INTRINSICS_KEYS = ("fx", "fy", "cx", "cy")

_PART = r"[A-Za-z0-9][A-Za-z0-9_-]*"
_IMAGE = re.compile(
    rf"(?:(?P<condition>{_PART})/)?(?P<camera>{_PART})/(?P<stem>[0-9]{{1,19}})\.(?:jpg|png)"
)


@dataclass(frozen=True, slots=True)
class ImageKey:
    """The identity of an image, without the file type.

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


class ListedImage(NamedTuple):
    """An image of a list, its line, and its pose; the identity where the list has no poses."""

    image: ImageKey
    line: Line
    cam_from_world: RigidTransform


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
    lines = read_lines(path)
    for line in lines:
        if len(line.fields) != 2 or line.fields[0] not in INTRINSICS_KEYS:
            raise line.error(
                f"expected a line 'key value', key one of {', '.join(INTRINSICS_KEYS)}"
            )
        key, text = line.fields
        if key in values:
            raise line.error(f"{key} is given twice")
        values[key] = line.number_of(text, key)
    absent = [key for key in INTRINSICS_KEYS if key not in values]
    if absent:
        number = lines[-1].number if lines else 1
        raise DataError(f"{', '.join(absent)} missing; it ends here", path=path, line=number)
    fx, fy, cx, cy = (values[key] for key in INTRINSICS_KEYS)
    return fx, fy, cx, cy


def read_query_location(path: Path) -> list[ListedImage]:
    """Read ``queries_location_NNN.txt``: one image per line, in the list's order.

    Raises
    ------
    DataError : a line that is no ``condition/camera/time.jpg``, or no image; names file and line.
    """
    return _some([_listed(line, line.text) for line in read_lines(path)], path)


def read_test_list(path: Path) -> list[ListedImage]:
    """Read ``robotcar_v2_test.txt``: one image per line, in the list's order.

    The official list leaves the condition out (``rear/123.png``); a list that has it is read too.

    Raises
    ------
    DataError : a line that is no image, one given twice, or no image; names file and line.
    """
    listed: dict[tuple[str, str], ListedImage] = {}
    for line in read_lines(path):
        entry = _listed(line, line.text, conditions=False)
        if listed.setdefault((entry.image.camera, entry.image.stem), entry) is not entry:
            raise line.error(f"{line.text!r} is listed twice")
    return _some(list(listed.values()), path)


def read_train_poses(path: Path) -> list[ListedImage]:
    """Read ``robotcar_v2_train.txt``: a name and the 4x4 matrix ``world_from_cam`` per line.

    Raises
    ------
    DataError : not 17 fields, no image name, no rigid motion, an image given twice, or none;
        names file and line.
    """
    listed: dict[ImageKey, ListedImage] = {}
    for line in read_lines(path):
        line.expect(line.fields, 17, "a name and 16 matrix elements")
        image = _listed(line, line.fields[0]).image
        if image in listed:
            raise line.error(f"{line.fields[0]!r} is given twice")
        values = line.numbers_of(line.fields[1:], "matrix element")
        world_from_cam = line.rigid_transform(np.array(values).reshape(4, 4))
        listed[image] = ListedImage(image, line, world_from_cam.inverse())
    return _some(list(listed.values()), path)


def _some(entries: list[ListedImage], path: Path) -> list[ListedImage]:
    if not entries:
        raise DataError("no image in the list", path=path, line=1)
    return entries


def _listed(line: Line, text: str, *, conditions: bool = True) -> ListedImage:
    image = parse_image(text)
    if image is None or (conditions and not image.condition):
        form = "condition/camera/time.jpg" if conditions else "camera/time.png"
        raise line.error(f"expected {form}, got {shown(text)}")
    return ListedImage(image, line, RigidTransform.identity())
