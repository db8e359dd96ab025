"""The pose of one camera from matches whose truth is known."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import bearing_rays, project
from megloc_kapture.localization.absolute_pose import (
    AbsolutePoseOptions,
    PoseEstimate,
    absolute_pose,
    center_deviation,
    estimate_pose,
    pose_covariance,
)
from megloc_kapture.localization.map_index import PoseProblem, View
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, Failure, Pose, RigidTransform

Array = NDArray[np.float64]
PINHOLE = Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.5, 239.0))
F, CX, CY = 500.0, 321.0, 238.5
CAMERAS = {
    "SIMPLE_PINHOLE": (F, CX, CY),
    "PINHOLE": (F, 510.0, CX, CY),
    "SIMPLE_RADIAL": (F, CX, CY, -0.05),
    "RADIAL": (F, CX, CY, -0.05, 0.01),
    "OPENCV": (F, 510.0, CX, CY, -0.05, 0.01, 1e-3, -2e-3),
    "OPENCV_FISHEYE": (F, 510.0, CX, CY, 0.02, -0.01, 3e-3, -1e-3),
    "FULL_OPENCV": (F, 510.0, CX, CY, -0.05, 0.01, 1e-3, -2e-3, 1e-3, 0.02, -0.01, 1e-3),
    "FOV": (F, 510.0, CX, CY, 0.9),
    "SIMPLE_RADIAL_FISHEYE": (F, CX, CY, 0.02),
    "RADIAL_FISHEYE": (F, CX, CY, 0.02, -0.01),
    "THIN_PRISM_FISHEYE": (F, 510.0, CX, CY, 0.02, -0.01, 1e-3, -1e-3, 1e-3, 0.0, 1e-3, -1e-3),
}
FISHEYE = Camera("OPENCV_FISHEYE", 640, 480, (400.0, 410.0, 320.0, 240.0, 0.02, -0.01, 0.0, 0.0))
RADIAL = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.1))


def random_pose(rng: np.random.Generator) -> RigidTransform:
    x, y, z, w = Rotation.random(rng=rng).as_quat()
    tx, ty, tz = (5 * rng.normal(size=3)).tolist()
    return RigidTransform((float(w), float(x), float(y), float(z)), (tx, ty, tz))


def scene(
    camera: Camera, pose: RigidTransform, rng: np.random.Generator, count: int = 100
) -> tuple[Array, Array]:
    """Pixels (N, 2) and world points (N, 3)."""
    in_cam = rng.uniform((-2, -1.5, 4), (2, 1.5, 9), (count, 3))
    world = pose.inverse().apply(in_cam)
    return project(camera, pose, world), world


def difference(found: RigidTransform, truth: RigidTransform) -> tuple[float, float]:
    """Distance of the centres, and angle in radians."""
    relative = Rotation.from_matrix(found.rotation_matrix() @ truth.rotation_matrix().T)
    return float(np.linalg.norm(found.center() - truth.center())), float(relative.magnitude())


def located(result: Pose | Failure) -> Pose:
    assert isinstance(result, Pose), result
    return result


def test_every_model_that_a_camera_can_have_is_tested() -> None:
    assert set(CAMERAS) == set(CAMERA_MODEL_NUM_PARAMS)


@pytest.mark.parametrize("model", CAMERAS)
def test_exact_matches_give_the_exact_pose(model: str) -> None:
    rng = np.random.default_rng(0)
    camera, truth = Camera(model, 640, 480, CAMERAS[model]), random_pose(rng)
    pixels, world = scene(camera, truth, rng)
    pose = located(absolute_pose(pixels, world, camera))
    distance, angle = difference(pose.cam_from_world, truth)
    assert distance < 1e-7 and angle < 1e-8  # as good as COLMAP undoes a distortion
    if "PINHOLE" in model:
        assert distance < 1e-9 and angle < 1e-10
    assert pose.num_matches == pose.num_inliers == 100
    assert pose.inliers is not None and pose.inliers.all()


@pytest.mark.parametrize("model", CAMERAS)
def test_half_of_the_matches_may_be_wrong(model: str) -> None:
    rng = np.random.default_rng(1)
    camera, truth = Camera(model, 640, 480, CAMERAS[model]), random_pose(rng)
    pixels, world = scene(camera, truth, rng, count=200)
    pixels += 0.5 * rng.normal(size=pixels.shape)
    wrong = np.arange(200) % 2 == 0
    world[wrong] = rng.permutation(world[wrong])
    pose = located(absolute_pose(pixels, world, camera))
    distance, angle = difference(pose.cam_from_world, truth)
    assert distance < 0.02 and np.degrees(angle) < 0.15
    errors = np.linalg.norm(project(camera, truth, world) - pixels, axis=1)
    assert pose.inliers is not None
    # the mask is that of the truth, but for matches next to the threshold
    clear = np.abs(errors - AbsolutePoseOptions().max_error_px) > 1.0
    np.testing.assert_array_equal(
        pose.inliers[clear], (errors <= AbsolutePoseOptions().max_error_px)[clear]
    )
    assert pose.num_inliers == pose.inliers.sum() and pose.num_matches == 200


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_any_pose_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_pose(rng)
    pixels, world = scene(PINHOLE, truth, rng, count=40)
    distance, angle = difference(
        located(absolute_pose(pixels, world, PINHOLE)).cam_from_world, truth
    )
    assert distance < 1e-7 and angle < 1e-8


def test_points_in_a_plane() -> None:
    rng = np.random.default_rng(2)
    truth = random_pose(rng)
    in_cam = rng.uniform((-2, -1.5, 0), (2, 1.5, 0), (60, 3)) + (0, 0, 6.0)
    in_cam[:, 2] += 0.4 * in_cam[:, 0]
    world = truth.inverse().apply(in_cam)
    pose = located(absolute_pose(project(PINHOLE, truth, world), world, PINHOLE))
    distance, angle = difference(pose.cam_from_world, truth)
    assert distance < 1e-8 and angle < 1e-9


def test_a_world_far_from_its_origin_loses_no_accuracy() -> None:
    rng = np.random.default_rng(3)
    near = random_pose(rng)
    pixels, world = scene(PINHOLE, near, rng, count=100)
    pixels += 0.3 * rng.normal(size=pixels.shape)
    far_from_near = RigidTransform((1.0, 0, 0, 0), (4.2e6, 1.7e5, 4.78e6))  # as ECEF
    first = located(absolute_pose(pixels, world, PINHOLE))
    second = located(absolute_pose(pixels, far_from_near.apply(world), PINHOLE))
    distance, angle = difference(second.cam_from_world @ far_from_near, first.cam_from_world)
    assert distance < 1e-6 and angle < 1e-8
    np.testing.assert_allclose(second.covariance, first.covariance, rtol=1e-4, atol=1e-14)
    assert first.num_inliers == second.num_inliers


def test_the_same_seed_gives_the_same_bits() -> None:
    rng = np.random.default_rng(4)
    pixels, world = scene(PINHOLE, random_pose(rng), rng, count=120)
    pixels += rng.normal(size=pixels.shape)
    world[::2] = rng.permutation(world[::2])
    first = located(absolute_pose(pixels, world, PINHOLE))
    again = located(absolute_pose(pixels.copy(), world.copy(), PINHOLE))
    assert first.cam_from_world == again.cam_from_world
    np.testing.assert_array_equal(first.inliers, again.inliers)
    np.testing.assert_array_equal(first.covariance, again.covariance)


@pytest.mark.parametrize("count", [0, 3, 11])
def test_too_few_matches_fail_and_say_so(count: int) -> None:
    rng = np.random.default_rng(5)
    pixels, world = scene(PINHOLE, random_pose(rng), rng, count=count)
    result = absolute_pose(pixels, world, PINHOLE)
    assert not result and isinstance(result, Failure)
    assert result.reason == f"{count} 2D-3D matches, at least 12 are needed"
    assert result.num_matches == count and result.num_inliers == 0


def test_matches_without_a_common_pose_fail_and_say_so() -> None:
    rng = np.random.default_rng(6)
    pixels, world = scene(PINHOLE, random_pose(rng), rng, count=60)
    result = absolute_pose(rng.permutation(pixels), world, PINHOLE)
    assert isinstance(result, Failure)
    assert "of 60 2D-3D matches agree, at least 12 are needed" in result.reason
    assert result.num_matches == 60 and 0 < result.num_inliers < 12


def test_points_on_a_line_determine_no_pose() -> None:
    rng = np.random.default_rng(7)
    truth = random_pose(rng)
    along = rng.uniform(-2, 2, (50, 1))
    in_cam = np.array([0.2, -0.3, 6.0]) + along * np.array([0.8, 0.3, 0.5])
    world = truth.inverse().apply(in_cam)
    result = absolute_pose(project(PINHOLE, truth, world), world, PINHOLE)
    # the camera may turn about the line: whatever comes back must not claim to know the pose
    assert isinstance(result, Failure)


def test_copies_of_one_point_determine_no_pose() -> None:
    rng = np.random.default_rng(8)
    truth = random_pose(rng)
    world = np.repeat(truth.inverse().apply(np.array([[0.3, 0.2, 5.0]])), 30, axis=0)
    assert isinstance(absolute_pose(project(PINHOLE, truth, world), world, PINHOLE), Failure)


def test_points_behind_the_camera_are_no_inliers() -> None:
    rng = np.random.default_rng(9)
    truth = random_pose(rng)
    pixels, world = scene(PINHOLE, truth, rng, count=60)
    mirrored = truth.apply(world)
    mirrored[40:] *= -1  # same pixels by the pinhole's formula, behind the camera
    world = truth.inverse().apply(mirrored)
    pose = located(absolute_pose(pixels, world, PINHOLE))
    assert pose.inliers is not None
    np.testing.assert_array_equal(pose.inliers, np.arange(60) < 40)


def test_values_that_are_not_finite_are_left_out() -> None:
    rng = np.random.default_rng(10)
    truth = random_pose(rng)
    pixels, world = scene(PINHOLE, truth, rng, count=60)
    world[3, 1] = np.nan
    world[4, 2] = np.inf
    pixels[5, 0] = np.nan
    pose = located(absolute_pose(pixels, world, PINHOLE))
    distance, angle = difference(pose.cam_from_world, truth)
    assert distance < 1e-8 and angle < 1e-9
    assert pose.inliers is not None
    assert np.flatnonzero(~pose.inliers).tolist() == [3, 4, 5]
    assert isinstance(absolute_pose(pixels, np.full_like(world, np.nan), PINHOLE), Failure)


def test_pixels_whose_distortion_cannot_be_undone_are_left_out() -> None:
    strong = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.3))
    rng = np.random.default_rng(11)
    truth = random_pose(rng)
    pixels, world = scene(strong, truth, rng, count=80)
    pixels[:20] = rng.uniform(0, 20, (20, 2))
    assert np.isnan(bearing_rays(strong, pixels[:20])).any(axis=1).all()
    pose = located(absolute_pose(pixels, world, strong))
    assert difference(pose.cam_from_world, truth)[0] < 1e-7
    assert pose.inliers is not None and not pose.inliers[:20].any() and pose.inliers[20:].all()


def test_pixels_just_past_what_the_distortion_reaches_are_left_out() -> None:
    # radius r goes to r (1 - 0.3 r^2) and reaches 0.703 at most, 351 px; these are at 356
    strong = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.3))
    rng = np.random.default_rng(15)
    truth = random_pose(rng)
    pixels, world = scene(strong, truth, rng, count=60)
    sides = np.array([[0.8, 0.6], [-0.8, 0.6], [0.8, -0.6]])
    world[:3] = truth.inverse().apply(5.0 * np.column_stack([1.05 * sides, np.ones(3)]))
    pixels[:3] = 356.0 * sides + (320.0, 240.0)
    assert np.linalg.norm(project(strong, truth, world) - pixels, axis=1)[:3].max() < 6
    assert np.isnan(bearing_rays(strong, pixels[:3])).any(axis=1).all()
    pose = located(absolute_pose(pixels, world, strong))
    assert difference(pose.cam_from_world, truth)[0] < 1e-7
    assert pose.inliers is not None
    np.testing.assert_array_equal(pose.inliers, np.arange(60) >= 3)


def test_options_are_used() -> None:
    rng = np.random.default_rng(12)
    truth = random_pose(rng)
    pixels, world = scene(PINHOLE, truth, rng, count=100)
    pixels[:50] += 6.0 * np.sign(rng.normal(size=(50, 2)))  # 8.5 px off
    loose = located(absolute_pose(pixels, world, PINHOLE, AbsolutePoseOptions(max_error_px=12)))
    tight = located(absolute_pose(pixels, world, PINHOLE, AbsolutePoseOptions(max_error_px=3)))
    assert loose.num_inliers > 90 and 50 <= tight.num_inliers < 60
    strict = AbsolutePoseOptions(max_error_px=3, min_inliers=70)
    assert isinstance(absolute_pose(pixels, world, PINHOLE, strict), Failure)


@pytest.mark.parametrize("sigma_px", [0.4, 2.0])
def test_the_covariance_is_that_of_repeated_estimates(sigma_px: float) -> None:
    """Errors over their covariance follow chi-squared with six degrees of freedom."""
    rng = np.random.default_rng(13)
    truth = random_pose(rng)
    pixels, world = scene(PINHOLE, truth, rng, count=80)
    options = AbsolutePoseOptions(min_iterations=10, max_iterations=50)
    runs, squared = 150, []
    for _ in range(runs):
        noisy = pixels + sigma_px * rng.normal(size=pixels.shape)
        pose = located(absolute_pose(noisy, world, PINHOLE, options))
        assert pose.covariance is not None
        true_from_found = truth @ pose.cam_from_world.inverse()
        vector = Rotation.from_matrix(true_from_found.rotation_matrix()).as_rotvec()
        error = np.concatenate([vector, true_from_found.translation])
        squared.append(float(error @ np.linalg.solve(pose.covariance, error)))
    # the robust loss has 95 % efficiency: 6.3 is expected
    assert 5.2 < np.mean(squared) < 7.4
    assert (np.array(squared) < chi2.ppf(0.95, 6)).mean() > 0.88


def test_the_camera_of_the_query_is_used_not_one_like_it() -> None:
    rng = np.random.default_rng(14)
    truth = random_pose(rng)
    pixels, world = scene(PINHOLE, truth, rng)
    zoomed = replace(PINHOLE, params=(600.0, 612.0, 320.5, 239.0))
    other = located(absolute_pose(pixels, world, zoomed))
    assert difference(other.cam_from_world, truth)[0] > 0.5


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


RIG_CAMERAS = [
    Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.5, 239.0)),
    Camera("OPENCV_FISHEYE", 640, 480, (400.0, 410.0, 320.0, 240.0, 0.02, -0.01, 0.0, 0.0)),
    Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.1)),
]
AT_ORIGIN = RigidTransform.identity()


def transform(vector: list[float], translation: list[float]) -> RigidTransform:
    return RigidTransform.from_matrix(
        Rotation.from_rotvec(vector).as_matrix(), np.array(translation)
    )


def rig(count: int, seed: int = 0) -> tuple[RigidTransform, list[View]]:
    """``rig_from_world`` and views with a noise of one pixel whose every second match is wrong."""
    rng = np.random.default_rng(seed)
    rig_from_world = transform([0.3, -1.2, 0.4], [3.0, -2.0, 1.0])
    views = []
    for k, camera in enumerate(RIG_CAMERAS):
        cam_from_rig = transform([0.05 * k, 1.5 * k, 0.1], [0.4 * k, 0.1, -0.2 * k])
        cam_from_world = cam_from_rig @ rig_from_world
        world = cam_from_world.inverse().apply(rng.uniform((-2, -1.5, 4), (2, 1.5, 9), (count, 3)))
        pixels = project(camera, cam_from_world, world) + rng.normal(size=(count, 2))
        pixels[::2] = rng.uniform((0, 0), (640, 480), pixels[::2].shape)
        views.append(View(camera, cam_from_rig, pixels, world))
    return rig_from_world, views


def estimated(result: PoseEstimate | Failure) -> PoseEstimate:
    assert isinstance(result, PoseEstimate), result
    return result


def distance(found: RigidTransform, truth: RigidTransform) -> float:
    return float(np.linalg.norm(found.center() - truth.center()))


@pytest.mark.parametrize("used", [[0], [1], [2], [0, 1], [0, 1, 2]])
def test_any_of_a_rigs_cameras_may_have_the_matches(used: list[int]) -> None:
    truth, views = rig(80)
    for k in set(range(3)) - set(used):
        views[k] = View(views[k].camera, views[k].cam_from_rig, np.zeros((0, 2)), np.zeros((0, 3)))
    estimate = estimated(estimate_pose(PoseProblem.of(views)))
    assert distance(estimate.rig_from_world, truth) < 0.05
    assert estimate.num_inliers == estimate.inliers.sum() <= estimate.usable.sum()
    for k, inliers in enumerate(PoseProblem.of(views).split(estimate.inliers)):
        if k in used:
            assert inliers[1::2].all() and inliers[::2].mean() < 0.1
        else:
            assert len(inliers) == 0


def test_inliers_are_those_within_the_error_of_the_cameras_own_model() -> None:
    _, views = rig(60, seed=1)
    options = AbsolutePoseOptions(max_error_px=2.5)
    estimate = estimated(estimate_pose(PoseProblem.of(views), options))
    expected = [
        np.linalg.norm(
            project(v.camera, v.cam_from_rig @ estimate.rig_from_world, v.points_world)
            - v.points_px,
            axis=1,
        )
        <= 2.5
        for v in views
    ]
    assert 0.3 < np.concatenate(expected).mean() < 0.52
    np.testing.assert_array_equal(estimate.inliers, np.concatenate(expected))


def test_the_same_bits_from_many_threads_at_once() -> None:
    """GP3P draws from a generator that all threads share."""
    problems = [PoseProblem.of(rig(30, seed)[1]) for seed in range(4)]
    expected = [estimated(estimate_pose(each)).rig_from_world for each in problems]
    with ThreadPoolExecutor(4) as executor:
        found = list(executor.map(estimate_pose, problems * 15))
    assert [estimated(estimate).rig_from_world for estimate in found] == expected * 15


def test_failures_say_why() -> None:
    truth, views = rig(30)
    none = estimate_pose(PoseProblem.of([]))
    assert isinstance(none, Failure) and none.reason.startswith("0 2D-3D matches, at least 12")
    nan = [View(v.camera, v.cam_from_rig, v.points_px, np.nan * v.points_world) for v in views]
    unusable = estimate_pose(PoseProblem.of(nan))
    assert isinstance(unusable, Failure) and unusable.num_matches == 90
    assert unusable.reason == "0 of 90 2D-3D matches can be used, at least 12 are needed"
    rng = np.random.default_rng(0)
    mixed = [
        View(v.camera, v.cam_from_rig, rng.permutation(v.points_px), v.points_world) for v in views
    ]
    apart = estimate_pose(PoseProblem.of(mixed))
    assert isinstance(apart, Failure) and "of 90 2D-3D matches agree" in apart.reason
    assert 0 < apart.num_inliers < 12


@pytest.mark.parametrize(
    "pixels, points, covariances",
    [((3, 3), (3, 3), None), ((3, 2), (4, 3), None), ((3, 2), (3, 2), None), ((3, 2), (3, 3), 5)],
)
def test_arrays_that_do_not_belong_together_are_refused(
    pixels: tuple[int, int], points: tuple[int, int], covariances: int | None
) -> None:
    with pytest.raises(DataError):
        View(
            PINHOLE,
            AT_ORIGIN,
            np.zeros(pixels),
            np.zeros(points),
            None if covariances is None else np.zeros((3, covariances)),
        )


def test_what_runs_over_all_views_is_taken_apart() -> None:
    views = [View(PINHOLE, AT_ORIGIN, np.zeros((n, 2)), np.zeros((n, 3))) for n in (2, 0, 3)]
    parts = PoseProblem.of(views).split(np.array([True, False, False, True, True]))
    assert [part.tolist() for part in parts] == [[True, False], [], [False, True, True]]


def test_views_with_and_without_covariances_together() -> None:
    points = np.arange(6.0).reshape(2, 3)
    covariances = np.arange(12.0).reshape(2, 6)
    known = View(PINHOLE, AT_ORIGIN, np.zeros((2, 2)), points, covariances)
    unknown = View(PINHOLE, AT_ORIGIN, np.zeros((1, 2)), np.zeros((1, 3)))
    stacked = PoseProblem.of([unknown, known])
    np.testing.assert_array_equal(stacked.covariances, [[0] * 6, *covariances])
    np.testing.assert_array_equal(stacked.points[1:] + stacked.offset, points)
    assert len(PoseProblem.of([unknown]).covariances) == 0


def test_points_that_are_not_finite_do_not_move_the_origin() -> None:
    points = np.full((200, 3), 5e6)
    points[::2] = np.nan
    points[3] = 1e300
    view = View(PINHOLE, AT_ORIGIN, np.zeros((200, 2)), points)
    assert np.abs(PoseProblem.of([view]).offset).max() <= 5e6
