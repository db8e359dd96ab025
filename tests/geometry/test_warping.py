"""Warping of planes under many camera models, and of a board in front of a wall."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import camera_models
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import pixel_rays, project, scaled_camera
from megloc_kapture.geometry.projection import draw_depth_surface
from megloc_kapture.geometry.warping import PosedImage, WarpedView, warp_to_view
from megloc_kapture.plugins import DepthView
from megloc_kapture.values import Camera, RigidTransform

CAMERAS = {model: scaled_camera(camera, 0.125) for model, camera in camera_models.CAMERAS.items()}
PINHOLE = Camera("PINHOLE", 80, 60, (70.0, 66.0, 43.0, 28.5))
Floats = NDArray[np.float64]
STILL = RigidTransform.identity()
Plane = tuple[Floats, float]  # n . x = d in the world


def plane_depth(camera: Camera, cam_from_world: RigidTransform, plane: Plane) -> Floats:
    normal, offset = plane
    rotation, centre = cam_from_world.rotation_matrix(), cam_from_world.center()
    directions = pixel_rays(camera) @ rotation
    return (offset - normal @ centre) / (directions @ normal)


def points_of(camera: Camera, cam_from_world: RigidTransform, depth: Floats) -> Floats:
    return cam_from_world.inverse().apply(pixel_rays(camera) * depth[:, None])


def paint(points: Floats) -> NDArray[np.uint8]:
    """Return a smooth colour (N, 3) of points in the world."""
    phase = points @ np.array([[1.3, 0.4, 0.7], [0.5, 1.2, -0.6], [0.3, -0.8, 0.9]])
    return np.round(127.5 + 100 * np.sin(phase)).astype(np.uint8)


def on_plane(
    camera: Camera,
    cam_from_world: RigidTransform,
    plane: Plane,
    *,
    depth_camera: Camera | None = None,
    image_from_depth: RigidTransform = STILL,
    mask: NDArray[np.bool_] | None = None,
) -> PosedImage:
    """Return the image of a painted plane, with depth of a sensor next to the camera."""
    depth_camera = depth_camera or camera
    depth_from_world = image_from_depth.inverse() @ cam_from_world
    depth = plane_depth(depth_camera, depth_from_world, plane)
    seen = points_of(camera, cam_from_world, plane_depth(camera, cam_from_world, plane))
    return PosedImage(
        image=paint(seen).reshape(camera.height, camera.width, 3),
        camera=camera,
        cam_from_world=cam_from_world,
        depth=DepthView(
            depth_camera,
            depth.reshape(depth_camera.height, depth_camera.width).astype(np.float32),
            image_from_depth,
        ),
        mask=mask,
    )


def turned(x_deg: float, y_deg: float, shift: tuple[float, float, float]) -> RigidTransform:
    rotation = Rotation.from_euler("XY", [x_deg, y_deg], degrees=True).as_matrix()
    return RigidTransform.from_matrix(rotation, np.array(shift))


def assert_painted(view: WarpedView, points: Floats, where: NDArray[np.bool_]) -> None:
    difference = np.abs(view.image.reshape(-1, 3)[where].astype(int) - paint(points[where]))
    assert difference.max() <= 3


WALL: Plane = (np.array([0.1, -0.05, 1.0]), 4.0)


@pytest.mark.parametrize("model", CAMERAS)
def test_a_warped_plane_equals_the_true_view(model: str) -> None:
    camera, other = CAMERAS[model], CAMERAS["OPENCV"]
    there = turned(3.0, -6.0, (0.3, -0.1, 0.2))
    view = warp_to_view([on_plane(other, STILL, WALL)], camera, there)
    depth = plane_depth(camera, there, WALL)
    points = points_of(camera, there, depth)
    valid = view.valid.ravel()
    px = project(other, STILL, points)
    inside = ((px > 1) & (px < (other.width - 1, other.height - 1))).all(axis=1)
    assert valid[inside].mean() > 0.999 and inside.mean() > 0.5
    assert not valid[
        ((px < -0.5) | (px > (other.width + 0.5, other.height + 0.5))).any(axis=1)
    ].any()
    assert_painted(view, points, valid)
    # distortion bends the triangles' sides a little
    np.testing.assert_allclose(view.depth_m.ravel()[valid], depth[valid], rtol=2e-4)


def test_depth_of_a_separate_camera() -> None:
    small = Camera("PINHOLE", 50, 40, (38.0, 40.0, 26.0, 19.0))
    beside = turned(1.0, -2.0, (0.08, 0.01, -0.02))
    there = turned(-2.0, 5.0, (-0.2, 0.1, 0.1))
    right = on_plane(
        CAMERAS["SIMPLE_RADIAL"], STILL, WALL, depth_camera=small, image_from_depth=beside
    )
    view = warp_to_view([right], PINHOLE, there)
    points = points_of(PINHOLE, there, plane_depth(PINHOLE, there, WALL))
    valid = view.valid.ravel()
    assert valid.mean() > 0.6
    assert_painted(view, points, valid)
    # without the offset the depth is wrong
    assert right.depth is not None
    unmoved = replace(right, depth=replace(right.depth, image_from_depth=STILL))
    forgotten = warp_to_view([unmoved], PINHOLE, there)
    truth = plane_depth(PINHOLE, there, WALL)
    np.testing.assert_allclose(view.depth_m.ravel()[valid], truth[valid], rtol=2e-4)
    both = valid & forgotten.valid.ravel()
    assert np.median(np.abs(forgotten.depth_m.ravel()[both] / truth[both] - 1)) > 2e-3


def test_a_view_from_nearer_has_no_holes() -> None:
    near = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -3.2))  # five times as large
    view = warp_to_view([on_plane(PINHOLE, STILL, WALL)], PINHOLE, near)
    assert view.valid.all()
    points = points_of(PINHOLE, near, plane_depth(PINHOLE, near, WALL))
    assert_painted(view, points, view.valid.ravel())


@pytest.mark.parametrize("scale", [0.37, 2.0])
def test_a_scaled_view_shows_the_same(scale: float) -> None:
    there = turned(2.0, 4.0, (0.1, 0.0, 0.1))
    camera = CAMERAS["OPENCV"]
    view = warp_to_view([on_plane(PINHOLE, STILL, WALL)], camera, there, scale=scale)
    small = scaled_camera(camera, scale)
    assert view.image.shape == (small.height, small.width, 3)
    assert (small.width, small.height) == (round(80 * scale), round(60 * scale))
    points = points_of(small, there, plane_depth(small, there, WALL))
    valid = view.valid.ravel()
    assert valid.mean() > 0.6
    difference = np.abs(view.image.reshape(-1, 3)[valid].astype(int) - paint(points[valid]))
    assert np.percentile(difference, 99) <= 3
    full, reduced = project(camera, there, points), project(small, there, points)
    ratio = np.array([small.width / camera.width, small.height / camera.height])
    np.testing.assert_allclose(full * ratio, reduced, atol=1e-9)


def board(camera: Camera, pose: RigidTransform) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the depth (N,) of a board in front of a wall, and the board's pixels."""
    wall = plane_depth(camera, pose, (np.array([0.0, 0.0, 1.0]), 4.0))
    front = plane_depth(camera, pose, (np.array([0.0, 0.0, 1.0]), 2.0))
    at = points_of(camera, pose, front)
    on_board = (front > 0) & (np.abs(at[:, :2]) < 0.5).all(axis=1)
    return np.where(on_board, front, wall), on_board


