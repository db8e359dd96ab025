"""InLoc's files: cutout names, transformations of scans, scanned points, lists of wrong scans.

``<BLD>_cutout_<SCAN>_<YAW>_<PITCH>.jpg`` is cut out of the panorama of a scan, and what the scanner
measured in each of its pixels is in ``<image>.mat``, in the scan's frame (metres, z up). The scan
stands in its floor as ``<BLD>_trans_<SCAN>.txt`` says.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.grammars.mat_file import read_mat_array
from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.kapture_csv import read_lines
from megloc_kapture.io.kapture_data import FLOAT_PATTERN
from megloc_kapture.values import RigidTransform

Floats = NDArray[np.float64]

POINTS = "XYZcut"
COLOURS = "RGBcut"

_CUTOUT = re.compile(r"([A-Za-z]+)_cutout_([0-9]{3})_([0-9]{1,3})_(-?[0-9]{1,2})\.jpg")
_SCAN_NUMBER = re.compile(r"(?<![0-9])[0-9]{1,3}(?![0-9])")
_MAX_TEXT_BYTES = 1 << 20  # of files that hold a few lines
_BEFORE, _AFTER = "Before general icp:", "After general icp:"
_MAX_SKEW = 1e-3  # how far a rotation may be off, as its numbers are rounded


@dataclass(frozen=True, slots=True)
class Cutout:
    """What a cutout's name says.

    Parameters
    ----------
    building : ``DUC`` or ``cse``, as in the names of its other files.
    scan : three digits.
    yaw_deg : to the right of the scan's -x axis, 0 to 359.
    pitch_deg : above the horizon, -90 to 90.
    """

    building: str
    scan: str
    yaw_deg: int
    pitch_deg: int

    @property
    def image(self) -> str:
        """Name of the image file."""
        return f"{self.building}_cutout_{self.scan}_{self.yaw_deg}_{self.pitch_deg}.jpg"

    @property
    def transformation(self) -> str:
        """Name of the scan's transformation file."""
        return f"{self.building}_trans_{self.scan}.txt"

    def cam_from_scan(self) -> RigidTransform:
        """The cutout's pose in its scan, whose origin is its centre.

        From the scan's axes (z up) to a camera that looks along -x, then turned by the yaw to the
        right and by the pitch upwards.
        """
        yaw, pitch = np.radians(-self.yaw_deg), np.radians(-self.pitch_deg)
        pano_from_scan = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
        about_x = np.array(
            [
                [1, 0, 0],
                [0, np.cos(pitch), -np.sin(pitch)],
                [0, np.sin(pitch), np.cos(pitch)],
            ]
        )
        about_y = np.array(
            [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
        )
        return RigidTransform.from_matrix(about_x @ about_y @ pano_from_scan, np.zeros(3))


def parse_cutout_name(name: str) -> Cutout:
    """What the name of a cutout's image says.

    Raises
    ------
    DataError : another name.
    """
    found = _CUTOUT.fullmatch(name)
    if found is None or int(found[3]) >= 360 or abs(int(found[4])) > 90:
        raise DataError(f"{name!r} is not named <BUILDING>_cutout_<SCAN>_<YAW>_<PITCH>.jpg")
    cutout = Cutout(found[1], found[2], int(found[3]), int(found[4]))
    if cutout.image != name:  # "_030_", "_-0": one view would have two names
        raise DataError(f"{name!r} is {cutout.image!r} with superfluous digits")
    return cutout


def read_transformation(path: Path | str) -> RigidTransform:
    """``floor_from_scan`` of a scan, after refinement.

    The file has two 4x4 matrices, before refinement and after it, row by row; what else stands in
    it is text.

    Raises
    ------
    DataError : missing, not two matrices, or the second is no rotation with a translation; names
        file and line.
    """
    path = Path(path)
    rows: list[tuple[int, list[float]]] = []
    for number, line in enumerate(_few_lines(path), start=1):
        fields = line.split()
        if len(fields) == 4 and all(FLOAT_PATTERN.fullmatch(text) for text in fields):
            rows.append((number, [float(text) for text in fields]))
    if len(rows) != 8:
        raise DataError(
            f"{len(rows)} rows of four numbers; expected two matrices of four rows each", path=path
        )
    for first in (0, 4):
        numbers = [number for number, _ in rows[first : first + 4]]
        if numbers[-1] - numbers[0] != 3:
            raise DataError(
                "the rows of a matrix do not follow each other", path=path, line=numbers[0]
            )
    matrix = np.array([row for _, row in rows[4:]])
    rotation, begin = matrix[:3, :3], rows[4][0]
    if not np.isfinite(matrix).all() or np.abs(matrix[3] - (0, 0, 0, 1)).max() > _MAX_SKEW:
        raise DataError("the matrix does not end with the row 0 0 0 1", path=path, line=begin + 3)
    with np.errstate(over="ignore", invalid="ignore"):
        skew = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not skew <= _MAX_SKEW or np.linalg.det(rotation) < 0:
        raise DataError("the matrix is no rotation with a translation", path=path, line=begin)
    return RigidTransform.from_matrix(rotation, matrix[:3, 3])


def write_transformation(path: Path | str, before: RigidTransform, after: RigidTransform) -> None:
    """Write a transformation file as published: both matrices, each under its heading."""
    lines = []
    for heading, pose in ((_BEFORE, before), (_AFTER, after)):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = pose.rotation_matrix(), pose.translation
        lines += [heading, *(" ".join(f"{value:13.9f}" for value in row) for row in matrix), ""]
    write_bytes(path, "\n".join(lines).encode())


def read_wrong_scans(path: Path | str) -> frozenset[str]:
    """The scans, three digits each, that the dataset's authors list as wrongly placed.

    How the list looks is not documented: every number of at most three digits counts.

    Raises
    ------
    DataError : missing, or no text.
    """
    lines = _few_lines(Path(path))
    return frozenset(n.zfill(3) for line in lines for n in _SCAN_NUMBER.findall(line))


def read_cutout_points(path: Path | str, width: int, height: int) -> Floats:
    """What the scanner measured in each pixel of a cutout.

    Returns
    -------
    float64 (height, width, 3), metres in the scan's frame; NaN where nothing came back.

    Raises
    ------
    DataError : not a MATLAB file, broken, or of another size than the image.
    """
    points = read_mat_array(path, POINTS)
    if points.shape != (height, width, 3):
        found = "x".join(map(str, points.shape))
        raise DataError(f"{POINTS} is {found}, expected {height}x{width}x3", path=path)
    return points


def _few_lines(path: Path) -> list[str]:
    try:
        size = path.stat().st_size
    except OSError:
        size = 0  # the reader says what is wrong
    if size > _MAX_TEXT_BYTES:
        raise DataError(f"{size} bytes, too many for a few lines of text", path=path)
    return read_lines(path)
