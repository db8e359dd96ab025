"""Keypoints lifted by depth, and points verified by it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from poses import rigid
from pydantic import ValidationError

from megloc_kapture.geometry.cameras import depth_noise, px_from_cam
from megloc_kapture.mapping import depth as module
from megloc_kapture.mapping.depth import (
    KEYPOINT_NOISE_PX,
    DepthVerificationOptions,
    compare_with_depth,
    lift_keypoints,
    lift_with_covariances,
)
from megloc_kapture.plugins import DepthView
from megloc_kapture.values import Camera, RigidTransform

IMAGE = Camera("SIMPLE_RADIAL", 640, 480, (520.0, 321.0, 238.0, -0.05))
DEPTH = Camera("PINHOLE", 320, 240, (290.0, 292.0, 160.0, 120.0))
IDENTITY = RigidTransform.identity()
OFFSET = rigid([0.0, 0.0, 0.02], [0.04, 0.01, 0.0])
SMALL = Camera("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
ASIDE = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.05, 0.0, 0.0))
EXACT = DepthVerificationOptions(max_sigmas=3.0, noise=(0.01, 0.0, 0.0))


def contradicted_by_depth(
    points: NDArray[np.float64],
    depth_m: NDArray[np.float32],
    camera: Camera,
    image_from_depth: RigidTransform,
    *settings: Any,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return masks of the points off the surface, and of those with depth."""
    view = DepthView(camera, depth_m, image_from_depth)
    before, behind, checked = compare_with_depth(points, view, *settings)
    return before | behind, checked


@pytest.fixture(scope="module", autouse=True)
def no_window() -> Iterator[None]:
    """Compare with a single pixel, so that limits are exact."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_WINDOW_PX", 0)
        yield


def plane_depth(camera: Camera) -> NDArray[np.float32]:
    """Return the depth of the plane z = 2 + 0.3 x in the camera's frame."""
    fx, _, cx, _ = camera.params
    x = (np.arange(camera.width) + 0.5 - cx) / fx
    return np.tile((2 / (1 - 0.3 * x)).astype(np.float32), (camera.height, 1))


@pytest.mark.parametrize("image_from_depth", [IDENTITY, OFFSET], ids=["registered", "offset"])
def test_points_lie_on_the_plane_and_on_their_rays(image_from_depth: RigidTransform) -> None:
    keypoints = np.random.default_rng(0).uniform([180, 120], [460, 360], (500, 2))
    points, valid = lift_keypoints(
        keypoints.astype(np.float32), plane_depth(DEPTH), IMAGE, DEPTH, image_from_depth
    )
    assert valid.all()
    in_depth = image_from_depth.inverse().apply(points)
    np.testing.assert_allclose(in_depth[:, 2], 2 + 0.3 * in_depth[:, 0], atol=2e-3)
    np.testing.assert_allclose(px_from_cam(IMAGE, points), keypoints, atol=1e-3)
    # keypoints outside the depth camera's view have no depth
    wide = Camera("PINHOLE", 640, 480, (300.0, 300.0, 320.0, 240.0))
    keypoints = np.array([[5.0, 240.0], [320.0, 240.0]])
    _, valid = lift_keypoints(keypoints, plane_depth(DEPTH), wide, DEPTH, image_from_depth)
    assert valid.tolist() == [False, True]
    empty, none = lift_keypoints(np.zeros((0, 2)), plane_depth(DEPTH), wide, DEPTH, IDENTITY)
    assert empty.shape == (0, 3) and none.shape == (0,)


def test_the_centre_of_the_first_pixel_is_at_half_a_pixel() -> None:
    depth = np.full((2, 3), 5.0, np.float32)
    depth[0, 0] = 4.9
    camera = Camera("PINHOLE", 3, 2, (10.0, 10.0, 1.5, 1.0))
    keypoints = np.array([[0.5, 0.5], [1.0, 0.5], [2.5, 1.5]])
    points, valid = lift_keypoints(keypoints, depth, camera, camera, IDENTITY)
    assert valid.all()
    np.testing.assert_allclose(points[:, 2], [4.9, 4.95, 5.0], rtol=1e-6)


def test_covariances_are_long_by_the_depth_and_wide_by_the_keypoint() -> None:
    depth = np.full((48, 64), 5.0, np.float32)
    sigma = np.full((48, 64), 0.02, np.float32)
    sigma[:, 40:] = 0.0  # unknown
    pixels = np.array([[12.0, 36.0], [50.0, 20.0]])
    points, covariances, valid = lift_with_covariances(pixels, depth, sigma, SMALL, SMALL)
    assert valid.tolist() == [True, False]
    ray = np.array([-20 / 60, 12 / 60, 1.0])
    np.testing.assert_allclose(points[0], 5 * ray)
    # sigma is that of a third of a pixel
    expected = 0.06**2 * np.outer(ray, ray) + (5 / 60) ** 2 * np.diag([1.0, 1.0, 0.0])
    np.testing.assert_allclose(covariances[0], expected)


def test_keypoints_on_an_edge_have_no_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    depth = np.full((100, 100), 2.0, np.float32)
    depth[:, 50:] = 4.0
    camera = Camera("PINHOLE", 100, 100, (100.0, 100.0, 50.0, 50.0))
    keypoints = np.array([[48.0, 20.0], [50.0, 20.0], [52.0, 20.0]])
    points, valid = lift_keypoints(keypoints, depth, camera, camera, IDENTITY)
    assert valid.tolist() == [True, False, True]
    assert np.isnan(points[1]).all()
    monkeypatch.setattr(module, "MAX_DEPTH_JUMP", 1.5)
    assert lift_keypoints(keypoints, depth, camera, camera, IDENTITY)[1].all()


