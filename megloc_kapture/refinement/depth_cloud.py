"""Depth maps to clouds of points, without what depth sensors get wrong near edges and far away."""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.geometry.cameras import bearing_rays, px_from_cam
from megloc_kapture.plugins import DepthView
from megloc_kapture.values import Camera, Options

Floats = NDArray[np.float64]


class DepthCloudOptions(Options):
    """Which depths are trusted."""

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
        _rays(view.camera)[rows] * z[trusted].astype(np.float64)[:, None]
    )
    if image_camera is None or image_mask is None:
        return points
    return points[~_hidden(points, image_camera, image_mask)]


def _on_edge(
    depth: NDArray[np.float32], sampled: tuple[slice, slice], max_jump: float
) -> NDArray[np.bool_]:
    """Which sampled pixels have one of eight neighbours far before or behind them."""
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


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> Floats:
    """Rays (H * W, 3) with z = 1 through the centres of a camera's pixels, row by row."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = bearing_rays(camera, np.column_stack([x.ravel(), y.ravel()]))
    rays.flags.writeable = False
    return rays
