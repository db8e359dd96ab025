"""Geometric verification of matches: with known poses, or by a two-view model.

Known poses (mapping pairs): the essential matrix is given, so verification is one vectorised
Sampson distance and a test that the rays meet in front of both cameras; no sampling. The distance
is in pixels of the images as they were taken: how far both measurements together have to move, to
first order, until their rays meet. Unknown pose (query pairs): LO-RANSAC of the relative pose by
poselib.

With rays r = (x, y, 1), the epipolar constraint is C = r_b . E r_a. Its derivatives with respect to
the four measured coordinates follow from those of C with respect to x and y and from the inverse of
d px / d (x, y), which is the derivative of the camera's own projection; the distance is |C| over
their norm (Hartley and Zisserman, Multiple View Geometry, eq. 4.13; for one focal length and no
distortion it is their eq. 11.9 times the focal length).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.geometry.cameras import bearing_rays, focal_px
from megloc_kapture.geometry.poses import cross_matrix
from megloc_kapture.values import Camera, Options, RigidTransform

Floats = NDArray[np.float64]

# a ray that is seen this far from its pixel is none of this pixel
_MAX_RAY_ERROR_PX = 0.1


class KnownPoseOptions(Options):
    """Options of verification with the known poses."""

    max_error_px: float = Field(default=4.0, gt=0, description="Sampson distance in the images")
    min_matches: int = Field(default=15, ge=0, description="a pair with fewer left has none")


class TwoViewOptions(Options):
    """Options of two-view verification; calibrated, so a plane is no degenerate case."""

    max_error_px: float = Field(default=4.0, gt=0)
    min_matches: int = Field(default=15, ge=5)
    max_iterations: int = Field(default=1000, gt=0)
    min_iterations: int = Field(default=100, gt=0)
    confidence: float = Field(default=0.999, gt=0, lt=1)
    seed: int = Field(default=0, ge=0)


def essential_matrix(b_from_a: RigidTransform) -> Floats:
    """E (3, 3) with ``ray_b . E ray_a = 0``."""
    return cross_matrix(np.array(b_from_a.translation)) @ b_from_a.rotation_matrix()


def ray_slopes(camera: Camera, keypoints_px: NDArray[np.floating[Any]], rays: Floats) -> Floats:
    """How rays turn with their pixels, under the camera's own model.

    Parameters
    ----------
    keypoints_px : (N, 2).
    rays : float64 (N, 3), their homogeneous rays, last component 1.

    Returns
    -------
    float64 (N, 2, 2), d (x, y) / d px. NaN where a ray is not that of its pixel: the distortion
    cannot be undone there, or the pixel looks sideways or back, as pixels of a fisheye may.
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
    rays_a: Floats,
    slopes_a: Floats,
    rays_b: Floats,
    slopes_b: Floats,
    b_from_a: RigidTransform,
) -> Floats:
    """Sampson distance in pixels of matched rays (N, 3), last component 1, see above; (N,).

    Parameters
    ----------
    slopes_a, slopes_b : float64 (N, 2, 2), see :func:`ray_slopes`.

    Returns
    -------
    float64 (N,); infinite where there is no epipolar line, NaN where a slope is.
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
    """Whether the midpoint of two rays' common perpendicular is in front of both cameras; (N,).

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
) -> NDArray[np.bool_]:
    """Which matches agree with a known relative pose.

    Parameters
    ----------
    rays_a, rays_b : float64 (N, 3), matched homogeneous rays, last component 1.
    slopes_a, slopes_b : float64 (N, 2, 2), see :func:`ray_slopes`; a match with NaN is refused.
    b_from_a : the known pose.

    Returns
    -------
    bool (N,); all False when fewer than ``min_matches`` agree.
    """
    options = options or KnownPoseOptions()
    if len(rays_a) == 0:
        return np.zeros(0, dtype=bool)
    error = sampson_error_px(rays_a, slopes_a, rays_b, slopes_b, b_from_a)
    good = (error <= options.max_error_px) & in_front_of_both(rays_a, rays_b, b_from_a)
    if good.sum() < options.min_matches:
        good[:] = False
    return good


def verify_two_view(
    keypoints_a_px: NDArray[np.floating[Any]],
    camera_a: Camera,
    keypoints_b_px: NDArray[np.floating[Any]],
    camera_b: Camera,
    options: TwoViewOptions | None = None,
) -> NDArray[np.bool_]:
    """Which matches agree with one relative pose of two calibrated cameras.

    Parameters
    ----------
    keypoints_a_px, keypoints_b_px : (N, 2) matched keypoints.

    Returns
    -------
    bool (N,); all False when no model has ``min_matches`` inliers. False where a camera's
    distortion cannot be undone.
    """
    import poselib

    options = options or TwoViewOptions()
    none = np.zeros(len(keypoints_a_px), dtype=bool)
    rays_a = bearing_rays(camera_a, keypoints_a_px)
    rays_b = bearing_rays(camera_b, keypoints_b_px)
    usable = np.isfinite(rays_a).all(axis=1) & np.isfinite(rays_b).all(axis=1)
    if usable.sum() < options.min_matches:
        return none
    # in normalised coordinates poselib needs to know no camera model, and ours knows them all
    focal = 0.5 * (focal_px(camera_a) + focal_px(camera_b))
    pinhole = {
        "model": "PINHOLE",
        "width": 1,
        "height": 1,
        "params": [focal, focal, 0.0, 0.0],
    }
    _, info = poselib.estimate_relative_pose(
        rays_a[usable, :2] * focal,
        rays_b[usable, :2] * focal,
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
    inliers = np.asarray(info["inliers"], dtype=bool)
    if len(inliers) != usable.sum() or inliers.sum() < options.min_matches:
        return none
    good = none.copy()
    good[usable] = inliers
    return good