def board_source(pose: RigidTransform) -> PosedImage:
    camera = PINHOLE
    depth, _ = board(camera, pose)
    image = paint(points_of(camera, pose, depth)).reshape(60, 80, 3)
    measured = DepthView(camera, depth.reshape(60, 80).astype(np.float32), STILL)
    return PosedImage(image, camera, pose, measured)


ASIDE = turned(0.0, 0.0, (-0.6, 0.0, 0.0))


def check_board(view: WarpedView, *, hidden: bool = True) -> None:
    """Check the middle row of the view from aside.

    By hand: the board ends at column 39.5, and hides the wall from the source up to column 50.
    """
    points = points_of(PINHOLE, ASIDE, board(PINHOLE, ASIDE)[0])
    where = np.zeros((60, 80), bool)
    where[28, [*range(2, 38), *range(52, 67)]] = True
    where[28, 42:49] = not hidden
    np.testing.assert_array_equal(view.valid[28, 42:49], not hidden)
    assert view.valid[where].all()
    assert_painted(view, points, where.ravel())


def test_references_fill_each_others_holes() -> None:
    sources = [board_source(STILL), board_source(turned(0.0, 0.0, (-1.0, 0.2, 0.0)))]
    single = warp_to_view(sources[:1], PINHOLE, ASIDE)
    check_board(single)
    empty = ~single.valid
    assert (single.image[empty] == 0).all() and (single.source[empty] == -1).all()
    both = warp_to_view(sources, PINHOLE, ASIDE)
    check_board(both, hidden=False)
    assert both.valid.sum() > single.valid.sum() + 100
    assert set(np.unique(both.source)) >= {0, 1}


