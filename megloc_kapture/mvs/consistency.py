"""Depth that other views confirm: what only one view claims is unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.mvs.views import pixel_step, relative_projection
from megloc_kapture.plugins import DepthEstimate, StereoView
from megloc_kapture.values import Options

_MIN_REGION_PX = 40  # smaller islands of one surface are chance agreements


class AgreementOptions(Options):
    """Options of the consistency between views."""

    min_views: int = Field(
        default=1, ge=0, description="other views whose depth agrees, for a pixel to keep its own"
    )
    max_error_px: float = Field(
        default=1.0, gt=0, description="distance at which a pixel comes back from another view"
    )
    max_relative_error: float = Field(
        default=0.01, gt=0, description="difference in depth, as a share of it"
    )
    max_relative_sigma: float = Field(
        default=0.03,
        gt=0,
        description="standard deviation of depth, as a share of it, beyond which there is none: "
        "surfaces without texture",
    )


def agreeing_views(
    view: StereoView,
    depth_m: NDArray[np.float32],
    others: Sequence[tuple[StereoView, NDArray[np.float32]]],
    options: AgreementOptions,
) -> NDArray[np.uint8]:
    """Number of other views (H, W) whose depth agrees with a view's own, forth and back.

    Parameters
    ----------
    others : views with their depth, float32 (H, W), 0 where unknown; of a view only the camera and
        the pose count.
    """
    from megloc_kapture.mvs.kernels import count_agreeing

    counts = np.zeros(depth_m.shape, np.uint8)
    inverse = _inverted(depth_m)
    for other, other_depth_m in others:
        forth, back = relative_projection(view, other), relative_projection(other, view)
        limits = options.max_error_px, options.max_relative_error
        count_agreeing(inverse, _inverted(other_depth_m), *forth, *back, *limits, counts)
    return counts


def with_pose_errors(
    view: StereoView,
    sources: Sequence[StereoView],
    estimate: DepthEstimate,
    depth_range_m: tuple[float, float],
    error_px: float,
) -> DepthEstimate:
    """An estimate whose deviations also cover the errors of the views' poses.

    Parameters
    ----------
    sources : the views that it was made from.
    error_px : standard deviation of where the poses put a point in a source, along an axis.
    """
    limits = 1.0 / np.array(depth_range_m)[::-1]
    paths = [relative_projection(view, source) for source in sources]
    # any of the sources may have decided
    step = np.sqrt(np.mean([pixel_step([path], view.camera, limits) ** 2 for path in paths]))
    own = (error_px * step * np.square(estimate.depth_m.astype(np.float64))).astype(np.float32)
    return replace(estimate, sigma_m=np.hypot(estimate.sigma_m, own))


def confirmed(
    view: StereoView,
    estimate: DepthEstimate,
    others: Sequence[tuple[StereoView, NDArray[np.float32]]],
    options: AgreementOptions,
) -> DepthEstimate:
    """What of an estimate other views confirm, that is sure enough, not masked, and no island."""
    counts = agreeing_views(view, estimate.depth_m, others, options)
    known = (estimate.depth_m > 0) & (counts >= options.min_views)
    known &= estimate.sigma_m <= options.max_relative_sigma * estimate.depth_m
    if view.mask is not None:
        known &= view.mask
    if known.any():
        # depths that differ by less than a hundredth are of one surface
        logs = np.log(estimate.depth_m, out=np.zeros(known.shape), where=known)
        levels = np.where(known, 1 + 1000 * (logs - logs[known].min()), 0)
        levels = np.clip(levels, 0, 32767).astype(np.int16)
        cv2.filterSpeckles(levels, 0, _MIN_REGION_PX, 10)
        known &= levels > 0
    return replace(
        estimate,
        depth_m=np.where(known, estimate.depth_m, np.float32(0)),
        sigma_m=np.where(known, estimate.sigma_m, np.float32(0)),
        normals=np.where(known[..., None], estimate.normals, np.float32(0)),
    )


def _inverted(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    known = depth_m > 0
    return np.where(known, 1 / np.where(known, depth_m, 1), 0).astype(np.float32)
