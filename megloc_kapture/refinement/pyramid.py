"""Image pyramids and depth points for photometric alignment.

A reference is compared at those pixels of its depth map that have the strongest gradient per grid
cell (Engel et al., "Direct Sparse Odometry", PAMI 2018, section 3.2). Local means exclude masked
pixels (normalised convolution, Knutsson and Westin, CVPR 1993).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import bearing_rays, in_image, project
from megloc_kapture.geometry.warping import PosedImage
from megloc_kapture.values import Camera, RigidTransform

# depth samples along the longer side of a depth map: six per chosen point at a level of 640 px
_GRID = 320
# larger second differences of inverse depth, relative to it, are edges; on planes they are zero
_JUMP = 0.05
# cells of the visibility buffer along an image's longer side
_CELLS = 80
# points whose depth exceeds that of their cell's nearest point by a larger share are occluded;
# within a cell, the depth of slanted ground varies by as much
_HIDES = 0.15
Float64 = NDArray[np.float64]
Seen = tuple[NDArray[np.bool_], ...]
"""Per reference, a mask (N,) of its points that are visible in an image."""
Appearance = Literal["normalised", "colours"]
_BLUR_PX = 0.8  # Gaussian sigma on every level; bilinear interpolation needs smooth values
_WINDOW_PX = 17
# share of the mean local variance that is added to local variances, so that flat areas stay flat
_FLAT = 0.1
_SMALLEST_SIDE_PX = 16
_HALF = 0.5  # a pixel of a level is valid if more than this share of it is unmasked
Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class DepthPoints:
    """World points (N, 3), float64, and their pixels in a reference image (N, 2)."""

    points: Float64
    px: Float64


def lift_points(reference: PosedImage) -> DepthPoints:
    """Back-project sampled pixels of a depth map that its image sees, except at depth edges."""
    camera, depth = reference.camera, reference.depth
    assert depth is not None
    rows, columns, rays = _grid(depth.camera)
    inverse = _inverse_depth(depth.depth_m)
    middle = inverse[rows, columns]
    bend = np.zeros_like(middle)
    h, w = inverse.shape
    for down, across in ((1, 0), (0, 1)):
        # NaN next to pixels without depth
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
        inside = in_image(camera, px)
        points, px = points[inside], px[inside]
        # points behind a depth edge may be hidden from the image's camera
        alone = DepthPoints(points, px)
        (seen,), _ = visibility([alone], camera, RigidTransform.identity())
        points, px = points[seen], px[seen]
    return DepthPoints(reference.cam_from_world.inverse().apply(points), px)


def visibility(
    references: Sequence[DepthPoints], camera: Camera, cam_from_world: RigidTransform
) -> tuple[Seen, NDArray[np.bool_]]:
    """Return the visible points of each reference, and the cells (rows, columns) with a point."""
    from megloc_kapture.refinement.photometric_kernels import camera_of, splat_depths

    sides = np.array([camera.width, camera.height], np.float64)
    cell_px = max(camera.width, camera.height) / _CELLS
    shape = (int(np.ceil(camera.height / cell_px)), int(np.ceil(camera.width / cell_px)))
    nearest = np.full(shape, np.inf)
    rotation, translation = cam_from_world.rotation_matrix(), np.array(cam_from_world.translation)
    seen_by, splats = (camera_of(camera), sides, cell_px, rotation, translation), []
    for reference in references:
        count = len(reference.points)
        cells, depths = np.empty(count, np.int64), np.empty(count)
        splat_depths(reference.points, *seen_by, nearest, cells, depths)
        splats.append((cells, depths))
    limit = nearest.ravel() * (1.0 + _HIDES)
    seen = tuple((cells >= 0) & (depths <= limit[cells]) for cells, depths in splats)
    return seen, np.isfinite(nearest)


def usable_cells(valid: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
    h, w = valid.shape
    rows = ((np.arange(shape[0]) + 0.5) * h / shape[0]).astype(np.int64)
    columns = ((np.arange(shape[1]) + 0.5) * w / shape[1]).astype(np.int64)
    return valid[np.ix_(rows, columns)]


def _inverse_depth(depth_m: NDArray[np.float32]) -> Float64:
    depth = depth_m.astype(np.float64)
    known = np.isfinite(depth) & (depth > 0)
    return np.where(known, 1.0 / np.where(known, depth, 1.0), np.nan)


@lru_cache(maxsize=4)
def _grid(camera: Camera) -> tuple[NDArray[np.int64], NDArray[np.int64], Float64]:
    """Return sampled rows (N,) and columns (N,), and rays (N, 3) of unit depth."""
    stride = max(1, -(-max(camera.width, camera.height) // _GRID))
    sides = (np.arange(stride // 2, n, stride) for n in (camera.height, camera.width))
    grid = np.meshgrid(*sides, indexing="ij")
    rows, columns = (side.ravel().astype(np.int64) for side in grid)
    rays = bearing_rays(camera, np.stack([columns + 0.5, rows + 0.5], axis=1))
    for array in (rows, columns, rays):
        array.setflags(write=False)
    return rows, columns, rays


@dataclass(frozen=True, eq=False)
class Level:
    values: Float32  # float32 (h, w, C)
    valid: NDArray[np.bool_]  # bool (h, w)
    # pixels of the level per pixel of the image: (u, v) is at (u scale_x, v scale_y) of the level,
    # with the first pixel's centre at (0.5, 0.5) in both
    scale_x: float
    scale_y: float

    @cached_property
    def gradient_energy(self) -> Float32:
        """Return the squared gradient over all channels, float32 (h, w); 0 if invalid."""
        values, valid = self.values, self.valid
        energy = np.zeros(valid.shape, np.float32)
        across = values[1:-1, 2:] - values[1:-1, :-2]
        down = values[2:, 1:-1] - values[:-2, 1:-1]
        energy[1:-1, 1:-1] = np.square(across).sum(2) + np.square(down).sum(2)
        inside = valid[1:-1, 1:-1] & valid[1:-1, 2:] & valid[1:-1, :-2] & valid[2:, 1:-1]
        energy[1:-1, 1:-1] *= inside & valid[:-2, 1:-1]
        return energy


def build_pyramid(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None = None,
    *,
    levels: int = 3,
    max_side_px: int = 640,
    appearance: Appearance = "normalised",
) -> list[Level]:
    """Build the levels of an RGB image, finest first; sides of coarser levels are at least 16 px.

    ``normalised`` is brightness with zero mean and unit deviation in a window around each pixel,
    ``colours`` are red, green and blue normalised likewise.
    """
    height, width = image.shape[:2]
    used = np.ones((height, width), np.float32) if mask is None else mask.astype(np.float32)
    seen = image if appearance == "colours" else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    values = (seen.astype(np.float32) * np.float32(1 / 255)).reshape(height, width, -1)
    values = values * used[..., None]
    longer = max(values.shape[:2])
    if longer > max_side_px:
        size = [max(1, round(side * max_side_px / longer)) for side in values.shape[1::-1]]
        values, used = _resized(values, *size), _resized(used, *size)
    result: list[Level] = []
    while True:
        values, smooth_used = _blurred(values, _BLUR_PX), _blurred(used, _BLUR_PX)
        h, w = used.shape
        known = smooth_used > 1e-3
        mean = np.where(
            known[..., None], values / np.where(known, smooth_used, 1.0)[..., None], 0.0
        ).astype(np.float32)
        mean = np.concatenate([_normalised(each, used) for each in np.moveaxis(mean, 2, 0)], 2)
        result.append(Level(np.ascontiguousarray(mean), used > _HALF, w / width, h / height))
        if len(result) == levels or min(h, w) < 2 * _SMALLEST_SIDE_PX:
            return result
        values, used = (_resized(each, w // 2, h // 2) for each in (values, smooth_used))


def _resized(values: Float32, width: int, height: int) -> Float32:
    if values.shape[1::-1] == (width, height):
        return values
    smaller = cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(smaller, np.float32).reshape(height, width, *values.shape[2:])


def _blurred(values: Float32, deviation_px: float) -> Float32:
    blurred = cv2.GaussianBlur(values, (0, 0), deviation_px)
    return np.asarray(blurred, np.float32).reshape(values.shape)


def _box_mean(values: Float32) -> Float32:
    return np.asarray(cv2.blur(values, (_WINDOW_PX, _WINDOW_PX)), np.float32)


def _normalised(plane: Float32, used: Float32) -> Float32:
    share = np.maximum(_box_mean(used), np.float32(1e-3))
    mean = _box_mean(plane * used) / share
    centred = np.asarray(plane - mean, np.float32)
    # each pixel is centred by the mean of its own window, which is close to its neighbours' means
    variance = _box_mean(centred * centred * used) / share
    floor = _FLAT * float(np.average(variance, weights=used)) if used.any() else 0.0
    result = centred / np.sqrt(variance + np.float32(max(floor, 1e-8)))
    return np.asarray(result, np.float32)[..., None]


@dataclass(frozen=True, eq=False)
class ChosenPoints:
    points: Float64  # float64 (N, 3), in the world
    values: Float64  # float64 (N, C)
    groups: NDArray[np.int64]  # int64 (N,), reference of each point

    def subset(self, which: NDArray[Any]) -> ChosenPoints:
        return ChosenPoints(self.points[which], self.values[which], self.groups[which])


def choose_points(
    references: Sequence[DepthPoints],
    levels: Sequence[Level],
    wanted: Sequence[NDArray[np.bool_]],
    max_points: int,
) -> ChosenPoints:
    """Choose about ``max_points`` evenly spread points of each reference, with their values."""
    from megloc_kapture.refinement.photometric_kernels import read_values, strongest_per_cell

    points, values, groups = [], [], []
    for group, (reference, level, ours) in enumerate(zip(references, levels, wanted, strict=True)):
        h, w = level.valid.shape
        cell_px = max(1.0, float(np.sqrt(h * w / max_points)))
        best = np.empty((int(np.ceil(h / cell_px)), int(np.ceil(w / cell_px))), np.int64)
        x, y = reference.px[:, 0] * level.scale_x, reference.px[:, 1] * level.scale_y
        strongest_per_cell(x, y, level.gradient_energy, ours, cell_px, best)
        rows = best[best >= 0]
        read, readable = np.empty((len(rows), level.values.shape[2])), np.empty(len(rows), np.bool_)
        read_values(level.values, level.valid, x[rows] - 0.5, y[rows] - 0.5, read, readable)
        points.append(reference.points[rows[readable]])
        values.append(read[readable])
        groups.append(np.full(int(readable.sum()), group, np.int64))
    return ChosenPoints(np.concatenate(points), np.concatenate(values), np.concatenate(groups))
