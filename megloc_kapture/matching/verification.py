"""Geometric verification of matches: with known poses, or by a two-view model.

Known poses (mapping pairs): the essential matrix is given, so verification is one vectorised
Sampson distance (Hartley and Zisserman, Multiple View Geometry, eq. 11.9) and a test that the
rays meet in front of both cameras; no sampling. Unknown pose (query pairs): LO-RANSAC of the
relative pose by poselib.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.geometry.cameras import bearing_rays, focal_px
from megloc_kapture.values import Camera, Options, RigidTransform


class KnownPoseOptions(Options):
    """Options of verification with the known poses."""

    max_error_px: float = Field(default=4.0, gt=0, description="Sampson distance")
    min_matches: int = Field(default=15, ge=0, description="a pair with fewer left has none")


class TwoViewOptions(Options):
    """Options of two-view verification; calibrated, so a plane is no degenerate case."""

    max_error_px: float = Field(default=4.0, gt=0)
    min_matches: int = Field(default=15, ge=5)
    max_iterations: int = Field(default=1000, gt=0)
    min_iterations: int = Field(default=100, gt=0)
    confidence: float = Field(default=0.999, gt=0, lt=1)
    seed: int = Field(default=0, ge=0)


def cross_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """``[v]_x`` (3, 3) with ``[v]_x w = v x w``."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def essential_matrix(b_from_a: RigidTransform) -> NDArray[np.float64]:
    """E (3, 3) with ``ray_b . E ray_a = 0``."""
    return cross_matrix(np.array(b_from_a.translation)) @ b_from_a.rotation_matrix()


def sampson_error_px(
    rays_a: NDArray[np.float64],
    rays_b: NDArray[np.float64],
    b_from_a: RigidTransform,
    *,
    focal_px: float,
) -> NDArray[np.float64]:
    """Sampson distance in pixels of homogeneous rays (N, 3) with last component 1; (N,)."""
    essential = essential_matrix(b_from_a)
    line_b = rays_a @ essential.T
    line_a = rays_b @ essential
    numerator = np.einsum("nd,nd->n", rays_b, line_b)
    denominator = np.sqrt(
        line_a[:, 0] ** 2 + line_a[:, 1] ** 2 + line_b[:, 0] ** 2 + line_b[:, 1] ** 2
    )
    return np.asarray(
        focal_px
        * np.divide(
            np.abs(numerator),
            denominator,
            out=np.full(len(numerator), np.inf),
            where=denominator > 0,
        )
    )


def in_front_of_both(
    rays_a: NDArray[np.float64], rays_b: NDArray[np.float64], b_from_a: RigidTransform
) -> NDArray[np.bool_]:
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
    rays_a: NDArray[np.float64],
    rays_b: NDArray[np.float64],
    b_from_a: RigidTransform,
    *,
    focal_px: float,
    options: KnownPoseOptions | None = None,
) -> NDArray[np.bool_]:
    """Which matches agree with a known relative pose.

    Parameters
    ----------
    rays_a, rays_b : float64 (N, 3), matched homogeneous rays, last component 1.
    b_from_a : the known pose.
    focal_px : mean focal length of the two cameras.

    Returns
    -------
    bool (N,); all False when fewer than ``min_matches`` agree.
    """
    options = options or KnownPoseOptions()
    if len(rays_a) == 0:
        return np.zeros(0, dtype=bool)
    good = sampson_error_px(rays_a, rays_b, b_from_a, focal_px=focal_px) <= options.max_error_px
    good &= in_front_of_both(rays_a, rays_b, b_from_a)
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