def test_the_reference_at_the_smaller_angle_is_used() -> None:
    there = turned(0.0, 1.0, (0.05, 0.0, 0.0))
    far = turned(0.0, -12.0, (0.9, 0.0, 0.0))
    sources = [on_plane(PINHOLE, far, WALL), on_plane(PINHOLE, STILL, WALL)]
    view = warp_to_view(sources, PINHOLE, there)
    at_both = warp_to_view(sources[:1], PINHOLE, there).valid
    at_both &= warp_to_view(sources[1:], PINHOLE, there).valid
    assert at_both.mean() > 0.3
    assert (view.source[at_both] == 1).all()


def test_a_surface_from_behind_is_invalid() -> None:
    behind = turned(0.0, 180.0, (0.0, 0.0, 8.0))  # behind the wall
    view = warp_to_view([on_plane(PINHOLE, STILL, WALL)], PINHOLE, behind)
    assert not view.valid.any()
    assert (view.depth_m > 0).mean() > 0.5


def test_masked_pixels_and_missing_depth_are_invalid() -> None:
    mask = np.ones((60, 80), bool)
    mask[20:30, 30:50] = False
    masked = on_plane(PINHOLE, STILL, WALL, mask=mask)
    np.testing.assert_array_equal(warp_to_view([masked], PINHOLE, STILL).valid, mask)
    for nothing in (0.0, -1.0, np.nan, np.inf):
        source = on_plane(PINHOLE, STILL, WALL)
        assert source.depth is not None
        source.depth.depth_m[10:20, 40:60] = nothing
        view = warp_to_view([source], PINHOLE, STILL)
        assert not view.valid[11:19, 41:59].any()
        assert view.valid[:9].all()
        assert np.isfinite(view.depth_m).all()


def test_points_that_only_the_depth_camera_sees_are_hidden() -> None:
    # the depth sensor sees the wall behind the board, the camera does not
    source = board_source(STILL)
    depth = board(PINHOLE, ASIDE)[0].reshape(60, 80).astype(np.float32)
    beside = replace(source, depth=DepthView(source.camera, depth, ASIDE.inverse()))
    check_board(warp_to_view([beside], PINHOLE, ASIDE))


def test_no_sources_give_an_empty_view() -> None:
    view = warp_to_view([], PINHOLE, STILL)
    assert not view.valid.any() and (view.depth_m == 0).all() and (view.source == -1).all()


@pytest.mark.parametrize("corners", [[(0, 0)], [(0, 2)], [(2, 2)], [(0, 0), (2, 0)]])
@pytest.mark.parametrize("depth_m", [0.0, 5.0])
def test_a_corner_without_depth_or_behind_costs_half_a_quad(corners: Any, depth_m: float) -> None:
    camera = Camera("PINHOLE", 3, 3, (3.0, 3.0, 1.5, 1.5))
    depth = np.full((3, 3), 2.0, np.float32)
    depth[tuple(np.transpose(corners))] = depth_m
    rays = pixel_rays(camera)
    drawn, front = draw_depth_surface(
        depth, rays, STILL, scaled_camera(camera, 20.0), max_jump=0.1, near_m=0.1, field=9.0
    )
    # pixel centres of the depth map are 20 pixels apart
    area = (4 - 0.5 * len(corners)) * 20 * 20
    assert np.isfinite(drawn).sum() == pytest.approx(area, rel=0.02)
    np.testing.assert_allclose(drawn[front], 2.0)
