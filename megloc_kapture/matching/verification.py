"""Geometric verification of matches: with known poses, or by a two-view model.

Known poses (mapping pairs): the essential matrix is given, so verification is one vectorised
Sampson distance and a test that the rays meet in front of both cameras; no sampling. The distance
is in pixels of the images as they were taken: how far both measurements together have to move, to
first order, until their rays meet. Unknown pose (query pairs): LO-RANSAC of the relative pose by
poselib, whose samples are of the best matches first (Chum and Matas, "Matching with PROSAC", CVPR
2005), and of all matches alike by the last iteration: then scores that say nothing do no harm.

With rays r = (x, y, 1), the epipolar constraint is C = r_b . E r_a. Its derivatives with respect to
the four measured coordinates follow from those of C with respect to x and y and from the inverse of
d px / d (x, y), which is the derivative of the camera's own projection; the distance is |C| over
their norm (Hartley and Zisserman, Multiple View Geometry, eq. 4.13; for one focal length and no
distortion it is their eq. 11.9 times the focal length).
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
# a ray that is seen this far from its pixel is none of this pixel
_MAX_RAY_ERROR_PX = 0.1
# of a variant's matches, whose own model is another one where fewer agree
_MIN_AGREEING = 0.5
_SAMPLE = 5  # matches that a relative pose of calibrated cameras is made of
# shares of the threshold: the most telling one counts, as in the paper of false alarms
_THRESHOLDS = (1.0, 0.5, 0.25)
# matches of one thing in two images are not independent of each other, so few must be expected
_MAX_FALSE_ALARMS = 1e-10
_MAX_WRONG_PAIRS = 20_000
# a pair with fewer verified matches counts as not overlapping
MIN_MATCHES = 15
_MIN_ITERATIONS, _CONFIDENCE = 20, 0.999  # RANSAC of relative poses


class KnownPoseOptions(Options):
    """Options of verification with the known poses."""

    max_error_px: float = Field(default=4.0, gt=0, description="Sampson distance in the images")


class TwoViewOptions(Options):
    """Options of two-view verification; calibrated, so a plane is no degenerate case."""

    max_error_px: float = Field(
        default=4.0, gt=0, description="distance from the epipolar line of an inlier"
    )
    max_iterations: int = Field(
        default=100, gt=0, description="RANSAC's; more for matchers whose scores say little"
    )
    seed: int = Field(default=0, ge=0, description="of RANSAC's samples")


def essential_matrix(b_from_a: RigidTransform) -> Floats:
    """E (3, 3) with ``ray_b . E ray_a = 0``."""
    return cross_matrix(np.array(b_from_a.translation)) @ b_from_a.rotation_matrix()


def ray_slopes(camera: Camera, keypoints_px: NDArray[np.floating[Any]], rays: Floats) -> Floats:
    """Derivatives d (x, y) / d px (N, 2, 2) of rays by their pixels, under the camera's own model.

    Of pixels (N, 2) and their homogeneous rays float64 (N, 3), last component 1. NaN where a ray is
    not that of its pixel: the distortion cannot be undone there, or the pixel looks sideways or
    back, as pixels of a fisheye may.
    """
    from megloc_kapture.geometry.projection import project_with_jacobian

    px, jacobian = project_with_jacobian(camera, rays)
    a, b, c, d = (jacobian[:, row, column] for row in (0, 1) for column in (0, 1))
    determinant = a * d - b * c
    error = np.abs(px - keypoints_px).max(axis=1)
    # beyond the radius where a distortion turns back, it is mirrored
    good = (error <= _MAX_RAY_ERROR_PX) & (determinant > 0)
    slopes = np.stack([d, -b, -c, a], axis=1).reshape(-1, 2, 2)
    slopes /= np.where(good, determinant, np.nan)[:, None, None]
    return slopes


def sampson_error_px(
    rays_a: Floats, slopes_a: Floats, rays_b: Floats, slopes_b: Floats, b_from_a: RigidTransform
) -> Floats:
    """Sampson distance in pixels (N,) of matched rays (N, 3), last component 1, see above.

    Of slopes (N, 2, 2), see :func:`ray_slopes`. Infinite where there is no epipolar line, NaN where
    a slope is.
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
    """Mask (N,): the midpoint of two rays' common perpendicular is in front of both cameras.

    Rays so close to parallel that the point is at infinity pass: they do no harm.
    """
    rotation = b_from_a.rotation_matrix()
    a = rays_a / np.linalg.norm(rays_a, axis=1, keepdims=True)
    b = (rays_b / np.linalg.norm(rays_b, axis=1, keepdims=True)) @ rotation
    center = b_from_a.center()
    cosine = np.einsum("nd,nd->n", a, b)
    along_a, along_b = a @ center, b @ center
    determinant = 1.0 - cosine**2
    # both depths carry the positive factor 1 / determinant: only the signs matter
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
    """Mask (N,) of the matches that agree with a known relative pose.

    Of matched homogeneous rays float64 (N, 3), last component 1, and their :func:`ray_slopes`; a
    match with NaN is refused. All False when fewer than ``min_matches`` agree.
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
    """Mask (N,) of the matches that agree with one relative pose of two calibrated cameras.

    Of matched keypoints (N, 2), the best matches first, see
    :func:`~.guided_pyramid.verify_best_first`; in any other order it takes more iterations. All
    False when no model has ``MIN_MATCHES`` inliers; False where a camera's distortion cannot be
    undone.
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
    # the pose is not asked for, and the inliers are known before it is refined
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
    """Verification by a two-view model; the richest's decides which variants agree.

    Of a camera, the image that the variants are of, with its own keypoints (N, 2 or more), the
    other image's (M, 2 or more), and the verified matches int64 (K, 2) of the two as they are.
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
        other_from_image = relative_pose(
            bearing_rays(camera, sets[richest][0][:, :2]),
            bearing_rays(other_camera, sets[richest][1][:, :2]),
            0.5 * (focal + other_focal),
            options,
        )
        if other_from_image is None:
            return found
        other_rays = bearing_rays(other_camera, other_px[:, :2])
        other_slopes = ray_slopes(other_camera, other_px[:, :2], other_rays)
        exact = KnownPoseOptions(max_error_px=options.max_error_px)
        kept = []
        for one in found:
            px = one.keypoints_px[:, :2]
            rays = bearing_rays(camera, px)
            # a ray turns so much more with a pixel of the smaller image
            slopes = ray_slopes(camera, px, rays) / _precision(one.variant)
            others = one.other_rows
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
                kept.append(one.only(good))
        return kept

    return PairVerifier(verify, agree)


def known_pose_of_variants(
    camera: Camera,
    other_rays: Floats,
    other_slopes: Floats,
    other_from_image: RigidTransform,
    options: KnownPoseOptions,
) -> PairVerifier:
    """Verification with the known poses.

    Of the camera of the image that the variants are of, and of the other image's keypoints the rays
    float64 (M, 3) and slopes (M, 2, 2).
    """

    def verify(found: VariantFeatures, matches: NDArray[np.int64]) -> NDArray[np.bool_]:
        px, others = found.keypoints_px[matches[:, 0], :2], matches[:, 1]
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
    """Estimate ``other_from_image`` of matched rays, with a translation of length 1, by RANSAC.

    Of homogeneous rays (N, 3), last component 1, at a focal length in pixels, at which an error
    counts. None where no model has ``min_matches`` inliers.
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
    """poselib's relative pose, of normalised coordinates at a focal length: so it needs to know no
    camera model, and ours knows them all."""
    import poselib

    pinhole = {"model": "PINHOLE", "width": 1, "height": 1, "params": [focal, focal, 0.0, 0.0]}
    ransac = {
        "max_epipolar_error": options.max_error_px,
        "min_iterations": _MIN_ITERATIONS,
        "max_iterations": options.max_iterations,
        "success_prob": _CONFIDENCE,
        "seed": options.seed,
    }
    pixels = rays_a[:, :2] * focal, rays_b[:, :2] * focal
    return poselib.estimate_relative_pose(*pixels, pinhole, pinhole, ransac | sampling, refinement)


def _precision(variant: ImageVariant) -> float:
    """Pixels of the image that a keypoint was found in, for one of the original; 1 at most."""
    return min(1.0, variant.scale)


def agree_by_chance(
    keypoints_a_px: NDArray[np.floating[Any]],
    camera_a: Camera,
    keypoints_b_px: NDArray[np.floating[Any]],
    camera_b: Camera,
    num_matches: int,
    options: TwoViewOptions,
) -> bool:
    """True if wrong matches of two images may agree with a relative pose as well as these do.

    These are the matches (N, 2) that two-view verification kept of ``num_matches``. Of matches that
    are all wrong some lie near the epipolar lines of any model, and RANSAC finds the model with
    most of them. The number of false alarms (Moisan and Stival, A probabilistic criterion to detect
    rigid point matches between two images, IJCV 2004) is how many models as good as this one are
    expected among wrong matches. There a wrong match falls anywhere in the image; but keypoints
    stand where the texture is, and wrong matches are of things that look alike. How often one is
    near its line is therefore counted, on the keypoints themselves: each with the others' partners.
    Few keypoints tell little of that, so it is never taken to be less than anywhere.
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
        # a wrong match that falls anywhere in the image; a Sampson error is of both together
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
