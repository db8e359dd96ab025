"""Points of depth maps: clouds for ICP, and points and their visibility for rendering."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import project
from megloc_kapture.plugins import DepthView
from megloc_kapture.refinement.depth_points import (
    DepthCloudOptions,
    DepthPoints,
    depth_cloud,
    lift_points,
    usable_cells,
    visibility,
)
from megloc_kapture.refinement.pyramid import Level, build_pyramid, choose_points
from megloc_kapture.values import Camera, RigidTransform

SMALL_CAMERA = Camera("PINHOLE", 9, 7, (8.0, 9.0, 4.2, 3.6))
IMAGE_FROM_DEPTH = RigidTransform.from_matrix(
    Rotation.from_euler("xyz", [0.02, -0.05, 0.01]).as_matrix(), np.array([0.03, -0.01, 0.02])
)
CAMERA = Camera("SIMPLE_RADIAL", 320, 240, (250.0, 161.0, 118.5, -0.05))
DEPTH_CAMERA = Camera("PINHOLE", 160, 120, (130.0, 131.0, 80.0, 60.5))
HERE = RigidTransform.identity()
POSE = RigidTransform.from_matrix(
    Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([1.0, 2.0, -0.5])
)


def pixel_by_pixel(depth: np.ndarray, options: DepthCloudOptions, step_px: int) -> np.ndarray:
    fx, fy, cx, cy = SMALL_CAMERA.params
    points = []
    for row in range(step_px // 2, SMALL_CAMERA.height, step_px):
        for column in range(step_px // 2, SMALL_CAMERA.width, step_px):
            z = float(depth[row, column])
            if not 0 < z <= options.max_depth_m:
                continue
            around = [
                float(depth[r, c])
                for r in range(max(row - 1, 0), min(row + 2, SMALL_CAMERA.height))
                for c in range(max(column - 1, 0), min(column + 2, SMALL_CAMERA.width))
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
    points = depth_cloud(DepthView(SMALL_CAMERA, depth, IMAGE_FROM_DEPTH), options, step_px=step_px)
    assert points.dtype == np.float64
    np.testing.assert_allclose(points, pixel_by_pixel(depth, options, step_px), atol=1e-9)


def test_an_infinite_depth_is_none() -> None:
    depth = np.full((7, 9), np.inf, np.float32)
    view = DepthView(SMALL_CAMERA, depth, RigidTransform.identity())
    assert depth_cloud(view, DepthCloudOptions(max_depth_m=1e9)).shape == (0, 3)


def test_pixels_beside_a_step_go_and_those_beside_a_hole_stay() -> None:
    depth = np.full((7, 9), 1.0, np.float32)
    depth[:, 5:] = 2.0
    depth[:, 1] = 0.0
    view = DepthView(SMALL_CAMERA, depth, RigidTransform.identity())
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
    view = DepthView(SMALL_CAMERA, np.full((7, 9), 2.0, np.float32), offset)
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


def plane(camera: Camera, slope: float = 0.1, at: float = 3.0) -> NDArray[np.float32]:
    """Depth of the plane z = at + slope x."""
    x = (np.arange(camera.width) + 0.5 - 80.0) / 130.0
    return np.broadcast_to(at / (1 - slope * x), (camera.height, camera.width)).astype(np.float32)


def test_points_project_to_their_pixels() -> None:
    depth = np.full((240, 320), 4.0, np.float32)
    lifted = lift_points(CAMERA, POSE, DepthView(CAMERA, depth, HERE))
    assert len(lifted.points) > 70_000
    np.testing.assert_allclose(project(CAMERA, POSE, lifted.points), lifted.px, atol=1e-6)
    np.testing.assert_allclose(POSE.apply(lifted.points)[:, 2], 4.0)
    np.testing.assert_array_equal(lifted.px % 1.0, 0.5)


def test_another_depth_camera_is_honoured() -> None:
    image_from_depth = RigidTransform.from_matrix(
        Rotation.from_rotvec([0.0, 0.05, 0.0]).as_matrix(), np.array([0.1, -0.02, 0.03])
    )
    view = DepthView(DEPTH_CAMERA, plane(DEPTH_CAMERA), image_from_depth)
    lifted = lift_points(CAMERA, POSE, view)
    points = (image_from_depth.inverse() @ POSE).apply(lifted.points)
    assert len(points) > 10_000
    np.testing.assert_allclose(points[:, 2], 3.0 + 0.1 * points[:, 0], atol=1e-5)
    np.testing.assert_allclose(project(CAMERA, POSE, lifted.points), lifted.px, atol=1e-6)


def test_edges_and_unknown_depths_give_no_points() -> None:
    depth = np.full((120, 160), 4.0, np.float32)
    depth[:, 80:] = 2.0
    depth[50, 30], depth[60, 30], depth[70, 30], depth[80, 30] = 0.0, np.nan, -1.0, np.inf
    lifted = lift_points(DEPTH_CAMERA, HERE, DepthView(DEPTH_CAMERA, depth, HERE))
    there = np.zeros((120, 160), bool)
    there[tuple((lifted.px[:, ::-1] - 0.5).astype(int).T)] = True
    assert not there[:, 79:81].any() and there[10, 77] and there[10, 82]
    for row in (50, 60, 70, 80):
        assert not there[row, 30] and there[row + 3, 30]


def test_a_depth_map_of_another_size_is_refused() -> None:
    with pytest.raises(DataError, match="depth map"):
        lift_points(CAMERA, HERE, DepthView(CAMERA, np.ones((10, 10), np.float32), HERE))


def test_near_surfaces_hide_far_ones() -> None:
    far = lift_points(CAMERA, HERE, DepthView(CAMERA, np.full((240, 320), 6.0, np.float32), HERE))
    small = np.zeros((240, 320), np.float32)
    small[80:160, 100:200] = 2.0
    near = lift_points(CAMERA, HERE, DepthView(CAMERA, small, HERE))
    seen = visibility([far, near], CAMERA, HERE)
    assert seen.seen[1].all() and seen.covered.all()
    x, y = far.px.T
    inside = (x > 104) & (x < 196) & (y > 84) & (y < 156)
    outside = (x < 95) | (x > 205) | (y < 75) | (y > 165)
    assert not seen.seen[0][inside].any() and seen.seen[0][outside].all()
    alone = visibility([near], CAMERA, HERE).covered
    assert 0.08 < alone.mean() < 0.16
    # from behind, nothing is in front of the camera
    turned = RigidTransform((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0))
    assert not visibility([far, near], CAMERA, turned).covered.any()


def test_usable_cells_are_those_whose_middle_is_valid() -> None:
    valid = np.ones((240, 320), bool)
    valid[:, :100] = False
    usable = usable_cells(valid, (60, 80))
    assert not usable[:, :25].any() and usable[:, 25:].all()


def level_of(seed: int) -> Level:
    image = np.random.default_rng(seed).integers(0, 256, (240, 320, 3)).astype(np.uint8)
    return build_pyramid(image, levels=1)[0]


def test_the_strongest_of_each_cell_are_chosen() -> None:
    levels = [level_of(0), level_of(1)]
    depth = DepthView(CAMERA, np.full((240, 320), 4.0, np.float32), HERE)
    lifted = [lift_points(CAMERA, HERE, depth), lift_points(CAMERA, POSE, depth)]
    wanted = [np.ones(len(lifted[0].points), bool), lifted[1].px[:, 0] < 160]
    chosen = choose_points(lifted, levels, wanted, 768)  # cells of 10 px
    for group, level in enumerate(levels):
        energy = level.gradient_energy
        energy[[0, -1]] = energy[:, [0, -1]] = 0
        ours = chosen.groups == group
        pose = (HERE, POSE)[group]
        px = project(CAMERA, pose, chosen.points[ours])
        columns = 32 if group == 0 else 16
        assert len(px) == 24 * columns
        rows_columns = np.round(px[:, ::-1] - 0.5).astype(int)
        blocks = energy[:, : 10 * columns].reshape(24, 10, columns, 10).max((1, 3))
        np.testing.assert_array_equal(energy[tuple(rows_columns.T)], blocks.ravel())
        np.testing.assert_allclose(
            chosen.values[ours], level.values[tuple(rows_columns.T)], atol=1e-5
        )
    assert len(chosen.thinned(100).points) <= 100


def test_a_flat_image_gives_no_points() -> None:
    flat = build_pyramid(np.full((240, 320, 3), 90, np.uint8), levels=1)[0]
    lifted = DepthPoints(np.ones((4, 3)), np.full((4, 2), 20.5))
    assert len(choose_points([lifted], [flat], [np.ones(4, bool)], 100).points) == 0
