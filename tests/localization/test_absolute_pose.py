"""The pose of one camera from matches whose truth is known, and its covariance."""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap
import pytest
from camera_models import CAMERAS, PINHOLE
from numpy.typing import NDArray
from poses import located, random_pose, rigid
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import project
from megloc_kapture.geometry.poses import movement
from megloc_kapture.localization.absolute_pose import (
    AbsolutePoseOptions,
    absolute_pose,
    center_deviation,
    pose_covariance,
)
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform

Array = NDArray[np.float64]


def scene(
    camera: Camera, pose: RigidTransform, rng: np.random.Generator, count: int = 100
) -> tuple[Array, Array]:
    """Pixels (N, 2) and world points (N, 3)."""
    world = pose.inverse().apply(rng.uniform((-2, -1.5, 4), (2, 1.5, 9), (count, 3)))
    return project(camera, pose, world), world


@pytest.mark.parametrize("model", CAMERAS)
def test_exact_matches_give_the_exact_pose(model: str) -> None:
    rng = np.random.default_rng(0)
    camera, truth = CAMERAS[model], random_pose(rng)
    pose = located(absolute_pose(*scene(camera, truth, rng), camera))
    distance, angle_deg = movement(pose.cam_from_world, truth)
    # COLMAP undoes distortions to this accuracy
    exact = 1e-9 if "PINHOLE" in model else 1e-7
    assert distance < exact and np.radians(angle_deg) < 0.1 * exact
    assert pose.num_matches == pose.num_inliers == 100
    assert pose.inliers is not None and pose.inliers.all()


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV_FISHEYE"])
def test_half_of_the_matches_may_be_wrong(model: str) -> None:
    rng = np.random.default_rng(1)
    camera, truth = CAMERAS[model], random_pose(rng)
    pixels, world = scene(camera, truth, rng, count=200)
    pixels += 0.5 * rng.normal(size=pixels.shape)
    world[::2] = rng.permutation(world[::2])
    pose = located(absolute_pose(pixels, world, camera))
    distance, angle_deg = movement(pose.cam_from_world, truth)
    assert distance < 0.02 and angle_deg < 0.15
    errors = np.linalg.norm(project(camera, truth, world) - pixels, axis=1)
    assert pose.inliers is not None
    # the mask is that of the true pose, except for matches near the threshold
    limit = AbsolutePoseOptions().max_error_px
    clear = np.abs(errors - limit) > 1.0
    np.testing.assert_array_equal(pose.inliers[clear], (errors <= limit)[clear])
    assert pose.num_inliers == pose.inliers.sum() and pose.num_matches == 200


@pytest.mark.parametrize("length", [4.0, 0.0], ids=["line", "copies of one point"])
def test_degenerate_points_give_no_pose(length: float) -> None:
    """The camera may rotate about the line."""
    rng = np.random.default_rng(7)
    truth = random_pose(rng)
    along = rng.uniform(-0.5, 0.5, (50, 1)) * length
    world = truth.inverse().apply(np.array([0.2, -0.3, 6.0]) + along * np.array([0.8, 0.3, 0.5]))
    assert isinstance(absolute_pose(project(PINHOLE, truth, world), world, PINHOLE), Failure)


def test_points_behind_the_camera_are_outliers() -> None:
    rng = np.random.default_rng(9)
    truth = random_pose(rng)
    pixels, world = scene(PINHOLE, truth, rng, count=60)
    mirrored = truth.apply(world)
    mirrored[40:] *= -1  # same pixels by the pinhole's formula, behind the camera
    pose = located(absolute_pose(pixels, truth.inverse().apply(mirrored), PINHOLE))
    np.testing.assert_array_equal(pose.inliers, np.arange(60) < 40)


