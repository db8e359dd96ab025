"""What the errors of poses do to depth, against moved cameras."""

from __future__ import annotations

import numpy as np
from corner import CAMERA, depth_m, pose_at
from numpy.typing import NDArray

from megloc_kapture.mvs.views import with_pose_errors
from megloc_kapture.plugins import DepthEstimate, StereoView


def _view(center_m: tuple[float, float, float]) -> StereoView:
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    return StereoView(image, CAMERA, pose_at(center_m, 0, 0))


def test_a_pixel_of_error_moves_depth_as_the_baseline_says() -> None:
    reference, near, far = _view((0, 0, 0)), _view((0.5, 0, 0)), _view((1.0, 0, 0))
    depth: NDArray[np.float32] = depth_m(reference.cam_from_world).astype(np.float32)
    depth[:10] = 0
    estimate = DepthEstimate(depth, 0.01 * depth, np.zeros((*depth.shape, 3), np.float32))
    focal = CAMERA.params[0]
    found = with_pose_errors(reference, [near], estimate, (2.0, 8.0), 0.5)
    # z = f b / d in a rectified pair, so that dz = z^2 / (f b) dd
    expected = np.hypot(0.01 * depth, 0.5 * depth.astype(float) ** 2 / (focal * 0.5))
    np.testing.assert_allclose(found.sigma_m, expected, rtol=0.02)
    assert not found.sigma_m[:10].any()
    both = with_pose_errors(reference, [near, far], estimate, (2.0, 8.0), 0.5)
    steps = np.array([1 / 0.5, 1 / 1.0]) / focal
    mixed = 0.5 * np.sqrt(np.mean(steps**2)) * depth.astype(float) ** 2
    np.testing.assert_allclose(both.sigma_m, np.hypot(0.01 * depth, mixed), rtol=0.02)
    np.testing.assert_array_equal(
        with_pose_errors(reference, [near], estimate, (2.0, 8.0), 0.0).sigma_m, estimate.sigma_m
    )
