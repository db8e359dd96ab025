"""Views for stereo: distortion undone, planes carried over, sources chosen, errors of poses."""

from __future__ import annotations

import numpy as np
from corner import CAMERA, depth_m, pose_at
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import bearing_rays, project, px_from_cam
from megloc_kapture.mvs.views import (
    choose_sources,
    depth_range,
    relative_projection,
    stereo_view,
    with_pose_errors,
)
from megloc_kapture.plugins import DepthEstimate, StereoView
from megloc_kapture.values import Camera

LENS = Camera("OPENCV", 400, 300, (310.0, 305.0, 203.0, 147.0, -0.2, 0.05, 0.001, -0.002))


def _ramps(camera: Camera) -> NDArray[np.uint8]:
    y, x = np.mgrid[: camera.height, : camera.width]
    return np.stack([x / 2, y / 2, np.zeros_like(x)], axis=-1).astype(np.uint8)


def test_a_plane_is_carried_to_where_its_points_project() -> None:
    reference = StereoView(_ramps(CAMERA), CAMERA, pose_at((0.2, -0.1, 0.3), 5, -3))
    source = StereoView(_ramps(CAMERA), CAMERA, pose_at((-0.7, 0.2, 0.1), -2, 4))
    normal, distance = np.array([0.3, -0.2, 0.9]), 4.0  # of the plane, in the reference's frame
    px = np.random.default_rng(0).uniform(0, 300, (200, 2))
    rays = bearing_rays(CAMERA, px)
    inverse = rays @ normal / distance
    world = reference.cam_from_world.inverse().apply(rays / inverse[:, None])
    infinity, baseline = relative_projection(reference, source)
    pixels = np.column_stack([px - 0.5, np.ones(len(px))])
    path = pixels @ infinity.T + inverse[:, None] * baseline
    result = path[:, :2] / path[:, 2:] + 0.5
    np.testing.assert_allclose(result, project(CAMERA, source.cam_from_world, world), atol=1e-8)
    # as a homography: the plane's inverse depth is linear in the pixel
    covector = np.linalg.lstsq(pixels, inverse, rcond=None)[0]
    bent = pixels @ (infinity + np.outer(baseline, covector)).T
    np.testing.assert_allclose(bent[:, :2] / bent[:, 2:] + 0.5, result, atol=1e-8)


def test_distortion_is_undone() -> None:
    size = 200
    view = stereo_view(_ramps(LENS), LENS, pose_at((0, 0, 0), 0, 0), None, size)
    assert view.camera.model == "PINHOLE" and max(view.image.shape) <= size
    y, x = np.mgrid[10 : view.camera.height - 10 : 7, 10 : view.camera.width - 10 : 7]
    px = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
    expected = (px_from_cam(LENS, bearing_rays(view.camera, px)) - 0.5) / 2
    shown = view.image[y.ravel(), x.ravel(), :2].astype(float)
    assert np.abs(shown - expected).max() < 1.6  # grey levels; a pixel is half a level


def test_sources_share_points_under_an_angle() -> None:
    xyz = np.random.default_rng(2).uniform([-1, -1, 9], [1, 1, 11], (60, 3))
    # 0 is the reference; 1 is next to it, 2 at 11 degrees, 3 at 60 degrees, 4 shares no points
    centers = np.array([[0, 0, 0], [0.05, 0, 0], [2, 0, 0], [17, 0, 0], [2, 0.1, 0]], float)
    seen = [np.arange(40), np.arange(40), np.arange(20), np.arange(40), np.arange(40, 60)]
    ids = np.concatenate(seen)
    order = np.argsort(ids, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(ids, minlength=60))])
    images = np.repeat(np.arange(5), [len(points) for points in seen])[order]
    everybody = np.ones(5, bool)
    arguments = (xyz, seen, (starts, images), centers)
    assert choose_sources(0, everybody, *arguments, 4) == [2, 3, 1]
    assert choose_sources(0, everybody, *arguments, 1) == [2]
    others = np.array([True, True, False, True, True])
    assert choose_sources(0, others, *arguments, 4) == [3, 1]


def test_the_range_of_depth_ignores_outliers() -> None:
    depths = np.concatenate([np.linspace(5, 10, 200), [900.0, -4.0]])
    near, far = depth_range(depths) or (0.0, 0.0)
    assert 3.9 < near < 4.1 and 12.4 < far < 12.6
    assert depth_range(np.array([3.0, 4.0, -1.0])) is None


def _view(center_m: tuple[float, float, float]) -> StereoView:
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    return StereoView(image, CAMERA, pose_at(center_m, 0, 0))


def test_a_pixel_of_error_moves_depth_as_the_baseline_says() -> None:
    reference, near, far = _view((0, 0, 0)), _view((0.5, 0, 0)), _view((1.0, 0, 0))
    depth: NDArray[np.float32] = depth_m(reference.cam_from_world).astype(np.float32)
    depth[:10] = 0
    estimate = DepthEstimate(depth, 0.01 * depth, np.zeros((*depth.shape, 3), np.float32))
    focal = CAMERA.params[0]
    result = with_pose_errors(reference, [near], estimate, (2.0, 8.0), 0.5)
    # z = f b / d in a rectified pair, so that dz = z^2 / (f b) dd
    expected = np.hypot(0.01 * depth, 0.5 * depth.astype(float) ** 2 / (focal * 0.5))
    np.testing.assert_allclose(result.sigma_m, expected, rtol=0.02)
    assert not result.sigma_m[:10].any()
    both = with_pose_errors(reference, [near, far], estimate, (2.0, 8.0), 0.5)
    steps = np.array([1 / 0.5, 1 / 1.0]) / focal
    mixed = 0.5 * np.sqrt(np.mean(steps**2)) * depth.astype(float) ** 2
    np.testing.assert_allclose(both.sigma_m, np.hypot(0.01 * depth, mixed), rtol=0.02)
    np.testing.assert_array_equal(
        with_pose_errors(reference, [near], estimate, (2.0, 8.0), 0.0).sigma_m, estimate.sigma_m
    )
