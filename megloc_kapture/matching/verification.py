"""Geometric verification of matches: with known poses, or by a two-view model.

With known poses (mapping pairs): Sampson distance in pixels of the original images, and rays that
meet in front of both cameras. Without (query pairs): LO-RANSAC of the relative pose by poselib with
progressive sampling (Chum and Matas, CVPR 2005).

With rays r = (x, y, 1) the epipolar constraint is C = r_b . E r_a = 0. The Sampson distance is |C|
divided by the norm of the derivatives of C with respect to the four pixel coordinates, by the chain
rule through the camera's unprojection (Hartley and Zisserman, Multiple View Geometry, eq. 4.13).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.geometry.cameras import bearing_rays, focal_px
from megloc_kapture.geometry.poses import cross_matrix
from megloc_kapture.matching.guided_pyramid import (
    ImageVariant,
    PairVerifier,
    VariantFeatures,
    VariantMatches,
)
from megloc_kapture.values import Camera, Options, RigidTransform

Floats = NDArray[np.float64]
_MAX_RAY_ERROR_PX = 0.1  # largest error of a pixel converted to a ray and back
_MIN_AGREEING = 0.5  # smallest share of a variant's matches that agree with the model
_SAMPLE = 5  # matches that determine a relative pose
_THRESHOLDS = (1.0, 0.5, 0.25)  # tested shares of the error threshold; the best is used
# largest expected number of false alarms; strict, since matches on one object are not independent
_MAX_FALSE_ALARMS = 1e-10
# how often a wrong match agrees is measured on at most about this many mismatched pairs
_MAX_WRONG_PAIRS = 20_000
# a pair with fewer verified matches counts as not overlapping
MIN_MATCHES = 15
_MIN_ITERATIONS, _CONFIDENCE = 20, 0.999  # RANSAC of relative poses


class KnownPoseOptions(Options):
    """Options for verification with known poses."""

    max_error_px: float = Field(
        default=4.0, gt=0, description="largest Sampson distance of a match"
    )


class TwoViewOptions(Options):
    """Options for two-view verification; cameras are calibrated, so planes are not degenerate."""

    max_error_px: float = Field(
        default=4.0, gt=0, description="largest Sampson distance of an inlier"
    )
    max_iterations: int = Field(
        default=50,
        gt=0,
        description="RANSAC iterations; use more for matchers with uninformative scores",
    )


def essential_matrix(b_from_a: RigidTransform) -> Floats:
    """Return E (3, 3) with ``ray_b . E ray_a = 0``."""
    return cross_matrix(np.array(b_from_a.translation)) @ b_from_a.rotation_matrix()


def ray_slopes(camera: Camera, keypoints_px: NDArray[np.floating[Any]], rays: Floats) -> Floats:
    """Return derivatives d (x, y) / d px (N, 2, 2) of rays (N, 3) at their pixels (N, 2).

    NaN where the ray does not project to its pixel: the distortion has no inverse, or the pixel of
    a fisheye camera is 90 degrees or more off the optical axis.
    """
    from megloc_kapture.geometry.projection import project_with_jacobian

    px, jacobian = project_with_jacobian(camera, rays)
    a, b, c, d = (jacobian[:, row, column] for row in (0, 1) for column in (0, 1))
    determinant = a * d - b * c
    error = np.abs(px - keypoints_px).max(axis=1)
    # reject mirrored pixels, where a distortion polynomial folds over
    good = (error <= _MAX_RAY_ERROR_PX) & (determinant > 0)
    slopes = np.stack([d, -b, -c, a], axis=1).reshape(-1, 2, 2)
    slopes /= np.where(good, determinant, np.nan)[:, None, None]
    return slopes


def sampson_error_px(
    rays_a: Floats, slopes_a: Floats, rays_b: Floats, slopes_b: Floats, b_from_a: RigidTransform
) -> Floats:
    """Return Sampson distances (N,) in pixels of matched rays (N, 3) with slopes (N, 2, 2).

    Infinite where the epipolar line is undefined, NaN where a slope is NaN.
    """
    essential = essential_matrix(b_from_a)
    line_b = rays_a @ essential.T
    line_a = rays_b @ essential
    numerator = np.abs(np.einsum("nd,nd->n", rays_b, line_b))
    slope_a = np.einsum("nd,ndk->nk", line_a[:, :2], slopes_a)
    slope_b = np.einsum("nd,ndk->nk", line_b[:, :2], slopes_b)
    squared = np.einsum("nk,nk->n", slope_a, slope_a) + np.einsum("nk,nk->n", slope_b, slope_b)
    return np.divide(
        numerator, np.sqrt(squared), out=np.full(len(numerator), np.inf), where=squared != 0
    )


def in_front_of_both(rays_a: Floats, rays_b: Floats, b_from_a: RigidTransform) -> NDArray[np.bool_]:
    """Return a mask (N,) of matched rays that meet in front of both cameras or are parallel.

    Skew rays count as meeting at their closest points.
    """
    rotation = b_from_a.rotation_matrix()
    a = rays_a / np.linalg.norm(rays_a, axis=1, keepdims=True)
    b = (rays_b / np.linalg.norm(rays_b, axis=1, keepdims=True)) @ rotation
    center = b_from_a.center()
    cosine = np.einsum("nd,nd->n", a, b)
    along_a, along_b = a @ center, b @ center
    determinant = 1.0 - cosine**2
    # the factor 1 / determinant of both depths is positive and omitted: only the signs matter
    depth_a = along_a - cosine * along_b
    depth_b = cosine * along_a - along_b
    at_infinity = (determinant < 1e-10) & (cosine > 0)
    return np.asarray(((depth_a > 0) & (depth_b > 0)) | at_infinity)


def verify_with_poses(
    rays_a: Floats,
    slopes_a: Floats,
    rays_b: Floats,
    slopes_b: Floats,
    b_from_a: RigidTransform,
    options: KnownPoseOptions | None = None,
    *,
    min_matches: int = MIN_MATCHES,
) -> NDArray[np.bool_]:
    """Return a mask (N,) of the matched rays (N, 3) that agree with a relative pose.

    Matches with NaN ``slopes`` (:func:`ray_slopes`) are rejected. All are False if fewer than
    ``min_matches`` agree.
    """
    options = options or KnownPoseOptions()
    if len(rays_a) == 0:
        return np.zeros(0, dtype=bool)
    error = sampson_error_px(rays_a, slopes_a, rays_b, slopes_b, b_from_a)
    good = (error <= options.max_error_px) & in_front_of_both(rays_a, rays_b, b_from_a)
    if good.sum() < min_matches:
        good[:] = False
    return good


def verify_two_view(
    keypoints_a_px: NDArray[np.floating[Any]],
    camera_a: Camera,
    keypoints_b_px: NDArray[np.floating[Any]],
    camera_b: Camera,
    options: TwoViewOptions | None = None,
) -> NDArray[np.bool_]:
    """Return a mask (N,) of the matches that agree with one relative pose of calibrated cameras.

    Keypoints (N, 2) are best first, see :func:`~.guided_pyramid.verify_best_first`. All False if no
    model has ``MIN_MATCHES`` inliers.
    """
    options = options or TwoViewOptions()
    none = np.zeros(len(keypoints_a_px), dtype=bool)
    rays_a = bearing_rays(camera_a, keypoints_a_px)
    rays_b = bearing_rays(camera_b, keypoints_b_px)
    usable = np.isfinite(rays_a).all(axis=1) & np.isfinite(rays_b).all(axis=1)
    if usable.sum() < MIN_MATCHES:
        return none
    focal = 0.5 * (focal_px(camera_a) + focal_px(camera_b))
    best_first = {"progressive_sampling": True, "max_prosac_iterations": options.max_iterations}
    # skip the refinement: only the inliers are needed, and it does not change them
    unrefined = {"max_iterations": 0}
    _, info = _ransac(rays_a[usable], rays_b[usable], focal, options, best_first, unrefined)
    inliers = np.asarray(info["inliers"], dtype=bool)
    if len(inliers) != usable.sum() or inliers.sum() < MIN_MATCHES:
        return none
    good = none.copy()
    good[usable] = inliers
    return good


def two_view_of_variants(
    camera: Camera,
    image_px: NDArray[np.floating[Any]],
    other_camera: Camera,
    other_px: NDArray[np.floating[Any]],
    base_matches: NDArray[np.int64],
    options: TwoViewOptions,
) -> PairVerifier:
    """Return a two-view verifier; variants must fit the pose of the largest match set.

    Keypoints are (N, 2 or more) and (M, 2 or more); ``base_matches`` int64 (K, 2) are the verified
    matches of the images themselves.
    """
    focal, other_focal = focal_px(camera), focal_px(other_camera)
    pairs = image_px[base_matches[:, 0], :2], other_px[base_matches[:, 1], :2]

    def verify(features: VariantFeatures, matches: NDArray[np.int64]) -> NDArray[np.bool_]:
        # the threshold is meant for the mean focal length of the variant and the other image, but
        # applied at that of the originals, which is larger by this factor
        coarser = (focal + other_focal) / (_precision(features.variant) * focal + other_focal)
        return verify_two_view(
            features.keypoints_px[matches[:, 0], :2],
            camera,
            other_px[matches[:, 1], :2],
            other_camera,
            options.model_copy(update={"max_error_px": options.max_error_px * coarser}),
        )

    def agree(matched: list[VariantMatches]) -> list[VariantMatches]:
        if not matched:
            return matched
        sets = [
            pairs,
            *((each.keypoints_px, other_px[each.other_rows]) for each in matched),
        ]
        richest = max(range(len(sets)), key=lambda at: len(sets[at][0]))
        other_from_image = relative_pose(
            bearing_rays(camera, sets[richest][0][:, :2]),
            bearing_rays(other_camera, sets[richest][1][:, :2]),
            0.5 * (focal + other_focal),
            options,
        )
        if other_from_image is None:
            return matched
        other_rays = bearing_rays(other_camera, other_px[:, :2])
        other_slopes = ray_slopes(other_camera, other_px[:, :2], other_rays)
        exact = KnownPoseOptions(max_error_px=options.max_error_px)
        kept = []
        for each in matched:
            px = each.keypoints_px[:, :2]
            rays = bearing_rays(camera, px)
            # a pixel of a smaller image covers a larger angle
            slopes = ray_slopes(camera, px, rays) / _precision(each.variant)
            others = each.other_rows
            good = verify_with_poses(
                rays,
                slopes,
                other_rays[others],
                other_slopes[others],
                other_from_image,
                exact,
                min_matches=0,
            )
            if good.sum() >= _MIN_AGREEING * len(good):
                kept.append(each.only(good))
        return kept

    return PairVerifier(verify, agree)


def known_pose_of_variants(
    camera: Camera,
    other_rays: Floats,
    other_slopes: Floats,
    other_from_image: RigidTransform,
    options: KnownPoseOptions,
) -> PairVerifier:
    """Return a verifier that uses a known pose.

    ``other_rays`` (M, 3) and ``other_slopes`` (M, 2, 2) belong to the other image's keypoints.
    """

    def verify(features: VariantFeatures, matches: NDArray[np.int64]) -> NDArray[np.bool_]:
        px, others = features.keypoints_px[matches[:, 0], :2], matches[:, 1]
        rays = bearing_rays(camera, px)
        slopes = ray_slopes(camera, px, rays)
        return verify_with_poses(
            rays, slopes, other_rays[others], other_slopes[others], other_from_image, options
        )

    return PairVerifier(verify)


def relative_pose(
    rays: Floats,
    other_rays: Floats,
    focal: float,
    options: TwoViewOptions,
    *,
    min_matches: int = MIN_MATCHES,
) -> RigidTransform | None:
    """Estimate ``other_from_image`` of matched rays (N, 3) by RANSAC, with a unit translation.

    ``focal`` converts the errors of normalised coordinates to pixels. None if no model has
    ``min_matches`` inliers.
    """
    if len(rays) < min_matches:
        return None
    pose, info = _ransac(rays, other_rays, focal, options, {}, {})
    if info["num_inliers"] < min_matches:
        return None
    return RigidTransform.from_matrix(np.asarray(pose.R), np.asarray(pose.t))


def _ransac(
    rays_a: Floats,
    rays_b: Floats,
    focal: float,
    options: TwoViewOptions,
    sampling: dict[str, Any],
    refinement: dict[str, Any],
) -> tuple[Any, dict[str, Any]]:
    """Estimate a relative pose with poselib; normalised coordinates need no lens model."""
    import poselib

    pinhole = {"model": "PINHOLE", "width": 1, "height": 1, "params": [focal, focal, 0.0, 0.0]}
    ransac = {
        "max_epipolar_error": options.max_error_px,
        "min_iterations": _MIN_ITERATIONS,
        "max_iterations": options.max_iterations,
        "success_prob": _CONFIDENCE,
        "seed": 0,
    }
    pixels = rays_a[:, :2] * focal, rays_b[:, :2] * focal
    return poselib.estimate_relative_pose(*pixels, pinhole, pinhole, ransac | sampling, refinement)


def _precision(variant: ImageVariant) -> float:
    """Return pixels of a variant per pixel of the original, at most 1."""
    return min(1.0, variant.scale)


def agree_by_chance(
    keypoints_a_px: NDArray[np.floating[Any]],
    camera_a: Camera,
    keypoints_b_px: NDArray[np.floating[Any]],
    camera_b: Camera,
    num_matches: int,
    options: TwoViewOptions,
) -> bool:
    """Return True if wrong matches may agree with a relative pose as well as these matches do.

    Keypoints (N, 2) belong to the verified matches, out of ``num_matches``. RANSAC finds a model
    even for wrong matches. The number of false alarms (Moisan and Stival, IJCV 2004) is the
    expected number of equally good models of wrong matches. Keypoints cluster on texture, so the
    probability that a wrong match is near its epipolar line is measured on mismatched pairs of the
    keypoints; the probability for uniform positions is its lower bound.
    """
    from scipy.special import gammaln
    from scipy.stats import binom

    number = len(keypoints_a_px)
    if number <= max(_SAMPLE, MIN_MATCHES - 1):
        return True
    rays_a = bearing_rays(camera_a, keypoints_a_px)
    rays_b = bearing_rays(camera_b, keypoints_b_px)
    focal = 0.5 * (focal_px(camera_a) + focal_px(camera_b))
    b_from_a = relative_pose(rays_a, rays_b, focal, options)
    if b_from_a is None:
        return True
    slopes_a = ray_slopes(camera_a, keypoints_a_px, rays_a)
    slopes_b = ray_slopes(camera_b, keypoints_b_px, rays_b)

    def errors_px(a: NDArray[np.integer[Any]], b: NDArray[np.integer[Any]]) -> Floats:
        return sampson_error_px(rays_a[a], slopes_a[a], rays_b[b], slopes_b[b], b_from_a)

    rows = np.arange(number)
    right_px = errors_px(rows, rows)
    num_shifts = min(number - 1, max(1, _MAX_WRONG_PAIRS // number))
    shifts = 1 + (np.arange(num_shifts) * (number - 1)) // num_shifts
    wrong_px = errors_px(np.tile(rows, num_shifts), ((rows + shifts[:, None]) % number).reshape(-1))
    samples = gammaln(num_matches + 1) - gammaln(num_matches - _SAMPLE + 1) - gammaln(_SAMPLE + 1)
    for share in _THRESHOLDS:
        threshold_px = share * options.max_error_px
        # probability for uniform positions; sqrt(2): a Sampson distance covers both images' errors
        anywhere = max(
            2 * math.sqrt(2) * threshold_px * math.hypot(c.width, c.height) / (c.width * c.height)
            for c in (camera_a, camera_b)
        )
        near = min(1.0, max(anywhere, float((wrong_px <= threshold_px).mean())))
        agreeing = int((right_px <= threshold_px).sum())
        tail = binom.logsf(agreeing - _SAMPLE - 1, num_matches - _SAMPLE, near)
        if samples + tail + math.log(len(_THRESHOLDS)) <= math.log(_MAX_FALSE_ALARMS):
            return False
    return True
