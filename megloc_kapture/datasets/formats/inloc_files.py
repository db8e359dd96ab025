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

from megloc_kapture.datasets.formats.text_lines import Line, read_lines
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.text import FLOAT_PATTERN
from megloc_kapture.io.mat_file import read_mat_array
from megloc_kapture.values import RigidTransform

POINTS = "XYZcut"
COLOURS = "RGBcut"

_CUTOUT = re.compile(r"([A-Za-z]+)_cutout_([0-9]{3})_([0-9]{1,3})_(-?[0-9]{1,2})\.jpg")
_SCAN_NUMBER = re.compile(r"(?<![0-9])[0-9]{1,3}(?![0-9])")
_MAX_TEXT_BYTES = 1 << 20  # of files that hold a few lines


@dataclass(frozen=True, slots=True)
class Cutout:
    """A cutout, as its name describes it.

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
    """The cutout that the name of its image describes.

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
    rows = [line for line in _few_lines(path) if _has_four_numbers(line)]
    if len(rows) != 8:
        raise DataError(
            f"{len(rows)} rows of four numbers; expected two matrices of four rows each", path=path
        )
    for first, last in ((rows[0], rows[3]), (rows[4], rows[7])):
        if last.number - first.number != 3:
            raise first.error("the rows of a matrix do not follow each other")
    matrix = np.array([row.numbers_of(row.fields, "matrix element") for row in rows[4:]])
    return rows[7].rigid_transform(matrix)


def read_wrong_scans(path: Path | str) -> frozenset[str]:
    """The scans, three digits each, that the dataset's authors list as wrongly placed.

    How the list looks is not documented: every number of at most three digits counts.

    Raises
    ------
    DataError : missing, or no text.
    """
    lines = _few_lines(Path(path))
    return frozenset(n.zfill(3) for line in lines for n in _SCAN_NUMBER.findall(line.text))


def read_cutout_points(path: Path | str, width: int, height: int) -> NDArray[np.float64]:
    """The scanned points of the pixels of a cutout.

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


def _has_four_numbers(line: Line) -> bool:
    return len(line.fields) == 4 and all(map(FLOAT_PATTERN.fullmatch, line.fields))


def _few_lines(path: Path) -> list[Line]:
    size = path.stat().st_size if path.is_file() else 0  # else the reader says what is wrong
    if size > _MAX_TEXT_BYTES:
        raise DataError(f"{size} bytes, too many for a few lines of text", path=path)
    return read_lines(path)