def test_the_threshold_and_the_least_number_of_inliers_are_options() -> None:
    rng = np.random.default_rng(12)
    pixels, world = scene(PINHOLE, random_pose(rng), rng)
    pixels[:50] += 6.0 * np.sign(rng.normal(size=(50, 2)))  # 8.5 px off

    def result(**options: float) -> Pose | Failure:
        return absolute_pose(pixels, world, PINHOLE, AbsolutePoseOptions(**options))

    assert located(result(max_error_px=12)).num_inliers > 90
    assert 50 <= located(result(max_error_px=3)).num_inliers < 60
    assert isinstance(result(max_error_px=3, min_inliers=70), Failure)
    exact, points = scene(PINHOLE, random_pose(rng), rng, 12)
    assert located(absolute_pose(exact, points, PINHOLE)).num_inliers == 12
    few = absolute_pose(exact[:11], points[:11], PINHOLE)
    assert not few and isinstance(few, Failure)
    assert few.reason == "11 2D-3D matches, at least 12 are needed"


DIRECTIONS = np.random.default_rng(0).normal(size=(40, 6))
MATRIX = DIRECTIONS.T @ DIRECTIONS


def test_the_covariance_is_the_inverse_scaled_by_the_variance() -> None:
    result = pose_covariance(MATRIX, 4.0)
    np.testing.assert_allclose(result, 4.0 * np.linalg.inv(MATRIX), rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(result, result.T)
    # a few exact matches do not prove a zero variance
    floor = pose_covariance(MATRIX, 1e-12)
    np.testing.assert_allclose(floor, 0.01 * np.linalg.inv(MATRIX), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_no_covariance_of_degenerate_poses_in_any_unit(unit: float) -> None:
    scale = np.diag([1.0, 1.0, 1.0, unit, unit, unit])
    result = pose_covariance(scale @ MATRIX @ scale, 1.0)
    assert result is not None
    np.testing.assert_allclose(scale @ result @ scale, np.linalg.inv(MATRIX), rtol=1e-8)
    five_only = DIRECTIONS.copy()
    five_only[:, 5] = five_only[:, 0] - 2.0 * five_only[:, 3]
    assert pose_covariance(scale @ five_only.T @ five_only @ scale, 1.0) is None
    for value in (np.nan, np.inf, 0.0, -1.0):
        invalid = MATRIX.copy()
        invalid[2, 2] = value
        assert pose_covariance(invalid, 1.0) is None


def test_the_largest_deviation_of_the_centre() -> None:
    rotation = Rotation.random(rng=np.random.default_rng(2)).as_matrix()
    covariance = 100.0 * np.eye(6)
    covariance[3:, 3:] = rotation @ np.diag([1.0, 4.0, 0.25]) @ rotation.T
    assert center_deviation(covariance) == pytest.approx(2.0)


def colmaps_covariance(camera: Camera, pose: RigidTransform, pixels: Array, world: Array) -> Array:
    """Return COLMAP's for pixel errors of one pixel, in our convention."""
    options: Any = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.random_seed = 0
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.gradient_tolerance = 1e-8
    theirs = pycolmap.Camera(model=camera.model, width=640, height=480, params=camera.params)
    refined = pycolmap.estimate_and_refine_absolute_pose(
        pixels, world, theirs, options, refinement, return_covariance=True
    )
    assert refined is not None
    # COLMAP's rotation is half of the angle, and does not act on its translation:
    # exp(r, v) x = R(r) x + v, so the translation changes by v + r x t
    t = pose.translation
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    ours_from_theirs = np.block([[2 * np.eye(3), np.zeros((3, 3))], [2 * cross, np.eye(3)]])
    return np.asarray(ours_from_theirs @ refined["covariance"] @ ours_from_theirs.T)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV_FISHEYE", "SIMPLE_RADIAL"])
def test_equal_to_colmaps_covariance(model: str) -> None:
    camera, pose = CAMERAS[model], rigid([0.3, -0.5, 0.2], [0.5, -1.0, 2.0])
    pixels, world = scene(camera, pose, np.random.default_rng(0), count=60)
    ours = located(absolute_pose(pixels, world, camera)).covariance
    assert ours is not None
    theirs = colmaps_covariance(camera, pose, pixels, world)
    # without residuals, ours assumes a tenth of a pixel
    np.testing.assert_allclose(ours, 0.1**2 * theirs, rtol=1e-4, atol=1e-6 * abs(ours).max())
