"""Warping of reference images with depth into another view, with a z-buffer.

Each reference's depth map is drawn as a surface into the view. Every pixel then takes the colour of
the nearest surface from one of the references that see it, by bilinear interpolation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import (
    bearing_rays,
    focal_px,
    pixel_rays,
    px_from_cam,
    scaled_camera,
    values_at,
)
from megloc_kapture.plugins import DepthView, RankingScene
from megloc_kapture.values import Camera, RigidTransform

_NEAR_M = 0.02  # surfaces nearer than this to the view's camera are not drawn
# references see the same surface if their depths in the view differ by less than this share
_SAME_SURFACE = 0.02
_MAX_JUMP = 0.05  # largest step between neighbouring depths of a surface, as a share of the nearer
# rays farther off the axis than the image's corners by this factor are not projected: the
# distortion model may fold over outside the image
_FIELD_MARGIN = 1.2
_SAME_CENTRE_M = 1e-9  # smaller offsets are rounding of composed transforms
_PER_ROW = 1024
_WHOLE = 0.999  # minimum bilinear weight on usable pixels

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image uint8 (H, W, 3) with a pose, and optional depth and mask (H, W), True = use.

    The depth map may be from another camera.
    """

    image: NDArray[np.uint8]
    camera: Camera
    cam_from_world: RigidTransform
    depth: DepthView | None = None
    mask: NDArray[np.bool_] | None = None
    name: str = ""


def image_with_depth(name: str, scene: RankingScene) -> PosedImage | None:
    """Return a map image; None without depth."""
    depth = scene.map_depth(name)
    if depth is None:
        return None
    image, camera = scene.map_image(name), scene.map_camera(name)
    return PosedImage(image, camera, scene.map_pose(name), depth, scene.map_mask(name), name)


@dataclass(frozen=True, eq=False)
class WarpedView:
    """A view rendered from references: RGB uint8 (H, W, 3), depth float32 (H, W).

    ``source`` is the index of the reference that gives the colour. Pixels that are not ``valid``
    (holes, back faces, surfaces that no reference sees) are black and have source -1. Depth is 0
    only in holes.
    """

    image: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    depth_m: NDArray[np.float32]
    source: NDArray[np.int16]


def warp_to_view(
    sources: Sequence[PosedImage],
    camera: Camera,
    cam_from_world: RigidTransform,
    *,
    scale: float = 1.0,
) -> WarpedView:
    """Warp images with depth into a view of any camera model, rendered at ``scale`` times its size.

    Of the references that see a pixel's surface, the one with the smallest sum of viewing angle and
    loss of resolution gives the colour; ties go to the first.
    """
    camera = scaled_camera(camera, scale)
    shape = camera.height, camera.width
    drawn = [_seen_depth(source, camera, cam_from_world) for source in sources]
    nearest = np.full(shape, np.inf)
    for depth, _ in drawn:
        np.minimum(nearest, depth, out=nearest)
    image = np.zeros((*shape, 3), np.uint8)
    best = np.full(shape, np.inf)
    chosen = np.full(shape, -1, np.int16)
    rays = pixel_rays(camera)
    centre = cam_from_world.center()
    for number, (source, (depth, front)) in enumerate(zip(sources, drawn, strict=True)):
        rows = np.flatnonzero(
            (front & np.isfinite(depth) & (depth <= (1.0 + _SAME_SURFACE) * nearest)).ravel()
        )
        points = cam_from_world.inverse().apply(rays[rows] * depth.ravel()[rows, None])
        colour, usable = _look_up(source, points, focal_px(camera))
        cost = np.where(usable, _cost(points, centre, source.cam_from_world.center()), np.inf)
        better = cost < best.ravel()[rows]
        rows = rows[better]
        image.reshape(-1, 3)[rows] = colour[better]
        best.ravel()[rows] = cost[better]
        chosen.ravel()[rows] = number
    depth_m = np.where(np.isfinite(nearest), nearest, 0.0).astype(np.float32)
    return WarpedView(image, chosen >= 0, depth_m, chosen)


