"""Verification against scenes whose poses and true matches are known, and against COLMAP."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from camera_models import CAMERAS, PINHOLE, STRONG
from numpy.typing import NDArray
from poses import rigid
from scipy.optimize import least_squares

from megloc_kapture.geometry.cameras import bearing_rays, project, px_from_cam
from megloc_kapture.io.colmap import new_colmap_pose
from megloc_kapture.matching.verification import (
    KnownPoseOptions,
    TwoViewOptions,
    agree_by_chance,
    essential_matrix,
    in_front_of_both,
    ray_slopes,
    sampson_error_px,
    verify_two_view,
    verify_with_poses,
)
from megloc_kapture.values import Camera, RigidTransform

Array = NDArray[np.float64]
DISTORTED = [CAMERAS[model] for model in ("SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE")]


def undistorted(rays: Array, focal_px: float) -> tuple[Array, Array]:
    """Return rays and their slopes in a camera without distortion."""
    return rays, np.repeat(np.eye(2)[None] / focal_px, len(rays), axis=0)


def seen(camera: Camera, pixels: Array) -> tuple[Array, Array]:
    rays = bearing_rays(camera, pixels)
    return rays, ray_slopes(camera, pixels, rays)


# normalised coordinates times the focal length differ a lot from pixels
WIDE = [
    Camera("OPENCV_FISHEYE", 900, 900, (280.0, 280.0, 450.0, 450.0, 0.02, -0.005, 0.0, 0.0)),
    Camera("OPENCV", 900, 700, (350.0, 340.0, 450.0, 350.0, -0.25, 0.08, 2e-3, -1e-3)),
]


@pytest.mark.parametrize("camera", WIDE, ids=lambda camera: camera.model)
def test_slopes_are_the_derivatives_of_rays(camera: Camera) -> None:
    pixels = np.random.default_rng(0).uniform((150, 100), (750, 600), (40, 2))
    moves = 0.01 * np.eye(2)
    ends = [(bearing_rays(camera, pixels + m) - bearing_rays(camera, pixels - m)) for m in moves]
    expected = np.stack(ends, axis=2)[:, :2] / 0.02
    np.testing.assert_allclose(seen(camera, pixels)[1], expected, rtol=1e-3, atol=1e-7)


B_FROM_A = rigid([0.02, -0.15, 0.05], [-1.0, 0.1, 0.2])


def scene(
    camera_a: Camera, camera_b: Camera, count: int = 200, seed: int = 0
) -> tuple[Array, Array, Array]:
    """Return points (N, 3) in a's frame that both cameras see, and their pixels in both."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-3, -2, 4), (3, 2, 9), (8 * count, 3))
    in_a = project(camera_a, RigidTransform.identity(), points)
    in_b = project(camera_b, B_FROM_A, points)
    seen = np.ones(len(points), dtype=bool)
    for camera, pixels in ((camera_a, in_a), (camera_b, in_b)):
        seen &= ((pixels > 0) & (pixels < (camera.width, camera.height))).all(axis=1)
    assert seen.sum() >= count
    return points[seen][:count], in_a[seen][:count], in_b[seen][:count]


def test_essential_matrix_is_colmaps() -> None:
    ours = essential_matrix(B_FROM_A)
    theirs = pycolmap.essential_matrix_from_pose(new_colmap_pose(B_FROM_A))
    # COLMAP's has the translation at unit length
    np.testing.assert_allclose(
        ours / np.linalg.norm(ours), theirs / np.linalg.norm(theirs), atol=1e-14
    )


def test_the_sampson_distance_is_colmaps() -> None:
    """Both cameras have the same focal length and no distortion."""
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(50, 2)), rng.normal(size=(50, 2))
    expected = pycolmap.compute_squared_sampson_error(a, b, essential_matrix(B_FROM_A))
    camera = Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))
    pixels = [500.0 * xy + np.array([320.0, 240.0]) for xy in (a, b)]
    ours = sampson_error_px(*seen(camera, pixels[0]), *seen(camera, pixels[1]), B_FROM_A)
    np.testing.assert_allclose((ours / 500.0) ** 2, expected, rtol=1e-9)
    assert np.median(ours) > 10  # random matches are far from the epipolar lines


