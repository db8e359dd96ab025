"""Views for stereo: undistortion, choice of sources, and consistency of depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import (
    PINHOLE_MODELS,
    pixel_rays,
    px_from_cam,
    reduced_camera,
    with_two_focals,
)
from megloc_kapture.io.colmap import undistorted_pinhole
from megloc_kapture.plugins import DepthEstimate, StereoView
from megloc_kapture.values import Camera, RigidTransform

Floats = NDArray[np.float64]
Projections = Sequence[tuple[Floats, Floats]]

# best triangulation angles: below these, depth is uncertain; above, surfaces look different (after
# Schoenberger et al., ECCV 2016, section 4.1, and MVSNet)
_BEST_ANGLES_DEG = (5.0, 20.0)
_WIDENED = (0.8, 1.25)
_MIN_REGION_PX = 40  # in smaller islands, views agree by chance
# number of other views that must confirm a pixel; with 2, a tenth of the pixels are lost, and the
# share of depths with an error below 2 cm rises by only one percent
_MIN_VIEWS = 1
# views agree if a pixel projected to another view and back returns within the first value, and the
# relative difference of depth is at most the second times the first (docs/experiments/mvs.md)
TOLERANCE_PX, _RELATIVE_PER_PX = 1.0, 0.01
# largest relative standard deviation of depth; surfaces without texture exceed it
_MAX_RELATIVE_SIGMA = 0.03


def stereo_camera(camera: Camera, max_size_px: int) -> Camera:
    if camera.model not in PINHOLE_MODELS:
        camera = undistorted_pinhole(camera)
    return replace(reduced_camera(with_two_focals(camera), max_size_px), focal_deviation=0.0)


def pinhole_matrix(camera: Camera) -> Floats:
    """Return K (3, 3) of a PINHOLE camera with the first pixel's centre at (0, 0)."""
    fx, fy, cx, cy = camera.params
    return np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])


def relative_projection(reference: StereoView, source: StereoView) -> tuple[Floats, Floats]:
    """Return ``infinity`` (3, 3) and ``baseline`` (3,), see :mod:`megloc_kapture.mvs.sweep`."""
    source_from_reference = source.cam_from_world @ reference.cam_from_world.inverse()
    k, k_source = pinhole_matrix(reference.camera), pinhole_matrix(source.camera)
    infinity = k_source @ source_from_reference.rotation_matrix() @ np.linalg.inv(k)
    return infinity, k_source @ np.array(source_from_reference.translation)


