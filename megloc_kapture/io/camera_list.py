"""Camera lists with one row per image (Aachen, hloc) or one for all (COLMAP's cameras.txt).

A row is ``NAME MODEL WIDTH HEIGHT PARAMS...``, separated by blanks or commas.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.files import check_relative
from megloc_kapture.io.text_lines import fields_of, reading_lines
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera

_ROW = re.compile(
    rf"(?P<name>\S.*?)[\s,]+(?P<model>{'|'.join(CAMERA_MODEL_NUM_PARAMS)})[\s,]+(?P<numbers>.*)"
)


class CameraList:
    """Cameras by the names of their images.

    An image gets the row with the longest name that its path ends with, by whole folders; else the
    only row whose name ends with the image's.
    """

    def __init__(self, cameras: Mapping[str, Camera]) -> None:
        self._cameras = cameras
        self._by_file: dict[str, list[str]] = {}
        for name in cameras:
            self._by_file.setdefault(PurePosixPath(name).name, []).append(name)

    def of(self, image: str, path: Path) -> Camera | None:
        """Return the camera of an image by name and file; None without a row."""
        names = self._by_file.get(PurePosixPath(image).name, [])
        file = path.absolute().as_posix()
        ending = [name for name in names if file.endswith(f"/{name}")]
        if not ending:
            ending = [name for name in names if name.endswith(f"/{image}")]
            if len(ending) > 1:
                return None
        return self._cameras[max(ending, key=len)] if ending else None


def read_cameras(path: Path) -> Camera | CameraList:
    """Read a list; a single row with a number as its name (COLMAP's id) applies to all images."""
    cameras = read_camera_rows(path)
    if len(cameras) == 1 and next(iter(cameras)).isdigit():
        return next(iter(cameras.values()))
    return CameraList(cameras)


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
            name = check_relative(row["name"])
            require(name not in cameras, f"{name!r} is listed twice")
            width, height, *params = fields_of(row["numbers"])
            cameras[name] = Camera(row["model"], int(width), int(height), tuple(map(float, params)))
    require(cameras, "no camera in this list", path=path)
    return cameras
