"""NVM files of VisualSFM, as exported by COLMAP and published by challenges.

Cameras have centres instead of translations, and distortion of the opposite sign to COLMAP's. The
file has no image sizes and principal points.
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

    Rotations ``quat_wxyz`` (C, 4) are from world to camera, ``centers`` (C, 3) in the world;
    ``k_colmap`` (C,) is SIMPLE_RADIAL distortion.
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
    """Read the only model of a file; an extra list of unregistered images is ignored."""
    with reading(path), open(path, encoding="utf-8-sig", errors="surrogateescape") as file:
        if not file.readline().startswith("NVM_V3"):
            raise DataError("not an NVM file: the first line must begin with NVM_V3", path=path)
        rows = (line for line in file if line.strip())
        with named(path):
            names, cameras = _read_cameras(rows, _count(rows, "cameras"))
            points = _read_points(rows, _count(rows, "points"), len(names), with_points)
            more = next(rows, "0").strip()
            if more.isdecimal() and list(islice(rows, int(more))) and _count(rows, "points"):
                raise DataError("the file has several models, expected one")
    columns = cameras[:, 0], cameras[:, 1:5], cameras[:, 5:8], 0.0 - cameras[:, 8]  # not -0.0
    return NvmModel(names, *columns, points)


def _count(rows: Iterator[str], what: str) -> int:
    text = next(rows, "").strip()
    require(text.isdecimal(), f"expected the number of {what}, got {text[:40]!r}")
    return int(text)


def _read_cameras(rows: Iterator[str], count: int) -> tuple[tuple[str, ...], NDArray[np.float64]]:
    cameras: dict[str, list[float]] = {}
    for row in islice(rows, count):
        text, *fields = row.split()
        with named(about=f"camera {text!r}"):
            name = check_relative(text.removeprefix("./"))
            try:
                focal, *pose, k, _ = map(float, fields)
                w, x, y, z, *center = pose
            except ValueError as error:
                raise DataError(f"expected 10 numbers: {error}") from error
            values = [focal, *unit_quaternion((w, x, y, z)), *center, k]
            if len(values) != 9 or not np.isfinite(values).all() or name in cameras:
                raise DataError("expected 10 finite numbers, and each image once")
        cameras[name] = values
    require(
        cameras and len(cameras) >= count, f"the file ends after {len(cameras)} of {count} cameras"
    )
    return tuple(cameras), np.array(list(cameras.values()))


def _read_points(rows: Iterator[str], count: int, images: int, with_points: bool) -> SparsePoints:
    """Read rows of X Y Z R G B, the number of observations, and these: image feature x y."""
    parts = []
    while count:
        lines = list(islice(rows, min(_ROWS, count)))
        count -= len(lines)
        require(lines, "the file ends before its last point")
        if with_points:
            parts.append(_parse_points(lines, images))
    return SparsePoints.joined(parts)


def _parse_points(lines: list[str], images: int) -> SparsePoints:
    try:
        values = np.array([value for line in lines for value in line.split()], np.float64)
        starts, at = [], 0
        for _ in lines:
            starts.append(at)
            at += 7 + 4 * int(values[at + 6])
        if at != len(values) or not np.isfinite(values).all():
            raise ValueError("wrong number of fields, or a number that is not finite")
    except (ValueError, IndexError, OverflowError) as error:
        raise DataError(f"broken points from {lines[0][:40]!r} on: {error}") from error
    is_head = np.zeros(len(values), np.bool_)
    is_head[np.array(starts)[:, None] + np.arange(7)] = True
    heads, seen = values[is_head].reshape(-1, 7), values[~is_head].reshape(-1, 4)
    if len(seen) and (seen[:, :2].min() < 0 or seen[:, 0].max() >= images):
        raise DataError(f"a point names an unknown image, from {lines[0][:40]!r} on")
    return SparsePoints.of_rows(heads[:, :6], heads[:, 6], seen)