def smallest_correction_px(
    camera_a: Camera, px_a: Array, camera_b: Camera, px_b: Array, start: Array
) -> float:
    """Return by least squares the smallest correction of two measurements of a point."""

    def residuals(point: Array) -> Array:
        in_a = project(camera_a, RigidTransform.identity(), point[None])[0]
        in_b = project(camera_b, B_FROM_A, point[None])[0]
        return np.concatenate([in_a - px_a, in_b - px_b])

    result = least_squares(residuals, start, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return float(np.linalg.norm(result.fun))


@pytest.mark.parametrize(
    ("camera_a", "camera_b"), [(WIDE[0], PINHOLE), (WIDE[1], WIDE[0])], ids=["pinhole", "fisheye"]
)
def test_the_error_is_that_of_optimal_triangulation(camera_a: Camera, camera_b: Camera) -> None:
    rng = np.random.default_rng(7)
    points, in_a, in_b = scene(camera_a, camera_b, count=8)
    in_a, in_b = in_a + rng.normal(size=in_a.shape), in_b + rng.normal(size=in_b.shape)
    ours = sampson_error_px(*seen(camera_a, in_a), *seen(camera_b, in_b), B_FROM_A)
    expected = [
        smallest_correction_px(camera_a, px_a, camera_b, px_b, point)
        for px_a, px_b, point in zip(in_a, in_b, points, strict=True)
    ]
    assert np.median(expected) > 0.2
    np.testing.assert_allclose(ours, expected, rtol=0.01, atol=0.01)


@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED[0], WIDE[0]], ids=lambda c: c.model)
def test_exact_matches_pass_and_others_do_not(camera: Camera) -> None:
    points, in_a, in_b = scene(camera, camera)
    matches = (*seen(camera, in_a), *seen(camera, in_b))
    assert verify_with_poses(*matches, B_FROM_A).all()
    # the same matches under another pose do not
    wrong = rigid([0.02, -0.05, 0.05], [-1.0, 0.9, 0.2])
    assert not verify_with_poses(*matches, wrong, KnownPoseOptions(max_error_px=2.0)).any()


def test_points_behind_a_camera_do_not_pass() -> None:
    points, in_a, in_b = scene(PINHOLE, PINHOLE, count=100)
    behind = points.copy()
    behind[:50] *= -1  # the same ray in a, behind it
    behind[50:65] *= (0.1, 0.1, -0.01)  # between the cameras: behind a, in front of b
    rays_a = np.column_stack([behind[:, :2] / behind[:, 2:], np.ones(100)])
    in_b_frame = B_FROM_A.apply(behind)
    rays_b = np.column_stack([in_b_frame[:, :2] / in_b_frame[:, 2:], np.ones(100)])
    # all of them lie on their epipolar lines exactly
    matches = (*undistorted(rays_a, 500.0), *undistorted(rays_b, 500.0))
    assert sampson_error_px(*matches, B_FROM_A).max() < 1e-9
    assert (in_b_frame[50:65, 2] > 0).all()
    expected = (behind[:, 2] > 0) & (in_b_frame[:, 2] > 0)
    np.testing.assert_array_equal(in_front_of_both(rays_a, rays_b, B_FROM_A), expected)
    np.testing.assert_array_equal(verify_with_poses(*matches, B_FROM_A), expected)
    # a point at infinity passes
    direction = np.array([[0.1, -0.2, 1.0]])
    in_b = direction @ B_FROM_A.rotation_matrix().T
    assert in_front_of_both(direction, in_b / in_b[:, 2:], B_FROM_A).all()


