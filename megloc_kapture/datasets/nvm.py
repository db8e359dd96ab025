"""NVM files of VisualSFM, as exported by COLMAP and published by challenges.

Cameras have centres instead of translations. The sign of the distortion is opposite to COLMAP's.
The file has neither image sizes nor principal points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.colmap_model import SparsePoints
from megloc_kapture.io.files import check_relative, named, reading
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.values import RigidTransform

_ROWS = 50_000  # points parsed at once


@dataclass(frozen=True, eq=False)
class NvmModel:
    """A model of C images; the image ids of ``points`` are positions in ``names``.

    Rotations ``quat_wxyz`` (C, 4) are from world to camera; camera ``centers`` (C, 3) are in the
    world frame. ``k_colmap`` (C,) is the distortion parameter of SIMPLE_RADIAL.
    """

    names: tuple[str, ...]
    focal_px: NDArray[np.float64]
    quat_wxyz: NDArray[np.float64]
    centers: NDArray[np.float64]
    k_colmap: NDArray[np.float64]
    points: SparsePoints

    def cam_from_world(self, index: int) -> RigidTransform:
        w, x, y, z = self.quat_wxyz[index].tolist()
        rotation = RigidTransform((w, x, y, z), (0.0, 0.0, 0.0)).rotation_matrix()
        tx, ty, tz = (-rotation @ self.centers[index]).tolist()
        return RigidTransform((w, x, y, z), (tx, ty, tz))


def read_nvm(path: Path, *, with_points: bool = True) -> NvmModel:
    """Read a file with one model.

    A second model without points, which lists unregistered images, is ignored.
    """
    with (
        reading(path, "an NVM file"),
        named(path),
        open(path, encoding="utf-8-sig", errors="surrogateescape") as file,
    ):
        require(file.readline().startswith("NVM_V3"), "the first line must begin with NVM_V3")
        rows = (line for line in file if line.strip())
        names, cameras = _read_cameras(rows, int(next(rows, "")))
        points = _read_points(rows, int(next(rows, "")), len(names), with_points)
        more = next(rows, "0").strip()
        if more.isdecimal() and list(islice(rows, int(more))) and int(next(rows, "0")):
            raise DataError("the file has several models, expected one")
    columns = cameras[:, 0], cameras[:, 1:5], cameras[:, 5:8], 0.0 - cameras[:, 8]  # not -0.0
    return NvmModel(names, *columns, points)


def _read_cameras(rows: Iterator[str], count: int) -> tuple[tuple[str, ...], NDArray[np.float64]]:
    cameras: dict[str, list[float]] = {}
    for row in islice(rows, count):
        name, *fields = row.rsplit(maxsplit=10)  # the name may contain spaces
        with named(about=f"camera {name!r}"):
            focal, w, x, y, z, *center, k, _ = map(float, fields)
            quat_wxyz = unit_quaternion((w, x, y, z))
            cameras[check_relative(name.removeprefix("./"))] = [focal, *quat_wxyz, *center, k]
    require(count, "the model has no images")
    require(
        len(cameras) == count,
        f"found {len(cameras)} different images, expected {count}",
    )
    values = np.array(list(cameras.values())).reshape(-1, 9)
    require(np.isfinite(values).all(), "camera values are not finite")
    return tuple(cameras), values


def _read_points(rows: Iterator[str], count: int, images: int, with_points: bool) -> SparsePoints:
    """Read rows of X Y Z R G B, number of observations, and image, feature, x, y for each."""
    parts = []
    while count:
        lines = list(islice(rows, min(_ROWS, count)))
        count -= len(lines)
        require(lines, "the file ends before its last point")
        if with_points:
            parts.append(_parse_points(lines, images))
    return SparsePoints.joined(parts)


def _parse_points(lines: list[str], images: int) -> SparsePoints:
    values = np.array([value for line in lines for value in line.split()], np.float64)
    starts, at = [], 0
    for _ in lines:
        starts.append(at)
        at += 7 + 4 * int(values[at + 6])
    is_head = np.zeros(len(values), np.bool_)
    is_head[np.array(starts)[:, None] + np.arange(7)] = True
    heads, seen = values[is_head].reshape(-1, 7), values[~is_head].reshape(-1, 4)
    require(
        at == len(values)
        and np.isfinite(values).all()
        and (seen[:, :2] >= 0).all()
        and (seen[:, 0] < images).all(),
        f"a point is malformed or names an unknown image, in or after the line {lines[0][:40]!r}",
    )
    return SparsePoints.of_rows(heads[:, :6], heads[:, 6], seen)
