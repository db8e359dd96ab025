"""4Seasons' calibration of the undistorted images: two pinhole cameras and what is between them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from megloc_kapture.datasets.grammars.fourseasons_lines import MAX_DISTANCE_M, data_lines
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_csv import parse_float
from megloc_kapture.values import Camera, RigidTransform

CAMERA_FILES = ("undistorted_calib_0.txt", "undistorted_calib_1.txt")
STEREO_FILE = "undistorted_calib_stereo.txt"

_SIZE = re.compile(r"[0-9]{1,5}")
_MAX_SIZE = 1 << 14
_MAX_ROTATION_ERROR = 1e-3


@dataclass(frozen=True, slots=True)
class StereoCalibration:
    """The cameras of the undistorted images.

    Parameters
    ----------
    cam0, cam1 : left and right, PINHOLE.
    cam1_from_cam0 : metres. The dataset's page words it "from the right to the left camera"; its
        camchain.yaml, its sign and every user of the data say cam1 from cam0.
    """

    cam0: Camera
    cam1: Camera
    cam1_from_cam0: RigidTransform


def read_calibration(folder: Path) -> StereoCalibration:
    """Read the three files of a calibration folder that the undistorted images need.

    Raises
    ------
    DataError : one of them is missing or broken; names file and line.
    """
    cam0, cam1 = (read_pinhole(folder / name) for name in CAMERA_FILES)
    return StereoCalibration(cam0, cam1, read_stereo(folder / STEREO_FILE))


def read_pinhole(path: Path) -> Camera:
    """Read ``undistorted_calib_N.txt``: ``Pinhole fx fy cx cy 0 0 0 0``, the size, twice.

    Raises
    ------
    DataError : another camera model, distortion, or sizes that differ; names file and line.
    """
    lines = list(data_lines(path))
    if len(lines) not in (2, 4):
        raise DataError(
            "expected the lines 'Pinhole fx fy cx cy 0.0 0.0 0.0 0.0', 'width height', 'crop', "
            f"'width height', got {len(lines)}",
            path=path,
            line=lines[-1][0] if lines else 1,
        )
    number, (model, *values) = lines[0]
    if model != "Pinhole" or len(values) not in (4, 8):
        raise DataError(
            "expected 'Pinhole fx fy cx cy 0.0 0.0 0.0 0.0', the calibration of undistorted images",
            path=path,
            line=number,
        )
    params = tuple(parse_float(text, "camera parameter", path, number) for text in values)
    if any(params[4:]):
        raise DataError("undistorted images cannot have distortion", path=path, line=number)
    sizes = [_size(fields, path, line) for line, fields in lines[1::2]]
    if sizes[0] != sizes[-1]:
        raise DataError(
            f"the image's size is {sizes[0]} first and {sizes[-1]} then",
            path=path,
            line=lines[3][0],
        )
    try:
        return Camera("PINHOLE", *sizes[0], params[:4])
    except DataError as error:
        raise DataError(error.message, path=path, line=number) from error


def read_stereo(path: Path) -> RigidTransform:
    """Read ``undistorted_calib_stereo.txt``, a 4x4 matrix: ``cam1_from_cam0``, metres.

    Raises
    ------
    DataError : not four lines of four numbers, or no rigid motion; names file and line.
    """
    rows: list[list[float]] = []
    number = 0
    for number, fields in data_lines(path):
        if len(fields) != 4 or len(rows) == 4:
            raise DataError(
                f"expected four lines of four numbers, got line {len(rows) + 1} with {len(fields)}",
                path=path,
                line=number,
            )
        rows.append([parse_float(text, "matrix element", path, number) for text in fields])
    if len(rows) != 4:
        raise DataError(
            f"expected four lines of four numbers, got {len(rows)}", path=path, line=number + 1
        )
    matrix = np.array(rows)
    rotation = matrix[:3, :3]
    # huge elements may overflow; what comes of it is not below the limit
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotation.T @ rotation - np.eye(3)).max()
        proper = error < _MAX_ROTATION_ERROR and np.linalg.det(rotation) > 0
        last = np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max()
    if not proper or not last < _MAX_ROTATION_ERROR or np.abs(matrix[:3, 3]).max() > MAX_DISTANCE_M:
        raise DataError("the matrix is no rigid motion", path=path, line=number)
    return RigidTransform.from_matrix(rotation, matrix[:3, 3])


def _size(fields: list[str], path: Path, line: int) -> tuple[int, int]:
    if len(fields) != 2 or not all(map(_SIZE.fullmatch, fields)):
        raise DataError("expected 'width height' in pixels", path=path, line=line)
    width, height = map(int, fields)
    if max(width, height) > _MAX_SIZE:
        raise DataError(f"no camera takes images of {width}x{height}", path=path, line=line)
    return width, height
