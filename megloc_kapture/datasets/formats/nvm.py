"""NVM files (``NVM_V3``), VisualSFM's models, as COLMAP exports and the challenges publish them.

The translation column of a camera is its centre, and the distortion has the other sign than
COLMAP's. Pixels are taken as they are: COLMAP's exporter writes them as COLMAP has them. Sizes of
images and principal points are not in the file.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.sparse_points import (
    MAX_FEATURE_ID,
    PIXEL_END,
    SparsePoints,
    are_counts,
    check_pixel,
    read_points,
)
from megloc_kapture.datasets.formats.text_lines import Line, NumberRows, TextFile
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.values import RigidTransform

HEADER = "NVM_V3"
FIXED_CALIBRATION = "FixedK"
_CAMERA_FIELDS = "name, focal length, quaternion, centre, distortion, 0"
_HEAD = 7  # fields of a point before its measurements


@dataclass(frozen=True, eq=False)
class NvmModel:
    """One reconstructed model of an NVM file.

    Parameters
    ----------
    names : of the images, C of them, as in the file but without ``./`` before them.
    focal_px : float64 (C,).
    quat_wxyz : float64 (C, 4), unit length: rotation from world to camera.
    centers : float64 (C, 3), the cameras' centres in the world.
    k_colmap : float64 (C,), radial distortion with COLMAP's sign (SIMPLE_RADIAL).
    points : ``image_ids`` count in ``names``.
    """

    names: tuple[str, ...]
    focal_px: NDArray[np.float64]
    quat_wxyz: NDArray[np.float64]
    centers: NDArray[np.float64]
    k_colmap: NDArray[np.float64]
    points: SparsePoints

    def cam_from_world(self, index: int) -> RigidTransform:
        """Pose of the image at a position in ``names``."""
        w, x, y, z = self.quat_wxyz[index].tolist()
        rotation = RigidTransform((w, x, y, z), (0.0, 0.0, 0.0)).rotation_matrix()
        tx, ty, tz = (-rotation @ self.centers[index]).tolist()
        return RigidTransform((w, x, y, z), (tx, ty, tz))


def read_nvm(path: Path, *, with_points: bool = True) -> list[NvmModel]:
    """Read the models of an NVM file, in its order; there is at least one.

    A model without points after another one lists the images that were not registered; it is
    checked and left out. What follows the 0 after the last model is not looked at.

    Parameters
    ----------
    with_points : False passes over the points, unchecked but for their number.

    Raises
    ------
    DataError : the file is missing, broken, truncated or holds no model; names file and line.
    """
    models: list[NvmModel] = []
    with TextFile(path) as file:
        _check_header(file)
        while (line := file.row()) is not None:
            num_cameras = _single_count(
                line, "the number of cameras", " of the next model, or 0 at the end"
            )
            if num_cameras == 0:
                break
            names, rows = _read_cameras(file, num_cameras)
            line = file.row()
            if line is None:
                raise DataError(
                    "the file ends where the number of points was expected",
                    path=path,
                    line=file.last_line,
                )
            num_points = _single_count(line, "the number of points")
            points = _read_points(file, num_points, num_cameras, with_points=with_points)
            if num_points or not models:
                models.append(_model(names, rows, points))
    if not models:
        raise DataError("holds no model", path=path)
    return models


def read_single_nvm(path: Path, *, with_points: bool = True) -> NvmModel:
    """Read an NVM file of one model; raises DataError for others, see :func:`read_nvm`."""
    models = read_nvm(path, with_points=with_points)
    if len(models) != 1:
        raise DataError(f"{len(models)} models, expected one", path=path)
    return models[0]


def _check_header(file: TextFile) -> None:
    line = file.line()
    if line is None or line.fields[:1] != [HEADER]:
        raise DataError(
            "no NVM file: the first line must begin with NVM_V3", path=file.path, line=1
        )
    if line.fields[1:]:
        line.expect(line.fields, 6, "NVM_V3 FixedK fx cx fy cy")
        if line.fields[1] != FIXED_CALIBRATION:
            raise line.error("after NVM_V3 only FixedK fx cx fy cy may follow")
        line.numbers_of(line.fields[2:], "calibration")


def _single_count(line: Line, what: str, more: str = "") -> int:
    line.expect(line.fields, 1, what + more)
    return line.count_of(line.fields[0], what)


def _read_cameras(file: TextFile, count: int) -> tuple[list[str], list[tuple[Line, list[float]]]]:
    """Names, and the numbers behind them; whether these are poses shows in the number of points."""
    lines: dict[str, int] = {}
    rows: list[tuple[Line, list[float]]] = []
    while len(rows) < count:
        line = file.row()
        if line is None:
            raise file.ended(len(rows), count, "cameras")
        line.expect(line.fields, 11, _CAMERA_FIELDS)
        name = line.name_of(line.fields[0])
        if name in lines:
            raise line.error(f"image {name!r} is listed twice, first in line {lines[name]}")
        lines[name] = line.number
        rows.append((line, line.numbers_of(line.fields[1:], "camera parameter")))
    return list(lines), rows


def _model(
    names: list[str], rows: list[tuple[Line, list[float]]], points: SparsePoints
) -> NvmModel:
    for line, row in rows:
        with line.named():
            row[1:5] = unit_quaternion((row[1], row[2], row[3], row[4]))
    values = np.array([row for _, row in rows])
    return NvmModel(
        tuple(names),
        values[:, 0].copy(),
        values[:, 1:5].copy(),
        values[:, 5:8].copy(),
        0.0 - values[:, 8],  # and no minus zero
        points,
    )


def _read_points(file: TextFile, count: int, num_images: int, *, with_points: bool) -> SparsePoints:
    blocks = file.blocks(count, "points")
    if with_points:
        parse = partial(_parse_points, num_images=num_images)
        return read_points(blocks, parse, partial(_check_point, num_images=num_images))
    for _ in blocks:
        pass
    return SparsePoints.none()


def _parse_points(rows: NumberRows, num_images: int) -> SparsePoints | None:
    """The points of rows of numbers; None where one is no point."""
    if (rows.lengths < _HEAD).any():
        return None
    heads = rows.heads(_HEAD)
    lengths = heads[:, 6]
    if (rows.lengths != _HEAD + 4 * lengths).any() or not are_counts(heads[:, 3:6], 256):
        return None
    observations = rows.tails(_HEAD).reshape(-1, 4)
    good = (
        are_counts(observations[:, 0], num_images)
        and are_counts(observations[:, 1], MAX_FEATURE_ID + 1)
        and (np.abs(observations[:, 2:]) < PIXEL_END).all()
    )
    return SparsePoints.of_rows(heads[:, :6], lengths, observations) if good else None


def _check_point(line: Line, num_images: int) -> None:
    fields = line.fields
    if len(fields) < _HEAD:
        raise line.error(
            "expected a point (X Y Z R G B, number of measurements, measurements), "
            f"got {len(fields)} fields"
        )
    length = line.count_of(fields[6], "the number of measurements")
    if len(fields) != _HEAD + 4 * length:
        raise line.error(
            f"expected {_HEAD + 4 * length} fields for {length} measurements, got {len(fields)}"
        )
    line.numbers_of(fields[:3], "coordinate")
    line.colour_of(fields[3:6])
    for start in range(_HEAD, len(fields), 4):
        line.count_of(fields[start], "image index", num_images)
        line.count_of(fields[start + 1], "feature index", MAX_FEATURE_ID + 1)
        check_pixel(line, fields[start + 2 : start + 4])
