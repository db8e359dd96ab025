"""The covariance of a pose from its normal matrix; that of real poses against COLMAP's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import project
from megloc_kapture.localization.absolute_pose import absolute_pose
from megloc_kapture.localization.covariance import center_deviation, pose_covariance
from megloc_kapture.values import Camera, Pose, RigidTransform

Array = NDArray[np.float64]
PINHOLE = Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.5, 239.0))
FISHEYE = Camera("OPENCV_FISHEYE", 640, 480, (400.0, 410.0, 320.0, 240.0, 0.02, -0.01, 0.0, 0.0))
RADIAL = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.1))


def a_pose() -> RigidTransform:
    x, y, z, w = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_quat()
    return RigidTransform((float(w), float(x), float(y), float(z)), (0.5, -1.0, 2.0))


def points_in_cam(count: int = 60) -> Array:
    return np.random.default_rng(0).uniform((-2, -1.5, 4), (2, 1.5, 9), (count, 3))


def covariance_of(camera: Camera, pixels: Array, world: Array) -> Array:
    pose = absolute_pose(pixels, world, camera)
    assert isinstance(pose, Pose) and pose.covariance is not None
    return pose.covariance


def a_normal_matrix(seed: int = 0) -> Array:
    factor = np.random.default_rng(seed).normal(size=(40, 6))
    return factor.T @ factor


def test_it_is_the_inverse_scaled_by_the_variance() -> None:
    matrix = a_normal_matrix()
    found = pose_covariance(matrix, 4.0)
    np.testing.assert_allclose(found, 4.0 * np.linalg.inv(matrix), rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(found, found.T)
    # a handful of perfect matches is no proof of perfection
    floor = pose_covariance(matrix, 1e-12)
    np.testing.assert_allclose(floor, 0.01 * np.linalg.inv(matrix), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_what_is_degenerate_does_not_depend_on_the_unit(unit: float) -> None:
    scale = np.diag([1.0, 1.0, 1.0, unit, unit, unit])
    matrix = a_normal_matrix()
    found = pose_covariance(scale @ matrix @ scale, 1.0)
    assert found is not None
    np.testing.assert_allclose(scale @ found @ scale, np.linalg.inv(matrix), rtol=1e-8)
    factor = np.random.default_rng(1).normal(size=(40, 6))
    factor[:, 5] = factor[:, 0] - 2.0 * factor[:, 3]  # five directions only
    singular = scale @ (factor.T @ factor) @ scale
    assert pose_covariance(singular, 1.0) is None


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -1.0])
def test_no_covariance_of_what_is_no_normal_matrix(value: float) -> None:
    matrix = a_normal_matrix()
    matrix[2, 2] = value
    assert pose_covariance(matrix, 1.0) is None


def test_the_largest_deviation_of_the_centre() -> None:
    turn = Rotation.random(rng=np.random.default_rng(2)).as_matrix()
    covariance = 100.0 * np.eye(6)
    covariance[3:, 3:] = turn @ np.diag([1.0, 4.0, 0.25]) @ turn.T
    assert center_deviation(covariance) == pytest.approx(2.0)


def colmaps_covariance(camera: Camera, pose: RigidTransform, pixels: Array, world: Array) -> Array:
    """COLMAP's, of pixels with an error of one pixel, in our convention."""
    options: Any = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.random_seed = 0
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.gradient_tolerance = 1e-8
    refined = pycolmap.estimate_and_refine_absolute_pose(
        pixels,
        world,
        pycolmap.Camera(
            model=camera.model, width=camera.width, height=camera.height, params=camera.params
        ),
        options,
        refinement,
        return_covariance=True,
    )
    assert refined is not None
    # COLMAP's rotation is half of the angle, and its translation does not turn with it:
    # exp(r, v) x = R(r) x + v, so the translation changes by v + r x t
    t = pose.translation
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    ours_from_theirs = np.block([[2 * np.eye(3), np.zeros((3, 3))], [2 * cross, np.eye(3)]])
    return np.asarray(ours_from_theirs @ refined["covariance"] @ ours_from_theirs.T)


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE, RADIAL], ids=lambda c: c.model)
def test_equal_to_colmaps_covariance(camera: Camera) -> None:
    pose = a_pose()
    world = pose.inverse().apply(points_in_cam())
    pixels = project(camera, pose, world)
    ours = covariance_of(camera, pixels, world)
    theirs = colmaps_covariance(camera, pose, pixels, world)
    # without any residual ours takes a tenth of a pixel
    np.testing.assert_allclose(ours, 0.1**2 * theirs, rtol=1e-4, atol=1e-6 * abs(ours).max())


def test_the_scale_comes_from_the_residuals() -> None:
    pose = a_pose()
    world = pose.inverse().apply(points_in_cam(400))
    exact = project(PINHOLE, pose, world)
    noise = np.random.default_rng(2).normal(size=exact.shape)
    floor = covariance_of(PINHOLE, exact, world)
    for sigma_px in (1.0, 3.0):
        found = covariance_of(PINHOLE, exact + sigma_px * noise, world)
        np.testing.assert_allclose(
            np.diagonal(found) / np.diagonal(floor), (sigma_px / 0.1) ** 2, rtol=0.15
        )


def test_rotation_in_radians_does_not_change_with_the_unit_and_translation_does() -> None:
    pose = a_pose()
    world = pose.inverse().apply(points_in_cam())
    pixels = project(PINHOLE, pose, world)
    metres = covariance_of(PINHOLE, pixels, world)
    millimetres = covariance_of(PINHOLE, pixels, 1000 * world)
    np.testing.assert_allclose(millimetres[:3, :3], metres[:3, :3], rtol=1e-4, atol=1e-14)
    np.testing.assert_allclose(millimetres[3:, 3:], 1e6 * metres[3:, 3:], rtol=1e-4, atol=1e-8)
