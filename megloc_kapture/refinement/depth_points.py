"""Points of depth maps: the cloud that ICP fits, and what photometric alignment warps into a query.

ICP takes every pixel that a depth sensor measures well (:func:`depth_cloud`). A reference image of
the photometric alignment is compared at pixels of its depth map (:func:`lift_points`), so that the
depth camera may be another one than the image's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import bearing_rays, pixel_rays, project, px_from_cam
from megloc_kapture.plugins import DepthView
from megloc_kapture.values import Camera, Options, RigidTransform

Floats = NDArray[np.float64]
# depth pixels looked at along the longer side of a depth map; about four per point
_GRID = 320
# second difference of inverse depth, over it, from which a pixel is on an edge: planes have none
_JUMP = 0.05
# cells of an image in which the nearest surface hides others, along its longer side
_CELLS = 80
# a point hides those that are further by more than this share: a cell of slanted ground has as much
_HIDES = 0.15
Float64 = NDArray[np.float64]


class DepthCloudOptions(Options):
    """Options: depths that are trusted."""

    max_depth_m: float = Field(
        default=4.0,
        gt=0,
        description="metres; farther ones are dropped. A structured-light sensor's noise grows "
        "with the square of the distance and is 2.6 cm here, the end of its rated range; a "
        "laser's does not, raise it",
    )
    max_jump: float = Field(
        default=0.05,
        gt=0,
        description="a pixel is on an edge, and dropped, where a neighbour's depth differs by "
        "more than this share of the smaller; on a plane at 80 degrees the steps of a sensor with "
        "a focal length of 585 px are 0.014",
    )


def depth_cloud(
    view: DepthView,
    options: DepthCloudOptions | None = None,
    *,
    image_camera: Camera | None = None,
    image_mask: NDArray[np.bool_] | None = None,
    step_px: int = 1,
) -> Floats:
    """Points of a depth map in the frame of the image that it was taken with.

    Left out are pixels without depth (0, less, or not finite), beyond the greatest depth, beside a
    jump in depth (a sensor smears edges: Khoshelham and Elberink, Sensors 12(2), 2012), and points
    that the image's mask hides.

    Parameters
    ----------
    image_camera, image_mask : camera of the image, and its mask, bool (H, W), True = use; points
        that lie outside of the image stay.
    step_px : take every such pixel, along both axes.

    Returns
    -------
    points : float64 (N, 3) in the image camera's frame, metres, by rows of the depth map.
    """
    options = options or DepthCloudOptions()
    depth = np.asarray(view.depth_m, np.float32)
    sampled = np.s_[step_px // 2 :: step_px, step_px // 2 :: step_px]
    z = depth[sampled]
    with np.errstate(invalid="ignore"):
        trusted = (z > 0) & (z <= options.max_depth_m) & ~_on_edge(depth, sampled, options.max_jump)
    rows = np.arange(depth.size).reshape(depth.shape)[sampled][trusted]
    points = view.image_from_depth.apply(
        pixel_rays(view.camera)[rows] * z[trusted].astype(np.float64)[:, None]
    )
    if image_camera is None or image_mask is None:
        return points
    return points[~_hidden(points, image_camera, image_mask)]


def _on_edge(
    depth: NDArray[np.float32], sampled: tuple[slice, slice], max_jump: float
) -> NDArray[np.bool_]:
    """Mask of the sampled pixels with one of eight neighbours far before or behind them."""
    height, width = depth.shape
    padded = np.pad(depth, 1)
    z, limit = depth[sampled], np.float32(1.0 + max_jump)
    edge = np.zeros(z.shape, bool)
    with np.errstate(invalid="ignore"):
        for down, right in product((0, 1, 2), (0, 1, 2)):
            other = padded[down : down + height, right : right + width][sampled]
            # one without depth, 0 or NaN, says nothing
            edge |= (other > limit * z) | ((other > 0) & (limit * other < z))
    return edge


def _hidden(points: Floats, camera: Camera, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Points (N,) in the camera's frame that lie on False pixels of the mask."""
    pixels = px_from_cam(camera, points)
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
    column, row = pixels[inside].astype(np.int64).T
    hidden = np.zeros(len(points), bool)
    hidden[inside] = ~mask[row, column]
    return hidden


@dataclass(frozen=True, eq=False)
class DepthPoints:
    """Points that a reference image sees.

    Attributes
    ----------
    points : float64 (N, 3), in the world.
    px : float64 (N, 2), where the reference image shows them.
    """

    points: Float64
    px: Float64


@dataclass(frozen=True, eq=False)
class Visibility:
    """Points of several references that a camera sees.

    Attributes
    ----------
    seen : per reference bool (N,), the points inside the image that no other hides.
    covered : bool (rows, columns), the cells of the image in which there is a point.
    """

    seen: tuple[NDArray[np.bool_], ...]
    covered: NDArray[np.bool_]


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
    """Points of several references that a camera sees, by a coarse z-buffer."""
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
    """Mask (rows, columns) of the cells of an image that are valid in their middle."""
    h, w = valid.shape
    rows = ((np.arange(shape[0]) + 0.5) * h / shape[0]).astype(np.int64)
    columns = ((np.arange(shape[1]) + 0.5) * w / shape[1]).astype(np.int64)
    return valid[np.ix_(rows, columns)]


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
