"""Depth maps to points, against a restatement pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from megloc_kapture.plugins import DepthView
from megloc_kapture.refinement.depth_cloud import DepthCloudOptions, depth_cloud
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("PINHOLE", 9, 7, (8.0, 9.0, 4.2, 3.6))
IMAGE_FROM_DEPTH = RigidTransform.from_matrix(
    Rotation.from_euler("xyz", [0.02, -0.05, 0.01]).as_matrix(), np.array([0.03, -0.01, 0.02])
)


def pixel_by_pixel(depth: np.ndarray, options: DepthCloudOptions, step_px: int) -> np.ndarray:
    fx, fy, cx, cy = CAMERA.params
    points = []
    for row in range(step_px // 2, CAMERA.height, step_px):
        for column in range(step_px // 2, CAMERA.width, step_px):
            z = float(depth[row, column])
            if not 0 < z <= options.max_depth_m:
                continue
            around = [
                float(depth[r, c])
                for r in range(max(row - 1, 0), min(row + 2, CAMERA.height))
                for c in range(max(column - 1, 0), min(column + 2, CAMERA.width))
                if depth[r, c] > 0
            ]
            if any(max(z, other) / min(z, other) > 1 + options.max_jump for other in around):
                continue
            points.append([(column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z, z])
    return IMAGE_FROM_DEPTH.apply(np.array(points).reshape(-1, 3))


@given(
    seed=st.integers(0, 10**6),
    step_px=st.integers(1, 3),
    max_depth_m=st.sampled_from([1.5, 4.0]),
    spread=st.sampled_from([0.01, 0.03, 0.3]),
)
def test_every_pixel(seed: int, step_px: int, max_depth_m: float, spread: float) -> None:
    rng = np.random.default_rng(seed)
    depth = rng.choice([1.0, 1.48, 3.9]) * rng.uniform(1 - spread, 1 + spread, (7, 9))
    holes = rng.random((7, 9)) < 0.2
    depth[holes] = rng.choice([0.0, -1.0, np.nan], int(holes.sum()))
    depth = depth.astype(np.float32)
    options = DepthCloudOptions(max_depth_m=max_depth_m)
    points = depth_cloud(DepthView(CAMERA, depth, IMAGE_FROM_DEPTH), options, step_px=step_px)
    assert points.dtype == np.float64
    np.testing.assert_allclose(points, pixel_by_pixel(depth, options, step_px), atol=1e-9)


def test_an_infinite_depth_is_none() -> None:
    depth = np.full((7, 9), np.inf, np.float32)
    view = DepthView(CAMERA, depth, RigidTransform.identity())
    assert depth_cloud(view, DepthCloudOptions(max_depth_m=1e9)).shape == (0, 3)


def test_pixels_beside_a_step_go_and_those_beside_a_hole_stay() -> None:
    depth = np.full((7, 9), 1.0, np.float32)
    depth[:, 5:] = 2.0
    depth[:, 1] = 0.0
    view = DepthView(CAMERA, depth, RigidTransform.identity())
    kept = depth_cloud(view)
    columns = np.floor(kept[:, 0] / kept[:, 2] * 8.0 + 4.2).astype(int)
    assert sorted(set(columns.tolist())) == [0, 2, 3, 6, 7, 8]


def test_a_slanted_plane_is_no_edge() -> None:
    """80 degrees from the sensor's axis, at the resolution of a real sensor."""
    camera = Camera("PINHOLE", 640, 480, (585.0, 585.0, 320.0, 240.0))
    x = (np.arange(640) + 0.5 - 320) / 585
    depth = np.tile((1.0 / (1.0 + np.tan(np.radians(80)) * (x + 0.1))), (480, 1))
    view = DepthView(camera, depth.astype(np.float32), RigidTransform.identity())
    in_range = (depth > 0) & (depth <= 1.5)
    assert len(depth_cloud(view, DepthCloudOptions(max_depth_m=1.5))) == in_range.sum()


def test_the_mask_is_the_images() -> None:
    """Of a colour camera beside the depth sensor: what it masks is where it sees the points."""
    image_camera = Camera("PINHOLE", 18, 14, (16.0, 16.0, 9.0, 7.0))
    offset = RigidTransform((1.0, 0.0, 0.0, 0.0), (-0.5, 0.0, 0.0))
    view = DepthView(CAMERA, np.full((7, 9), 2.0, np.float32), offset)
    mask = np.zeros((14, 18), bool)
    mask[:, 6:] = True
    everything = depth_cloud(view)
    left = depth_cloud(view, image_camera=image_camera, image_mask=mask)
    u = everything[:, 0] / everything[:, 2] * 16.0 + 9.0
    v = everything[:, 1] / everything[:, 2] * 16.0 + 7.0
    outside = (u < 0) | (u >= 18) | (v < 0) | (v >= 14)
    np.testing.assert_array_equal(left, everything[outside | (u >= 6)])
    assert 0 < len(left) < len(everything)


@pytest.mark.parametrize("wrong", [{"max_depth_m": 0.0}, {"max_jump": 0.0}])
def test_options_that_cannot_be_used(wrong: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        DepthCloudOptions.model_validate(wrong)
