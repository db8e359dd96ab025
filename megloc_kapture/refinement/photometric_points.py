"""The points of reference images that photometric alignment compares: lifted by depth, chosen.

A reference image is compared at points and not at all its pixels: those with the strongest gradient
in the cells of a grid, as direct odometry chooses them (Engel et al., "Direct Sparse Odometry",
PAMI 2018, section 3.2). A point is a pixel of the depth map, so that the depth camera may be
another one than the image's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import bearing_rays, project
from megloc_kapture.plugins import DepthView
from megloc_kapture.refinement.photometric_pyramid import Level
from megloc_kapture.values import Camera, RigidTransform

# depth pixels looked at along the longer side of a depth map; about four per point
_GRID = 320
# second difference of inverse depth, over it, from which a pixel is on an edge: planes have none
_JUMP = 0.05
# cells of an image in which the nearest surface hides others, along its longer side
_CELLS = 80
# a point hides those that are further by more than this share: a cell of slanted ground has as much
_HIDES = 0.15

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DepthPoints:
    """What a reference image sees.

    Attributes
    ----------
    points : float64 (N, 3), in the world.
    px : float64 (N, 2), where the reference image shows them.
    """

    points: Float64
    px: Float64


@dataclass(frozen=True, eq=False)
class Visibility:
    """What of several references a camera sees.

    Attributes
    ----------
    seen : per reference bool (N,), the points inside the image that no other hides.
    covered : bool (rows, columns), the cells of the image in which there is a point.
    """

    seen: tuple[NDArray[np.bool_], ...]
    covered: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class ChosenPoints:
    """Points of several references at one level of their pyramids.

    Attributes
    ----------
    points : float64 (N, 3), in the world.
    values : float64 (N, C), in their reference.
    groups : int64 (N,), of which reference each is.
    """

    points: Float64
    values: Float64
    groups: NDArray[np.int64]

    def thinned(self, most: int) -> ChosenPoints:
        """At most so many of them, still evenly spread."""
        step = max(1, -(-len(self.points) // most))
        return self.subset(np.arange(0, len(self.points), step))

    def subset(self, which: NDArray[Any]) -> ChosenPoints:
        """Those of a mask (N,) or of rows."""
        return ChosenPoints(self.points[which], self.values[which], self.groups[which])


def lift_points(camera: Camera, cam_from_world: RigidTransform, depth: DepthView) -> DepthPoints:
    """Points of a depth map that its image sees; none on edges of depth.

    Parameters
    ----------
    camera, cam_from_world : of the image.
    depth : taken with it.

    Raises
    ------
    DataError : the depth map has not the size of its camera.
    """
    if depth.depth_m.shape != (depth.camera.height, depth.camera.width):
        raise DataError(
            f"a depth map of {depth.depth_m.shape} does not fit a camera of "
            f"{depth.camera.width}x{depth.camera.height}"
        )
    rows, columns, rays = _grid(depth.camera)
    inverse = _inverse_depth(depth.depth_m)
    middle = inverse[rows, columns]
    bend = np.zeros_like(middle)
    h, w = inverse.shape
    for down, across in ((1, 0), (0, 1)):
        # NaN, thus no point, beside a pixel without depth
        after = inverse[np.minimum(rows + down, h - 1), np.minimum(columns + across, w - 1)]
        before = inverse[np.maximum(rows - down, 0), np.maximum(columns - across, 0)]
        bend = np.maximum(bend, np.abs(after + before - 2 * middle))
    with np.errstate(invalid="ignore"):
        smooth = bend <= _JUMP * middle
    points = rays[smooth] / middle[smooth, None]
    if depth.camera == camera and depth.image_from_depth == RigidTransform.identity():
        px = np.stack([columns[smooth] + 0.5, rows[smooth] + 0.5], axis=1)
    else:
        points = depth.image_from_depth.apply(points)
        px = project(camera, RigidTransform.identity(), points)
        inside = ((px >= 0) & (px < (camera.width, camera.height))).all(1)
        points, px = points[inside], px[inside]
        # what the depth camera sees past an edge may be hidden from the image
        alone = DepthPoints(points, px)
        seen = visibility([alone], camera, RigidTransform.identity()).seen[0]
        points, px = points[seen], px[seen]
    return DepthPoints(cam_from_world.inverse().apply(points), px)


def visibility(
    references: Sequence[DepthPoints], camera: Camera, cam_from_world: RigidTransform
) -> Visibility:
    """What a camera sees of the points of several references, by a coarse z-buffer."""
    from megloc_kapture.refinement.photometric_kernels import camera_of, splat_depths

    cell_px = max(camera.width, camera.height) / _CELLS
    shape = (
        int(np.ceil(camera.height / cell_px)),
        int(np.ceil(camera.width / cell_px)),
    )
    nearest = np.full(shape, np.inf)
    rotation, translation = (
        cam_from_world.rotation_matrix(),
        np.array(cam_from_world.translation),
    )
    packed = camera_of(camera)
    splats = []
    for reference in references:
        count = len(reference.points)
        cells, depths = np.empty(count, np.int64), np.empty(count)
        splat_depths(
            reference.points,
            packed,
            np.array([camera.width, camera.height], np.float64),
            cell_px,
            rotation,
            translation,
            nearest,
            cells,
            depths,
        )
        splats.append((cells, depths))
    limit = nearest.ravel() * (1.0 + _HIDES)
    seen = tuple((cells >= 0) & (depths <= limit[cells]) for cells, depths in splats)
    return Visibility(seen, np.isfinite(nearest))


def usable_cells(valid: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Which of the cells of an image, (rows, columns), are valid in their middle."""
    h, w = valid.shape
    rows = ((np.arange(shape[0]) + 0.5) * h / shape[0]).astype(np.int64)
    columns = ((np.arange(shape[1]) + 0.5) * w / shape[1]).astype(np.int64)
    return valid[np.ix_(rows, columns)]


