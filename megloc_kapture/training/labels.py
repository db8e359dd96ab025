"""Labels of a pair's keypoints: the partner in the other image, unmatched, or ignored.

Depth and poses, or a homography, transform keypoints into the other image. As in glue-factory's
``gt_generation``, partners are mutual nearest neighbours, near in both images and visible;
unmatched keypoints are far from all keypoints of the other image; the rest is ignored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import bearing_rays, px_from_cam
from megloc_kapture.mapping.depth import MAX_DEPTH_JUMP, lift_keypoints, sample_depth
from megloc_kapture.matching.verification import ray_slopes, sampson_error_px
from megloc_kapture.plugins import DepthView
from megloc_kapture.values import Camera, RigidTransform

UNMATCHED, IGNORED = -1, -2
# glue-factory's thresholds: matched keypoints are nearer in both images, unmatched ones are farther
# from all keypoints of the other image
POSITIVE_PX, NEGATIVE_PX = 3.0, 5.0
# largest relative depth difference of a visible point
_MAX_DEPTH_ERROR = 0.03
# grid of pixels on which overlap is measured
_GRID = (24, 18)

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PosedView:
    """An image with pose and depth; ``camera`` has the resolution of the keypoints."""

    camera: Camera
    cam_from_world: RigidTransform
    depth: DepthView


@dataclass(frozen=True, eq=False)
class Labels:
    """Partners int64 (N,) and (M,): the row in the other image, UNMATCHED or IGNORED."""

    partner_a: NDArray[np.int64]
    partner_b: NDArray[np.int64]

    def matches(self) -> NDArray[np.int64]:
        """Return the matches, int64 (K, 2), sorted."""
        rows = np.flatnonzero(self.partner_a >= 0)
        return np.stack([rows, self.partner_a[rows]], axis=1)


def labels_of_views(
    px_a: NDArray[np.floating[Any]],
    px_b: NDArray[np.floating[Any]],
    a: PosedView,
    b: PosedView,
) -> Labels:
    """Label keypoints (N, 2) and (M, 2) by depth and poses.

    A keypoint without depth is unmatched if its Sampson distance to every keypoint that is ignored
    in the other image after the check by depth exceeds NEGATIVE_PX; otherwise it is ignored.
    """
    a_in_b, known_a, visible_a = reproject(px_a, a, b)
    b_in_a, known_b, visible_b = reproject(px_b, b, a)
    labels = _labels((px_a, a_in_b, known_a, visible_a), (px_b, b_in_a, known_b, visible_b))
    open_a, open_b = labels.partner_a == IGNORED, labels.partner_b == IGNORED
    lost_a, lost_b = open_a & ~known_a, open_b & ~known_b
    if lost_a.any() or lost_b.any():
        error = _epipolar_error_px(px_a[open_a], px_b[open_b], a, b)
        far_a, far_b = open_a.copy(), open_b.copy()
        far_a[open_a] = error.min(axis=1, initial=np.inf) > NEGATIVE_PX
        far_b[open_b] = error.min(axis=0, initial=np.inf) > NEGATIVE_PX
        labels.partner_a[lost_a & far_a] = UNMATCHED
        labels.partner_b[lost_b & far_b] = UNMATCHED
    return labels


def labels_of_homography(
    px_a: NDArray[np.floating[Any]],
    px_b: NDArray[np.floating[Any]],
    b_from_a: Floats,
    size_a: tuple[int, int],
    size_b: tuple[int, int],
) -> Labels:
    """Label keypoints by a homography (3, 3) between the pixels of two images of sizes (w, h)."""

    def side(px: NDArray[np.floating[Any]], matrix: Floats, size: tuple[int, int]) -> _Side:
        moved = np.column_stack([px, np.ones(len(px))]) @ matrix.T
        with np.errstate(divide="ignore", invalid="ignore"):
            moved_px = np.where(moved[:, 2:] > 0, moved[:, :2] / moved[:, 2:], np.nan)
        return px, moved_px, np.ones(len(px), bool), _inside(moved_px, *size)

    a_from_b = np.asarray(np.linalg.inv(b_from_a), np.float64)
    a, b = side(px_a, b_from_a, size_b), side(px_b, a_from_b, size_a)
    return _labels(a, b)


def reproject(
    px: NDArray[np.floating[Any]], a: PosedView, b: PosedView
) -> tuple[Floats, NDArray[np.bool_], NDArray[np.bool_]]:
    """Transform pixels (N, 2) of image a into image b by depth.

    Returns pixels (N, 2), NaN without depth, and two masks (N,): pixels with depth in a, and pixels
    visible in b.
    """
    points, known = lift_keypoints(
        px, a.depth.depth_m, a.camera, a.depth.camera, a.depth.image_from_depth
    )
    in_b = (b.cam_from_world @ a.cam_from_world.inverse()).apply(points)
    px_in_b = px_from_cam(b.camera, in_b)
    in_depth = b.depth.image_from_depth.inverse().apply(in_b)
    measured = sample_depth(b.depth.depth_m, px_from_cam(b.depth.camera, in_depth), MAX_DEPTH_JUMP)
    with np.errstate(invalid="ignore"):
        seen = np.abs(measured - in_depth[:, 2]) <= _MAX_DEPTH_ERROR * in_depth[:, 2]
    return px_in_b, known, known & seen & _inside(px_in_b, b.camera.width, b.camera.height)


def overlap(a: PosedView, b: PosedView) -> float:
    """Return the share of pixels with depth that the other image sees, for the image with less."""
    shares = []
    for view, other in ((a, b), (b, a)):
        size = view.camera.width, view.camera.height
        x, y = np.meshgrid(
            *((np.arange(n) + 0.5) * side / n for n, side in zip(_GRID, size, strict=True))
        )
        grid = np.stack([x.ravel(), y.ravel()], axis=1)
        _, known, visible = reproject(grid, view, other)
        shares.append(visible.sum() / known.sum() if known.any() else 0.0)
    return float(min(shares))


_Side = tuple[NDArray[np.floating[Any]], Floats, NDArray[np.bool_], NDArray[np.bool_]]


def _labels(a: _Side, b: _Side) -> Labels:
    px_a, a_in_b, known_a, visible_a = a
    px_b, b_in_a, known_b, visible_b = b
    if not len(px_a) or not len(px_b):
        return Labels(np.full(len(px_a), IGNORED), np.full(len(px_b), IGNORED))
    in_b, in_a = _distances(a_in_b, px_b), _distances(b_in_a, px_a).T
    both = np.where(visible_a[:, None] & visible_b, np.maximum(in_a, in_b), np.inf)
    nearest_a, nearest_b = both.argmin(axis=1), both.argmin(axis=0)
    rows = np.arange(len(px_a))
    pairs = (nearest_b[nearest_a] == rows) & (both[rows, nearest_a] < POSITIVE_PX)
    partner_a = np.where(pairs, nearest_a, IGNORED)
    partner_b = np.full(len(px_b), IGNORED)
    partner_b[nearest_a[pairs]] = rows[pairs]
    partner_a[known_a & (in_b.min(axis=1) > NEGATIVE_PX)] = UNMATCHED
    partner_b[known_b & (in_a.min(axis=0) > NEGATIVE_PX)] = UNMATCHED
    return Labels(partner_a, partner_b)


def _distances(
    first: NDArray[np.floating[Any]], second: NDArray[np.floating[Any]]
) -> NDArray[np.float64]:
    distances = np.linalg.norm(first[:, None].astype(np.float64) - second[None], axis=2)
    return np.where(np.isfinite(distances), distances, np.inf)


def _inside(px: Floats, width: int, height: int) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray(((px >= 0) & (px <= (width, height))).all(axis=1))


def _epipolar_error_px(
    px_a: NDArray[np.floating[Any]], px_b: NDArray[np.floating[Any]], a: PosedView, b: PosedView
) -> Floats:
    """Return Sampson distances (N, M) in pixels; 0 if undefined."""
    rays = [bearing_rays(view.camera, px) for view, px in ((a, px_a), (b, px_b))]
    slopes = [
        ray_slopes(view.camera, px, ray)
        for view, px, ray in ((a, px_a, rays[0]), (b, px_b, rays[1]))
    ]
    first, second = (grid.ravel() for grid in np.indices((len(px_a), len(px_b))))
    ours, theirs = (rays[0][first], slopes[0][first]), (rays[1][second], slopes[1][second])
    error = sampson_error_px(*ours, *theirs, b.cam_from_world @ a.cam_from_world.inverse())
    return np.where(np.isfinite(error), error, 0.0).reshape(len(px_a), len(px_b))