def pixel_step(projections: Projections, camera: Camera, limits: Floats) -> float:
    """Return the inverse depth step of about one pixel in the most sensitive source.

    The pixels per step are averaged between the ``limits`` of inverse depth; the result is for the
    median over the image.
    """
    x, y = np.meshgrid(*(np.linspace(0.1, 0.9, 5) * n for n in (camera.width, camera.height)))
    pixels = np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    steps = np.linspace(limits[0], limits[1], 17)[:, None]
    longest = 1.0
    for infinity, baseline in projections:
        path = (infinity @ pixels)[:, None] + steps * baseline[:, None, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            px = np.where(path[2] > 1e-6, path[:2] / path[2], np.nan)
        lengths = np.nansum(np.linalg.norm(np.diff(px, axis=1), axis=0), axis=0)
        longest = max(longest, float(np.median(lengths)))
    return float(limits[1] - limits[0]) / longest


def stereo_view(
    image: NDArray[np.uint8],
    camera: Camera,
    cam_from_world: RigidTransform,
    mask: NDArray[np.bool_] | None,
    max_size_px: int,
) -> StereoView:
    """Undistort an image for stereo; mask bool (H, W), True = use."""
    pinhole = stereo_camera(camera, max_size_px)
    if camera.model in PINHOLE_MODELS:
        return reduced_view(StereoView(image, camera, cam_from_world, mask), pinhole)
    # reduce first, to avoid aliasing
    lens = reduced_camera(camera, max(pinhole.width, pinhole.height))
    # pixels of the pinhole image in the lens image's array, whose first pixel's centre is (0, 0)
    px = np.nan_to_num(px_from_cam(lens, pixel_rays(pinhole)) - 0.5, nan=-1e4).astype(np.float32)
    x, y = (side.reshape(pinhole.height, pinhole.width) for side in px.T)
    reduced = cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    small = np.asarray(cv2.remap(reduced, x, y, cv2.INTER_LINEAR), np.uint8)
    allowed = np.ones(image.shape[:2], np.float32) if mask is None else mask.astype(np.float32)
    size = lens.width, lens.height
    allowed = np.asarray(cv2.resize(allowed, size, interpolation=cv2.INTER_AREA), np.float32)
    seen = np.asarray(cv2.remap(allowed, x, y, cv2.INTER_LINEAR) > 0.999)
    return StereoView(small, pinhole, cam_from_world, None if seen.all() else seen)


def reduced_view(view: StereoView, camera: Camera) -> StereoView:
    """Reduce image and mask to the size of a camera."""
    size, image, mask = (camera.width, camera.height), view.image, view.mask
    if size != (view.camera.width, view.camera.height):
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        if mask is not None:
            mask = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
    return StereoView(image, camera, view.cam_from_world, mask)


def choose_sources(
    image: int,
    candidates: NDArray[np.bool_],
    xyz: Floats,
    points_of: list[NDArray[np.int64]],
    images_of: tuple[NDArray[np.int64], NDArray[np.int64]],
    centers: Floats,
    count: int,
) -> list[int]:
    """Choose at most ``count`` sources for an image, best first, by shared points and angles.

    A shared point has weight 1 at 5 to 20 degrees, else the squared ratio of its angle to 5 degrees
    or of 20 degrees to its angle. ``points_of``: rows of ``xyz`` per image; ``images_of``: index of
    each point's first observation (N + 1,), and the images (O,) of the observations, sorted by
    point.
    """
    starts, images = images_of
    points = points_of[image]
    counts = starts[points + 1] - starts[points]
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    others = images[np.repeat(starts[points], counts) + within]
    seen = xyz[np.repeat(points, counts)]
    to_own, to_other = centers[image] - seen, centers[others] - seen
    sine = np.linalg.norm(np.cross(to_own, to_other), axis=1)
    angle = np.rad2deg(np.arctan2(sine, (to_own * to_other).sum(axis=1)))
    low, high = _BEST_ANGLES_DEG
    weight = np.square(np.minimum(np.minimum(angle / low, high / np.maximum(angle, 1e-9)), 1.0))
    scores = np.bincount(others, weights=weight, minlength=len(centers))
    scores[~candidates] = 0.0
    scores[image] = 0.0
    best = np.argsort(-scores, kind="stable")[:count]
    return [int(other) for other in best if scores[other] > 0]


def depth_range(depths: Floats) -> tuple[float, float] | None:
    """Return the 1st and 99th percentile of depths (N,), widened; None for too few depths."""
    depths = depths[depths > 0]
    if len(depths) < 8:
        return None
    low, high = np.percentile(depths, [1, 99])
    return float(low * _WIDENED[0]), float(high * _WIDENED[1])


def agreeing_views(
    view: StereoView,
    depth_m: NDArray[np.float32],
    others: Sequence[tuple[StereoView, NDArray[np.float32]]],
    tolerance_px: float = TOLERANCE_PX,
) -> NDArray[np.uint8]:
    """Count, per pixel (H, W), the other views whose depth agrees when projected there and back."""
    from megloc_kapture.mvs.kernels import count_agreeing

    counts = np.zeros(depth_m.shape, np.uint8)
    inverse = _inverted(depth_m)
    for other, other_depth_m in others:
        forth, back = relative_projection(view, other), relative_projection(other, view)
        limits = tolerance_px, _RELATIVE_PER_PX * tolerance_px
        count_agreeing(inverse, _inverted(other_depth_m), *forth, *back, *limits, counts)
    return counts


def with_pose_errors(
    view: StereoView,
    sources: Sequence[StereoView],
    estimate: DepthEstimate,
    depth_range_m: tuple[float, float],
    error_px: float,
) -> DepthEstimate:
    """Add the effect of pose errors to an estimate's deviations.

    ``error_px`` is the standard deviation by which they move projections along an axis.
    """
    limits = 1.0 / np.array(depth_range_m)[::-1]
    paths = [relative_projection(view, source) for source in sources]
    # average over the sources, since any of them may have determined the depth
    step = np.sqrt(np.mean([pixel_step([path], view.camera, limits) ** 2 for path in paths]))
    pose_sigma = (error_px * step * np.square(estimate.depth_m.astype(np.float64))).astype(
        np.float32
    )
    return replace(estimate, sigma_m=np.hypot(estimate.sigma_m, pose_sigma))


def confirmed(
    view: StereoView,
    estimate: DepthEstimate,
    others: Sequence[tuple[StereoView, NDArray[np.float32]]],
    tolerance_px: float = TOLERANCE_PX,
) -> DepthEstimate:
    """Keep depths that are certain, unmasked, confirmed by other views and not in small islands."""
    counts = agreeing_views(view, estimate.depth_m, others, tolerance_px)
    known = (estimate.depth_m > 0) & (counts >= _MIN_VIEWS)
    known &= estimate.sigma_m <= _MAX_RELATIVE_SIGMA * estimate.depth_m
    if view.mask is not None:
        known &= view.mask
    if known.any():
        # neighbouring depths that differ by less than 1 % belong to one surface
        logs = np.log(estimate.depth_m, out=np.zeros(known.shape), where=known)
        levels = np.where(known, 1 + 1000 * (logs - logs[known].min()), 0)
        levels = np.clip(levels, 0, 32767).astype(np.int16)
        cv2.filterSpeckles(levels, 0, _MIN_REGION_PX, 10)
        known &= levels > 0
    depth_m, sigma_m = (
        np.where(known, each, np.float32(0)) for each in (estimate.depth_m, estimate.sigma_m)
    )
    normals = np.where(known[..., None], estimate.normals, np.float32(0))
    return DepthEstimate(depth_m, sigma_m, normals)


def _inverted(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    known = depth_m > 0
    return np.where(known, 1 / np.where(known, depth_m, 1), 0).astype(np.float32)
