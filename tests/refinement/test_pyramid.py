"""Image pyramids, and the points of depth maps and their visibility."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from poses import rigid

from megloc_kapture.geometry.cameras import project
from megloc_kapture.geometry.warping import PosedImage
from megloc_kapture.plugins import DepthView
from megloc_kapture.refinement.pyramid import (
    Appearance,
    DepthPoints,
    build_pyramid,
    choose_points,
    lift_points,
    usable_cells,
    visibility,
)
from megloc_kapture.values import Camera, RigidTransform

APPEARANCES: tuple[Appearance, ...] = ("normalised", "colours")
CAMERA = Camera("SIMPLE_RADIAL", 320, 240, (250.0, 161.0, 118.5, -0.05))
DEPTH_CAMERA = Camera("PINHOLE", 160, 120, (130.0, 131.0, 80.0, 60.5))
HERE = RigidTransform.identity()
POSE = rigid([0.3, -0.2, 0.5], [1.0, 2.0, -0.5])


def lifted_points(camera: Camera, pose: RigidTransform, depth: DepthView) -> DepthPoints:
    return lift_points(PosedImage(np.zeros((1, 1, 3), np.uint8), camera, pose, depth))


def picture(seed: int = 0, width: int = 200, height: int = 150) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(20, 120, (height // 10, width // 10, 3)).astype(np.uint8)
    return np.kron(coarse, np.ones((10, 10, 1), np.uint8))


@pytest.mark.parametrize("appearance", APPEARANCES)
def test_levels_have_half_the_size(appearance: Appearance) -> None:
    levels = build_pyramid(picture(), levels=3, max_side_px=100, appearance=appearance)
    channels = 3 if appearance == "colours" else 1
    sizes = [(75, 100), (37, 50), (18, 25)]
    assert [level.values.shape for level in levels] == [(*size, channels) for size in sizes]
    assert [level.scale_x for level in levels] == [0.5, 0.25, 0.125]
    assert levels[1].scale_y == 37 / 150
    assert all(level.values.dtype == np.float32 for level in levels)
    assert len(build_pyramid(picture(), levels=9)) == 4  # at least 16 px


@pytest.mark.parametrize("appearance", APPEARANCES)
def test_masked_pixels_are_ignored(appearance: Appearance) -> None:
    mask = np.ones((150, 200), bool)
    mask[30:90, 50:120] = False
    images = [picture(), picture()]
    images[1][~mask] = np.random.default_rng(1).integers(0, 256, ((~mask).sum(), 3))
    first, second = (build_pyramid(each, mask, appearance=appearance) for each in images)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.values, b.values)
        np.testing.assert_array_equal(a.valid, b.valid)
    assert not first[0].valid[30:90, 50:120].any() and first[0].valid[:28].all()
    assert first[2].valid.any() and not first[2].valid.all()
    # a full mask changes nothing
    plain, full = (
        build_pyramid(picture(), each, appearance=appearance) for each in (None, mask | True)
    )
    for a, b in zip(plain, full, strict=True):
        np.testing.assert_allclose(a.values, b.values, atol=1e-6)


def test_each_colour_is_normalised_like_brightness() -> None:
    image = picture()
    result = build_pyramid(image, levels=2, appearance="colours")
    for channel in range(3):
        grey = build_pyramid(np.repeat(image[..., channel : channel + 1], 3, axis=2), levels=2)
        for a, b in zip(result, grey, strict=True):
            np.testing.assert_allclose(a.values[..., channel], b.values[..., 0], atol=1e-5)
    # grey, so that brightness is not rounded
    grey = np.repeat(image[..., :1], 3, axis=2)
    for a, b in zip(build_pyramid(grey), build_pyramid(grey * 2 + 10), strict=True):
        np.testing.assert_allclose(a.values, b.values, atol=1e-4)
        assert 0.5 < a.values.std() < 1.5


def test_gradient_energy_is_that_of_central_differences() -> None:
    mask = np.ones((150, 200), bool)
    mask[70, 100] = False
    level = build_pyramid(picture(), mask, levels=1)[0]
    energy = level.gradient_energy
    values = level.values[..., 0]
    expected = (values[50, 81] - values[50, 79]) ** 2 + (values[51, 80] - values[49, 80]) ** 2
    assert energy[50, 80] == pytest.approx(expected)
    assert not energy[0].any() and not energy[:, -1].any() and not energy[70, 99:102].any()


def test_points_project_to_their_pixels() -> None:
    depth = np.full((240, 320), 4.0, np.float32)
    lifted = lifted_points(CAMERA, POSE, DepthView(CAMERA, depth, HERE))
    assert len(lifted.points) > 70_000
    np.testing.assert_allclose(project(CAMERA, POSE, lifted.points), lifted.px, atol=1e-6)
    np.testing.assert_allclose(POSE.apply(lifted.points)[:, 2], 4.0)
    np.testing.assert_array_equal(lifted.px % 1.0, 0.5)


def test_depth_of_another_camera_is_transformed() -> None:
    image_from_depth = rigid([0.0, 0.05, 0.0], [0.1, -0.02, 0.03])
    # of the plane z = 3 + 0.1 x
    x = (np.arange(160) + 0.5 - 80.0) / 130.0
    plane = np.broadcast_to(3.0 / (1 - 0.1 * x), (120, 160)).astype(np.float32)
    view = DepthView(DEPTH_CAMERA, plane, image_from_depth)
    lifted = lifted_points(CAMERA, POSE, view)
    points = (image_from_depth.inverse() @ POSE).apply(lifted.points)
    assert len(points) > 10_000
    np.testing.assert_allclose(points[:, 2], 3.0 + 0.1 * points[:, 0], atol=1e-5)
    np.testing.assert_allclose(project(CAMERA, POSE, lifted.points), lifted.px, atol=1e-6)


def test_edges_and_unknown_depths_give_no_points() -> None:
    depth = np.full((120, 160), 4.0, np.float32)
    depth[:, 80:] = 2.0
    depth[50, 30], depth[60, 30], depth[70, 30], depth[80, 30] = 0.0, np.nan, -1.0, np.inf
    lifted = lifted_points(DEPTH_CAMERA, HERE, DepthView(DEPTH_CAMERA, depth, HERE))
    known = np.zeros((120, 160), bool)
    known[tuple((lifted.px[:, ::-1] - 0.5).astype(int).T)] = True
    assert not known[:, 79:81].any() and known[10, 77] and known[10, 82]
    for row in (50, 60, 70, 80):
        assert not known[row, 30] and known[row + 3, 30]


def test_near_surfaces_hide_far_ones() -> None:
    far = lifted_points(CAMERA, HERE, DepthView(CAMERA, np.full((240, 320), 6.0, np.float32), HERE))
    small = np.zeros((240, 320), np.float32)
    small[80:160, 100:200] = 2.0
    near = lifted_points(CAMERA, HERE, DepthView(CAMERA, small, HERE))
    (far_seen, near_seen), covered = visibility([far, near], CAMERA, HERE)
    assert near_seen.all() and covered.all()
    x, y = far.px.T
    inside = (x > 104) & (x < 196) & (y > 84) & (y < 156)
    outside = (x < 95) | (x > 205) | (y < 75) | (y > 165)
    assert not far_seen[inside].any() and far_seen[outside].all()
    _, alone = visibility([near], CAMERA, HERE)
    assert 0.08 < alone.mean() < 0.16
    # a camera that looks back sees nothing
    turned = RigidTransform((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0))
    assert not visibility([far, near], CAMERA, turned)[1].any()
    # cells with a valid middle are usable
    valid = np.ones((240, 320), bool)
    valid[:, :100] = False
    usable = usable_cells(valid, (60, 80))
    assert not usable[:, :25].any() and usable[:, 25:].all()


def test_the_strongest_of_each_cell_are_chosen() -> None:
    noise = [np.random.default_rng(k).integers(0, 256, (240, 320, 3), np.uint8) for k in (0, 1)]
    levels = [build_pyramid(each, levels=1)[0] for each in noise]
    depth = DepthView(CAMERA, np.full((240, 320), 4.0, np.float32), HERE)
    lifted = [lifted_points(CAMERA, HERE, depth), lifted_points(CAMERA, POSE, depth)]
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
        expected = level.values[tuple(rows_columns.T)]
        np.testing.assert_allclose(chosen.values[ours], expected, atol=1e-5)
    # a flat image gives no points
    flat = build_pyramid(np.full((240, 320, 3), 90, np.uint8), levels=1)[0]
    few = DepthPoints(np.ones((4, 3)), np.full((4, 2), 20.5))
    assert len(choose_points([few], [flat], [np.ones(4, bool)], 100).points) == 0
