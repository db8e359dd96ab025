"""Verification of matches whose keypoints were found in a variant of an image.

Keypoints are judged where they stand in the original image. Without poses an error is counted in
pixels of the image they were found in: at a third of the size a keypoint is three times less
precise, and a pose takes what there is. Where the image was enlarged nothing is asked beyond the
original's pixels, since enlarging shows no more. With known poses, when mapping, the original's
pixels count: points of less precise keypoints made the poses of other queries worse.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import bearing_rays, focal_px
from megloc_kapture.geometry.image_variants import ImageVariant
from megloc_kapture.matching.guided_pyramid import (
    Judgement,
    VariantFeatures,
    VariantMatches,
)
from megloc_kapture.matching.verification import (
    KnownPoseOptions,
    TwoViewOptions,
    ray_slopes,
    verify_two_view,
    verify_with_poses,
)
from megloc_kapture.values import Camera, RigidTransform

# of a variant's matches, whose own model is another one where fewer agree
_MIN_AGREEING = 0.5


def two_view_of_variants(
    camera: Camera,
    image_px: NDArray[np.floating[Any]],
    other_camera: Camera,
    other_px: NDArray[np.floating[Any]],
    base_matches: NDArray[np.int64],
    options: TwoViewOptions,
) -> Judgement:
    """Verification by a two-view model; the richest's decides which variants agree.

    Parameters
    ----------
    camera, image_px : of the image the variants are of: its own keypoints (N, 2 or more).
    other_camera, other_px : of the other image, (M, 2 or more).
    base_matches : int64 (K, 2), the verified matches of the two as they are.
    """
    focal, other_focal = focal_px(camera), focal_px(other_camera)
    pairs = image_px[base_matches[:, 0], :2], other_px[base_matches[:, 1], :2]

    def verify(found: VariantFeatures, matches: NDArray[np.int64]) -> NDArray[np.bool_]:
        # an error counts at the mean focal length of both cameras, and a variant's has its scale
        coarser = (focal + other_focal) / (_precision(found.variant) * focal + other_focal)
        return verify_two_view(
            found.keypoints_px[matches[:, 0], :2],
            camera,
            other_px[matches[:, 1], :2],
            other_camera,
            options.model_copy(update={"max_error_px": options.max_error_px * coarser}),
        )

    def agree(found: list[VariantMatches]) -> list[VariantMatches]:
        if not found:
            return found
        sets = [pairs, *((one.keypoints_px, other_px[one.other_rows]) for one in found)]
        richest = max(range(len(sets)), key=lambda at: len(sets[at][0]))  # of equals the first
        other_from_image = _relative_pose(
            bearing_rays(camera, sets[richest][0][:, :2]),
            bearing_rays(other_camera, sets[richest][1][:, :2]),
            0.5 * (focal + other_focal),
            options,
        )
        if other_from_image is None:
            return found
        other_rays = bearing_rays(other_camera, other_px[:, :2])
        other_slopes = ray_slopes(other_camera, other_px[:, :2], other_rays)
        exact = KnownPoseOptions(max_error_px=options.max_error_px, min_matches=0)
        kept = []
        for one in found:
            px = one.keypoints_px[:, :2]
            rays = bearing_rays(camera, px)
            # a ray turns so much more with a pixel of the smaller image
            slopes = ray_slopes(camera, px, rays) / _precision(one.variant)
            others = one.other_rows
            good = verify_with_poses(
                rays, slopes, other_rays[others], other_slopes[others], other_from_image, exact
            )
            if good.sum() >= _MIN_AGREEING * len(good):
                kept.append(one.only(good))
        return kept

    return Judgement(verify, agree)


def known_pose_of_variants(
    camera: Camera,
    other_rays: NDArray[np.float64],
    other_slopes: NDArray[np.float64],
    other_from_image: RigidTransform,
    options: KnownPoseOptions,
) -> Judgement:
    """Verification with the known poses.

    Parameters
    ----------
    camera : of the image the variants are of.
    other_rays, other_slopes : float64 (M, 3) and (M, 2, 2) of the other image's keypoints, see
        ``verification.ray_slopes``.
    """

    def verify(found: VariantFeatures, matches: NDArray[np.int64]) -> NDArray[np.bool_]:
        px, others = found.keypoints_px[matches[:, 0], :2], matches[:, 1]
        rays = bearing_rays(camera, px)
        slopes = ray_slopes(camera, px, rays)
        return verify_with_poses(
            rays, slopes, other_rays[others], other_slopes[others], other_from_image, options
        )

    return Judgement(verify)


def _relative_pose(
    rays: NDArray[np.float64],
    other_rays: NDArray[np.float64],
    focal: float,
    options: TwoViewOptions,
) -> RigidTransform | None:
    """``other_from_image`` of verified matches, None where there is no model."""
    import poselib

    if len(rays) < options.min_matches:
        return None
    # normalised coordinates at a focal length, as verify_two_view has them
    pinhole = {"model": "PINHOLE", "width": 1, "height": 1, "params": [focal, focal, 0.0, 0.0]}
    pose, info = poselib.estimate_relative_pose(
        rays[:, :2] * focal,
        other_rays[:, :2] * focal,
        pinhole,
        pinhole,
        {
            "max_epipolar_error": options.max_error_px,
            "min_iterations": options.min_iterations,
            "max_iterations": options.max_iterations,
            "success_prob": options.confidence,
            "seed": options.seed,
        },
    )
    if info["num_inliers"] < options.min_matches:
        return None
    return RigidTransform.from_matrix(np.asarray(pose.R), np.asarray(pose.t))


def _precision(variant: ImageVariant) -> float:
    """Pixels of the image that a keypoint was found in, for one of the original; 1 at most."""
    return min(1.0, variant.scale)