def _seen_depth(
    source: PosedImage, camera: Camera, cam_from_world: RigidTransform
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the depth (H, W) of a reference's surface in a view, and a mask of front faces."""
    from megloc_kapture.geometry.projection import draw_depth_surface

    assert source.depth is not None
    return draw_depth_surface(
        source.depth.depth_m,
        pixel_rays(source.depth.camera),
        cam_from_world @ source.cam_from_world.inverse() @ source.depth.image_from_depth,
        camera,
        max_jump=_MAX_JUMP,
        near_m=_NEAR_M,
        field=_field(camera),
    )


@lru_cache(maxsize=8)
def _field(camera: Camera) -> float:
    # corners and midpoints of the image border
    grid = np.stack(np.meshgrid([0.0, 0.5, 1.0], [0.0, 0.5, 1.0]), axis=-1).reshape(-1, 2)
    border = np.delete(grid, 4, axis=0) * (camera.width, camera.height)
    rays = bearing_rays(camera, border)
    reach = np.hypot(rays[:, 0], rays[:, 1]).max()
    return float(_FIELD_MARGIN * reach) if np.isfinite(reach) else np.inf


def _look_up(
    source: PosedImage, points: Floats, focal: float
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return colours uint8 (N, 3) of world points in a reference, and a visibility mask (N,)."""
    image, mask, shrink = _at_resolution(source, focal)
    in_camera = source.cam_from_world.apply(points)
    px = px_from_cam(source.camera, in_camera)
    usable = np.asarray(np.isfinite(px).all(axis=1))
    assert source.depth is not None
    if np.linalg.norm(source.depth.image_from_depth.translation) > _SAME_CENTRE_M:
        usable &= _not_hidden(source, in_camera, px)
    # in OpenCV, the centre of the first pixel is (0, 0)
    in_array = np.where(usable[:, None], px, -1e4) * shrink - 0.5
    x, y = np.ascontiguousarray(in_array.T, np.float32)
    height, width = image.shape[:2]
    # the image extends half a pixel beyond the outer pixel centres
    usable &= (x >= -0.5) & (y >= -0.5) & (x <= width - 0.5) & (y <= height - 0.5)
    colour = _remap(image, x, y)
    if mask is not None:
        usable &= _remap(mask, x, y) >= _WHOLE
    return colour.reshape(-1, 3), usable


def _remap(array: NDArray[Any], x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[Any]:
    """Sample an array (H, W, ...) bilinearly at N positions."""
    if not len(x):
        return np.zeros((0, *array.shape[2:]), array.dtype)
    # fold the positions into rows, as OpenCV allows at most 32767 columns
    missing = -len(x) % _PER_ROW
    x, y = (np.pad(v, (0, missing)).reshape(-1, _PER_ROW) for v in (x, y))
    remapped = cv2.remap(array, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(remapped).reshape(-1, *array.shape[2:])[: x.size - missing]


def _at_resolution(
    source: PosedImage, focal: float
) -> tuple[NDArray[np.uint8], NDArray[np.float32] | None, Floats]:
    """Return image and mask, reduced if their resolution exceeds the view's, and the scale (2,)."""
    height, width = source.image.shape[:2]
    factor = min(1.0, focal / focal_px(source.camera))
    mask = None if source.mask is None else source.mask.astype(np.float32)
    if factor >= 1.0:
        return source.image, mask, np.ones(2)
    size = max(1, round(width * factor)), max(1, round(height * factor))
    image = np.asarray(cv2.resize(source.image, size, interpolation=cv2.INTER_AREA), np.uint8)
    if mask is not None:
        mask = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_AREA), np.float32)
    return image, mask, np.array(size) / (width, height)


def _not_hidden(source: PosedImage, in_camera: Floats, px: Floats) -> NDArray[np.bool_]:
    """Return a mask (N,) of the points, seen by the depth sensor, that the image also sees."""
    surface, _ = _seen_depth(source, source.camera, source.cam_from_world)
    nearest = values_at(surface, source.camera, px, outside=-np.inf)
    return in_camera[:, 2] <= (1.0 + _SAME_SURFACE) * nearest


def _cost(points: Floats, view_centre: Floats, source_centre: Floats) -> Floats:
    """Return the angle between the two rays to each point plus the log of the loss of resolution.

    The angle is in radians; the loss is the ratio of the distances, if above 1.
    """
    to_view, to_source = view_centre - points, source_centre - points
    near, far = np.linalg.norm(to_view, axis=1), np.linalg.norm(to_source, axis=1)
    sine = np.linalg.norm(np.cross(to_view, to_source), axis=1)
    angle = np.arctan2(sine, (to_view * to_source).sum(axis=1))
    return angle + np.log(np.maximum(far / np.maximum(near, 1e-9), 1.0))
