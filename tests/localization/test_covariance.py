"""The covariance of a pose against COLMAP's, and the Jacobian against the pinhole's formula."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import project, px_from_cam
from megloc_kapture.localization.covariance import pose_covariance, projection_jacobian
from megloc_kapture.values import Camera, RigidTransform

Array = NDArray[np.float64]
PINHOLE = Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.5, 239.0))
FISHEYE = Camera("OPENCV_FISHEYE", 640, 480, (400.0, 410.0, 320.0, 240.0, 0.02, -0.01, 0.0, 0.0))


def a_pose() -> RigidTransform:
    x, y, z, w = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_quat()
    return RigidTransform((float(w), float(x), float(y), float(z)), (0.5, -1.0, 2.0))


def points_in_cam(count: int = 60) -> Array:
    return np.random.default_rng(0).uniform((-2, -1.5, 4), (2, 1.5, 9), (count, 3))


def test_the_jacobian_is_the_pinholes() -> None:
    points = points_in_cam()
    x, y, z = points.T
    expected = np.zeros((len(points), 2, 3))
    expected[:, 0, 0], expected[:, 0, 2] = 500.0 / z, -500.0 * x / z**2
    expected[:, 1, 1], expected[:, 1, 2] = 510.0 / z, -510.0 * y / z**2
    np.testing.assert_allclose(projection_jacobian(PINHOLE, points), expected, atol=1e-5)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
def test_the_jacobians_accuracy_does_not_depend_on_the_unit(scale: float) -> None:
    points = points_in_cam()
    at_one = projection_jacobian(FISHEYE, points)
    scaled = projection_jacobian(FISHEYE, scale * points) * scale
    np.testing.assert_allclose(scaled, at_one, atol=1e-5)


def test_the_jacobian_predicts_small_moves() -> None:
    points = points_in_cam()
    move = 1e-3 * np.random.default_rng(1).normal(size=points.shape)
    moved = px_from_cam(FISHEYE, points + move) - px_from_cam(FISHEYE, points)
    predicted = np.einsum("nij,nj->ni", projection_jacobian(FISHEYE, points), move)
    np.testing.assert_allclose(predicted, moved, atol=2e-4)


def colmaps_covariance(camera: Camera, pose: RigidTransform, pixels: Array, world: Array) -> Array:
    """COLMAP's, of pixels with an error of one pixel, in our convention."""
    w, x, y, z = pose.quat_wxyz
    t = np.array(pose.translation)
    refined = pycolmap.refine_absolute_pose(
        pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), t),
        pixels,
        world,
        np.ones(len(pixels), dtype=bool),
        pycolmap.Camera(
            model=camera.model, width=camera.width, height=camera.height, params=camera.params
        ),
        return_covariance=True,
    )
    # COLMAP's rotation is half of the angle, and its translation does not turn with it:
    # exp(r, v) x = R(r) x + v, so the translation changes by v + r x t
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    ours_from_theirs = np.block([[2 * np.eye(3), np.zeros((3, 3))], [2 * cross, np.eye(3)]])
    return np.asarray(ours_from_theirs @ refined["covariance"] @ ours_from_theirs.T)


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=lambda c: c.model)
def test_equal_to_colmaps_covariance(camera: Camera) -> None:
    pose = a_pose()
    world = pose.inverse().apply(points_in_cam())
    pixels = project(camera, pose, world)
    ours = pose_covariance(pose, camera, pixels, world)
    assert ours is not None
    theirs = colmaps_covariance(camera, pose, pixels, world)
    # without any residual ours takes a tenth of a pixel
    np.testing.assert_allclose(ours, 0.1**2 * theirs, rtol=1e-4, atol=1e-6 * abs(ours).max())


def test_the_scale_comes_from_the_residuals() -> None:
    pose = a_pose()
    world = pose.inverse().apply(points_in_cam(400))
    exact = project(PINHOLE, pose, world)
    noise = np.random.default_rng(2).normal(size=exact.shape)
    floor = pose_covariance(pose, PINHOLE, exact, world)
    assert floor is not None
    for sigma_px in (1.0, 3.0):
        found = pose_covariance(pose, PINHOLE, exact + sigma_px * noise, world)
        assert found is not None
        np.testing.assert_allclose(found / floor, (sigma_px / 0.1) ** 2, rtol=0.15)


def test_it_is_a_covariance() -> None:
    pose = a_pose()
    world = pose.inverse().apply(points_in_cam(12))
    found = pose_covariance(pose, PINHOLE, project(PINHOLE, pose, world), world)
    assert found is not None and found.shape == (6, 6)
    np.testing.assert_allclose(found, found.T, rtol=1e-6)
    assert (np.linalg.eigvalsh(0.5 * (found + found.T)) > 0).all()


def test_rotation_in_radians_does_not_change_with_the_unit_and_translation_does() -> None:
    pose = a_pose()
    world = pose.inverse().apply(points_in_cam())
    pixels = project(PINHOLE, pose, world)
    metres = pose_covariance(pose, PINHOLE, pixels, world)
    tx, ty, tz = (1000 * t for t in pose.translation)
    millimetres = pose_covariance(
        RigidTransform(pose.quat_wxyz, (tx, ty, tz)), PINHOLE, pixels, 1000 * world
    )
    assert metres is not None and millimetres is not None
    np.testing.assert_allclose(millimetres[:3, :3], metres[:3, :3], rtol=1e-4)
    np.testing.assert_allclose(millimetres[3:, 3:], 1e6 * metres[3:, 3:], rtol=1e-4)


def test_degenerate_points_have_none() -> None:
    pose = a_pose()
    along = np.linspace(-1, 1, 30)[:, None]
    on_a_line = np.array([0.2, -0.3, 6.0]) + along * np.array([0.8, 0.3, 0.5])
    at_one_place = np.repeat([[0.1, 0.2, 5.0]], 30, axis=0)
    too_few = points_in_cam(3)
    for in_cam in (on_a_line, at_one_place, too_few, np.zeros((0, 3))):
        world = pose.inverse().apply(in_cam)
        assert pose_covariance(pose, PINHOLE, project(PINHOLE, pose, world), world) is None


def test_points_behind_the_camera_say_nothing() -> None:
    pose = a_pose()
    in_cam = points_in_cam(30)
    world = pose.inverse().apply(in_cam)
    pixels = project(PINHOLE, pose, world)
    expected = pose_covariance(pose, PINHOLE, pixels, world)
    behind = np.concatenate([world, pose.inverse().apply(-in_cam)])
    found = pose_covariance(pose, PINHOLE, np.concatenate([pixels, pixels]), behind)
    np.testing.assert_array_equal(found, expected)