def test_cameras_without_a_baseline_verify_nothing() -> None:
    rays = bearing_rays(PINHOLE, np.random.default_rng(0).uniform(0, 480, (50, 2)))
    turned = rigid([0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    moved = rays @ turned.rotation_matrix().T
    others = undistorted(moved / moved[:, 2:], 500.0)
    assert not verify_with_poses(*undistorted(rays, 500.0), *others, turned).any()


def test_too_few_good_matches_are_rejected() -> None:
    points, in_a, in_b = scene(PINHOLE, PINHOLE, count=40)
    in_b[10:] += (0.0, 60.0)
    matches = (*seen(PINHOLE, in_a), *seen(PINHOLE, in_b))
    for min_matches, expected in ((10, 10), (11, 0)):
        good = verify_with_poses(*matches, B_FROM_A, min_matches=min_matches)
        assert good.sum() == expected
    none = undistorted(np.zeros((0, 3)), 515.0)
    assert verify_with_poses(*none, *none, B_FROM_A).shape == (0,)


def test_pixels_without_rays_do_not_pass() -> None:
    points, in_a, in_b = scene(STRONG, PINHOLE, count=100)
    in_a[3], in_a[99] = (0.0, 0.0), (640.0, 480.0)
    good = verify_with_poses(*seen(STRONG, in_a), *seen(PINHOLE, in_b), B_FROM_A)
    assert not good[3] and good.sum() == 98
    good = verify_two_view(in_a, STRONG, in_b, PINHOLE)
    assert not good[3] and not good[99] and good.sum() > 93


def test_fisheye_pixels_without_a_forward_ray_are_refused() -> None:
    """Such a pixel has no ray (x, y, 1), but COLMAP returns a ray of another pixel."""
    camera = WIDE[0]
    radius = np.linspace(1.0, 630.0, 300)
    pixels = 450.0 + np.stack([radius, radius], axis=1) * np.sqrt(0.5)
    theta = np.linspace(0, 2.6, 100_000)
    k1, k2, _, _ = camera.params[4:]
    distorted = theta + k1 * theta**3 + k2 * theta**5
    rising = np.diff(distorted, append=np.inf) > 0
    largest = 280.0 * distorted[rising & (theta < np.pi / 2)].max()
    _, slopes = seen(camera, pixels)
    inside = radius < largest - 3
    outside = radius > largest + 1
    assert inside.sum() > 50 and outside.sum() > 50
    assert np.isfinite(slopes[inside]).all()
    assert np.isnan(slopes[outside]).all()


@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED[2]], ids=lambda c: c.model)
def test_two_views_keep_the_inliers_among_as_many_outliers(camera: Camera) -> None:
    rng = np.random.default_rng(0)
    _, in_a, in_b = scene(camera, PINHOLE, count=300)
    few = verify_two_view(in_a[:14], camera, in_b[:14], PINHOLE)
    assert few.shape == (14,) and not few.any()
    assert verify_two_view(in_a[:0], camera, in_b[:0], PINHOLE).shape == (0,)
    in_a, in_b = in_a + 0.5 * rng.normal(size=in_a.shape), in_b + 0.5 * rng.normal(size=in_b.shape)
    outlier = np.arange(300) % 2 == 1
    in_b[outlier] = rng.uniform((0, 0), (640, 480), (150, 2))
    good = verify_two_view(in_a, camera, in_b, PINHOLE)
    np.testing.assert_array_equal(good, verify_two_view(in_a, camera, in_b, PINHOLE))
    assert good[~outlier].mean() > 0.95
    # an outlier passes where it falls on its epipolar line: a band of 8 px in 480, with cheirality
    assert good[outlier].mean() < 0.06
    # nothing in common
    assert not verify_two_view(in_a[:60], camera, in_b[60:120], PINHOLE).any()


def test_two_views_of_a_plane() -> None:
    rng = np.random.default_rng(2)
    points = np.column_stack(
        [rng.uniform(-2, 2, 100), rng.uniform(-1.5, 1.5, 100), np.full(100, 6)]
    )
    in_a = project(PINHOLE, RigidTransform.identity(), points)
    in_b = project(PINHOLE, B_FROM_A, points)
    assert verify_two_view(in_a, PINHOLE, in_b, PINHOLE).mean() > 0.95


CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
OPTIONS = TwoViewOptions(max_iterations=5000)


def verified(first: Array, second: Array) -> tuple[Array, Camera, Array, Camera, int]:
    """Return the inliers of RANSAC, as arguments of ``agree_by_chance``."""
    kept = verify_two_view(first, CAMERA, second, CAMERA, OPTIONS)
    return first[kept], CAMERA, second[kept], CAMERA, len(first)


def of_one_scene(number: int, share: float, seed: int) -> tuple[Array, Array]:
    """Return matches; a share of them is of the same scene, the others are random."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (number, 3))
    first, second = px_from_cam(CAMERA, points), px_from_cam(CAMERA, points - (0.6, 0.1, 0.2))
    wrong = rng.random(number) >= share
    second[wrong] = rng.uniform((0, 0), (640, 480), (wrong.sum(), 2))
    return first, second


@pytest.mark.parametrize(
    ("number", "share", "by_chance"),
    [(40, 0.0, True), (600, 0.0, True), (40, 0.8, False), (600, 0.2, False)],
)
def test_random_matches_agree_by_chance(number: int, share: float, by_chance: bool) -> None:
    result = verified(*of_one_scene(number, share, seed=1))
    assert agree_by_chance(*result, OPTIONS) == by_chance, len(result[0])
    first, _, second, *_ = result
    assert agree_by_chance(first[:5], CAMERA, second[:5], CAMERA, 5, OPTIONS)  # a minimal sample


def test_random_matches_in_a_band_agree_by_chance() -> None:
    """Most wrong matches are near the epipolar line of a camera that moves along the band."""
    rng = np.random.default_rng(0)
    first, second = (
        np.column_stack([rng.uniform(0, 640, 200), 240 + rng.normal(0, 4, 200)]) for _ in range(2)
    )
    result = verified(first, second)
    assert len(result[0]) > 60
    assert agree_by_chance(*result, OPTIONS), len(result[0])