def choose_points(
    references: Sequence[DepthPoints],
    levels: Sequence[Level],
    wanted: Sequence[NDArray[np.bool_]],
    max_points: int,
) -> ChosenPoints:
    """At most ``max_points`` of each reference, evenly spread, with their values at a level.

    Parameters
    ----------
    levels : of each reference, of one kind.
    wanted : bool (N,) of each reference: those to choose from.
    """
    from megloc_kapture.refinement.photometric_kernels import (
        read_values,
        strongest_per_cell,
    )

    points, values, groups = [], [], []
    for group, (reference, level, ours) in enumerate(zip(references, levels, wanted, strict=True)):
        h, w = level.valid.shape
        cell_px = max(1.0, float(np.sqrt(h * w / max_points)))
        best = np.empty((int(np.ceil(h / cell_px)), int(np.ceil(w / cell_px))), np.int64)
        x, y = reference.px[:, 0] * level.scale_x, reference.px[:, 1] * level.scale_y
        strongest_per_cell(x, y, level.gradient_energy, ours, cell_px, best)
        rows = best[best >= 0]
        read, found = (
            np.empty((len(rows), level.values.shape[2])),
            np.empty(len(rows), np.bool_),
        )
        read_values(level.values, level.valid, x[rows] - 0.5, y[rows] - 0.5, read, found)
        points.append(reference.points[rows[found]])
        values.append(read[found])
        groups.append(np.full(int(found.sum()), group, np.int64))
    return ChosenPoints(np.concatenate(points), np.concatenate(values), np.concatenate(groups))


def _inverse_depth(depth_m: NDArray[np.float32]) -> Float64:
    """1/m, NaN where nothing is known."""
    depth = depth_m.astype(np.float64)
    known = np.isfinite(depth) & (depth > 0)
    return np.where(known, 1.0 / np.where(known, depth, 1.0), np.nan)


@lru_cache(maxsize=4)
def _grid(camera: Camera) -> tuple[NDArray[np.int64], NDArray[np.int64], Float64]:
    """Rows (N,) and columns (N,) of the pixels looked at, and their rays (N, 3) of unit depth."""
    stride = max(1, -(-max(camera.width, camera.height) // _GRID))
    grid = np.meshgrid(
        np.arange(stride // 2, camera.height, stride),
        np.arange(stride // 2, camera.width, stride),
        indexing="ij",
    )
    rows, columns = (side.ravel().astype(np.int64) for side in grid)
    rays = bearing_rays(camera, np.stack([columns + 0.5, rows + 0.5], axis=1))
    for array in (rows, columns, rays):
        array.setflags(write=False)
    return rows, columns, rays