def test_missing_depth_falls_back_to_the_nearest_pixel() -> None:
    depth = np.full((4, 4), 3.0, np.float32)
    depth[1, 2], depth[2, 1], depth[2, 2] = 0.0, np.nan, -1.0
    depth[1, 1] = 2.9
    camera = Camera("PINHOLE", 4, 4, (10.0, 10.0, 2.0, 2.0))
    points, valid = lift_keypoints(np.array([[1.6, 1.6]]), depth, camera, camera, IDENTITY)
    assert valid.all()
    np.testing.assert_allclose(points[0, 2], 2.9, rtol=1e-6)
    nothing = np.zeros((4, 4), np.float32)
    assert not lift_keypoints(np.array([[1.6, 1.6]]), nothing, camera, camera, IDENTITY)[1].any()


@given(
    seed=st.integers(0, 2**32 - 1),
    off=st.floats(-0.2, 0.2).filter(lambda off: abs(abs(off) - 0.03) > 0.02),
)
def test_points_off_the_plane_by_more_than_the_noise_contradict(seed: int, off: float) -> None:
    depth, normal = plane_depth(SMALL), np.array([-0.3, 0.0, 1.0])  # n . X = 2
    rng = np.random.default_rng(seed)
    rays = np.column_stack([rng.uniform(-0.4, 0.4, 50), rng.uniform(-0.3, 0.3, 50), np.ones(50)])
    on_plane = rays * (2.0 / (rays @ normal))[:, None]
    # within a pixel the plane's depth changes by less than 0.02
    in_depth = on_plane * ((on_plane[:, 2] + off) / on_plane[:, 2])[:, None]
    points = ASIDE.apply(in_depth)
    contradicted, checked = contradicted_by_depth(points, depth, SMALL, ASIDE, EXACT)
    assert checked.all()
    assert contradicted.all() if abs(off) > 0.03 else not contradicted.any()


def test_the_offset_between_the_cameras_counts() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:, 32:] = 1.0
    # in the depth camera the point is on the left of the step
    point = np.array([[0.02, 0.0, 2.0]])
    assert contradicted_by_depth(point, depth, SMALL, IDENTITY, EXACT)[0].all()
    assert not contradicted_by_depth(point, depth, SMALL, ASIDE, EXACT)[0].any()


def test_either_surface_is_accepted_near_an_edge(monkeypatch: pytest.MonkeyPatch) -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:, 32:] = 1.0
    monkeypatch.setattr(module, "_WINDOW_PX", 2)
    # pixel columns 28 to 35: 1 m is right from column 30 on, 2 m up to column 33
    near = np.column_stack([(np.arange(28, 36) + 0.5 - 32.0) / 60.0, np.zeros(8), np.ones(8)])
    wrong = {1.0: [True] * 2 + [False] * 6, 2.0: [False] * 6 + [True] * 2}
    for metres, expected in (wrong | {2.5: [True] * 8}).items():
        result, checked = contradicted_by_depth(near * metres, depth, SMALL, IDENTITY, EXACT)
        assert checked.all() and result.tolist() == expected


@pytest.mark.parametrize("missing", [0.0, -1.0, np.nan, np.inf])
def test_missing_depth_contradicts_nothing(missing: float, monkeypatch: pytest.MonkeyPatch) -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    depth[20:28, 28:36] = missing
    wrong = np.array([[0.0, 0.0, 5.0]])
    monkeypatch.setattr(module, "_WINDOW_PX", 1)
    for point in (wrong, wrong + [0.3, 0.0, 0.0]):  # in the hole and next to it
        for judged in contradicted_by_depth(point, depth, SMALL, IDENTITY, EXACT):
            assert not judged.any()
    known = wrong + [1.0, 0.0, 0.0]
    assert contradicted_by_depth(known, depth, SMALL, IDENTITY, EXACT)[0].all()
    # points outside the image or behind the camera
    points = np.array([[0.0, 0.0, -2.0], [10.0, 0.0, 2.0], [0.0, -10.0, 2.0], [0.0, 0.0, 0.0]])
    for judged in contradicted_by_depth(points, depth, SMALL, IDENTITY, EXACT):
        assert not judged.any()


def test_an_uncertain_point_may_be_farther_off() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    points = np.repeat([[0.0, 0.0, 2.5]], 4, axis=0)
    # 0.5 off: 3 sigmas of hypot(0.01, 2 * deviation)
    least = np.sqrt((0.5 / 3) ** 2 - 0.01**2) / 2.0
    deviations = np.array([0.0, np.nan, 0.999 * least, 1.001 * least])
    sigmas = KEYPOINT_NOISE_PX * deviations
    contradicted, _ = contradicted_by_depth(points, depth, SMALL, IDENTITY, EXACT, sigmas)
    assert contradicted.tolist() == [True, True, True, False]


def test_the_default_noise_is_the_published_formula() -> None:
    z = np.linspace(0.4, 5.0, 20)
    published = 0.0012 + 0.0019 * (z - 0.4) ** 2
    np.testing.assert_allclose(depth_noise(z, DepthVerificationOptions().noise), published)


@pytest.mark.parametrize("noise", [(0.0, 0.0, 0.1), (0.001, -0.01, 0.001), (0.01, -0.1, 0.0)])
def test_noise_that_is_not_positive_is_refused(noise: tuple[float, float, float]) -> None:
    with pytest.raises(ValidationError, match="must be positive at every depth"):
        DepthVerificationOptions(noise=noise)
