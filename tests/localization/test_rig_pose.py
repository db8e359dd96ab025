"""The pose of a rig from the matches of all its cameras."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from megloc_kapture.geometry.cameras import project
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions, absolute_pose, rig_pose
from megloc_kapture.localization.map_index import PoseProblem, View
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform

PINHOLE = Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.5, 239.0))
FISHEYE = Camera("OPENCV_FISHEYE", 640, 480, (400.0, 410.0, 320.0, 240.0, 0.02, -0.01, 0.0, 0.0))
STRONG = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.3))


def transform(vector: list[float], translation: list[float]) -> RigidTransform:
    return RigidTransform.from_matrix(
        Rotation.from_rotvec(vector).as_matrix(), np.array(translation)
    )


def rig(count: int, seed: int = 0, shift: float = 0.0) -> tuple[RigidTransform, list[View]]:
    """``rig_from_world`` and three different cameras that look to different sides."""
    rng = np.random.default_rng(seed)
    rig_from_world = transform([0.3, -1.2, 0.4], [3.0, -2.0, 1.0]) @ RigidTransform(
        (1.0, 0.0, 0.0, 0.0), (-shift, -shift, shift)
    )
    views = []
    for k, camera in enumerate((PINHOLE, FISHEYE, STRONG)):
        cam_from_rig = transform([0.05 * k, 1.5 * k, 0.1], [0.4 * k, 0.1, -0.2 * k])
        in_cam = rng.uniform((-2, -1.5, 4), (2, 1.5, 9), (count, 3))
        cam_from_world = cam_from_rig @ rig_from_world
        world = cam_from_world.inverse().apply(in_cam)
        views.append(View(camera, cam_from_rig, project(camera, cam_from_world, world), world))
    return rig_from_world, views


def located(result: Pose | Failure) -> Pose:
    assert isinstance(result, Pose), result
    return result


def difference(found: Pose | Failure, truth: RigidTransform) -> tuple[float, float]:
    pose = located(found).cam_from_world
    angle = Rotation.from_matrix((pose @ truth.inverse()).rotation_matrix()).magnitude()
    centers = pose.center() - truth.center()
    return float(np.linalg.norm(centers)), float(angle)


@pytest.mark.parametrize("seed", range(3))
def test_exact_matches_give_the_exact_pose(seed: int) -> None:
    truth, views = rig(30, seed)
    found = rig_pose(views)
    distance, angle = difference(found, truth)
    assert distance < 1e-7 and angle < 1e-8
    assert found.num_inliers == found.num_matches == 90


def test_cameras_that_could_not_be_located_alone_help_each_other() -> None:
    truth, views = rig(8)  # each below the twelve inliers that are needed
    distance, angle = difference(rig_pose(views), truth)
    assert distance < 1e-7 and angle < 1e-8


def test_half_of_the_matches_may_be_wrong() -> None:
    rng = np.random.default_rng(1)
    truth, views = rig(80)
    for view in views:
        view.points_px[::2] = rng.uniform((0, 0), (640, 480), (40, 2))
        view.points_px[1::2] += 0.5 * rng.normal(size=(40, 2))
    found = rig_pose(views)
    distance, angle = difference(found, truth)
    assert distance < 0.03 and np.degrees(angle) < 0.2
    assert isinstance(found, Pose) and found.inliers is not None
    good = found.inliers.reshape(3, 80)
    assert good[:, 1::2].mean() > 0.98 and good[:, ::2].mean() < 0.05


@pytest.mark.parametrize("used", [0, 1, 2])
def test_one_camera_with_matches_is_enough(used: int) -> None:
    truth, views = rig(30)
    for k, view in enumerate(views):
        if k != used:
            views[k] = View(view.camera, view.cam_from_rig, np.zeros((0, 2)), np.zeros((0, 3)))
    distance, angle = difference(rig_pose(views), truth)
    assert distance < 1e-7 and angle < 1e-8


def test_a_world_far_from_its_origin() -> None:
    truth, views = rig(30, shift=4.5e6)
    distance, angle = difference(rig_pose(views), truth)
    assert distance < 1e-5 and angle < 1e-8


def test_values_that_cannot_be_used_are_left_out() -> None:
    truth, views = rig(30)
    views[0].points_world[2] = np.nan
    # no rays under this distortion: the second one is 5 px past the last that has one
    views[2].points_px[5] = (0.0, 0.0)
    cam_from_world = views[2].cam_from_rig @ truth
    views[2].points_px[6] = (320 + 0.8 * 356, 240 + 0.6 * 356)
    views[2].points_world[6] = cam_from_world.inverse().apply(np.array([[4.2, 3.15, 5.0]]))[0]
    found = rig_pose(views)
    distance, angle = difference(found, truth)
    assert distance < 1e-7 and angle < 1e-8
    assert isinstance(found, Pose) and found.inliers is not None
    assert np.flatnonzero(~found.inliers).tolist() == [2, 65, 66]


def test_failures_say_why() -> None:
    truth, views = rig(3)
    few = rig_pose(views)
    assert isinstance(few, Failure) and few.reason == "9 2D-3D matches, at least 12 are needed"
    assert isinstance(rig_pose([]), Failure)
    truth, views = rig(30)
    rng = np.random.default_rng(2)
    mixed = [
        View(v.camera, v.cam_from_rig, rng.permutation(v.points_px), v.points_world) for v in views
    ]
    failed = rig_pose(mixed)
    assert isinstance(failed, Failure) and "of 90 2D-3D matches agree" in failed.reason
    broken = [View(v.camera, v.cam_from_rig, v.points_px, np.nan * v.points_world) for v in views]
    assert isinstance(rig_pose(broken), Failure)


def test_the_same_seed_gives_the_same_bits() -> None:
    _, views = rig(40)
    rng = np.random.default_rng(3)
    for view in views:
        view.points_px[::2] = rng.uniform(0, 480, (20, 2))
    poses = {located(rig_pose(views)).cam_from_world for _ in range(5)}
    assert len(poses) == 1


@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_a_camera_full_of_wrong_matches_is_survived(wrong: int) -> None:
    rng = np.random.default_rng(4)
    truth, views = rig(60)
    for k, view in enumerate(views):
        if k == wrong:
            view.points_world[:] = rng.permutation(view.points_world)
        view.points_px[:] += rng.normal(size=(60, 2))
    found = located(rig_pose(views))
    distance, angle = difference(found, truth)
    assert distance < 0.02 and np.degrees(angle) < 0.2
    assert found.inliers is not None
    for k, inliers in enumerate(PoseProblem.of(views).split(found.inliers)):
        assert inliers.mean() < 0.1 if k == wrong else inliers.all()


def test_a_rig_of_one_camera_is_that_camera() -> None:
    rng = np.random.default_rng(5)
    _, views = rig(60)
    view = views[1]
    view.points_px[:] += rng.normal(size=(60, 2))
    alone = located(absolute_pose(view.points_px, view.points_world, view.camera))
    within = located(rig_pose([view]))
    distance, angle = difference(
        Pose(view.cam_from_rig @ within.cam_from_world, 60, 60), alone.cam_from_world
    )
    assert distance < 1e-5 and angle < 1e-6
    np.testing.assert_array_equal(alone.inliers, within.inliers)


def colmap_rigid(transform: RigidTransform) -> pycolmap.Rigid3d:
    w, x, y, z = transform.quat_wxyz
    rotation = pycolmap.Rotation3d(np.array([x, y, z, w]))
    return pycolmap.Rigid3d(rotation, np.array(transform.translation))


def colmaps(views: list[View]) -> RigidTransform:
    """COLMAP's generalized pose, refined (pycolmap 4.0.4 crashes on computing its covariance)."""
    ransac = pycolmap.RANSACOptions()
    ransac.max_error = 12.0
    ransac.random_seed = 0
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.gradient_tolerance = 1e-8
    found = pycolmap.estimate_and_refine_generalized_absolute_pose(
        np.concatenate([view.points_px for view in views]),
        np.concatenate([view.points_world for view in views]),
        np.repeat(np.arange(len(views)), [len(view.points_px) for view in views]).tolist(),
        [colmap_rigid(view.cam_from_rig) for view in views],
        [
            pycolmap.Camera(
                model=v.camera.model, width=640, height=480, params=list(v.camera.params)
            )
            for v in views
        ],
        ransac,
        refinement,
    )
    assert found is not None
    matrix = found["rig_from_world"].matrix()
    return RigidTransform.from_matrix(matrix[:, :3], matrix[:, 3])


def test_the_covariance_is_that_of_all_cameras_together() -> None:
    """The inverse normal matrix, by finite differences of every camera's projection."""
    truth, views = rig(30)

    def pixels(vector: np.ndarray) -> np.ndarray:
        moved = transform(list(vector[:3]), list(vector[3:])) @ truth
        return np.concatenate(
            [project(v.camera, v.cam_from_rig @ moved, v.points_world) for v in views]
        ).ravel()

    steps = 1e-6 * np.eye(6)
    jacobian = np.stack([(pixels(step) - pixels(-step)) / 2e-6 for step in steps], axis=1)
    found = located(rig_pose(views)).covariance
    # without any residual a tenth of a pixel is taken
    expected = 0.1**2 * np.linalg.inv(jacobian.T @ jacobian)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6 * abs(expected).max())


@pytest.mark.parametrize("seed", range(4))
def test_no_worse_a_minimum_than_colmaps(seed: int) -> None:
    """Not in the poses' distance: COLMAP's refinement sometimes stops some deviations away."""
    rng = np.random.default_rng(seed)
    _, views = rig(60)
    for view in views:
        view.points_px[:] += rng.normal(size=(60, 2))
        view.points_px[:10] = rng.uniform(0, 480, (10, 2))
    ours, theirs = located(rig_pose(views)), colmaps(views)

    def cost(pose: RigidTransform) -> float:
        residuals = np.concatenate(
            [project(v.camera, v.cam_from_rig @ pose, v.points_world) - v.points_px for v in views]
        )[ours.inliers]
        return float(np.log1p((residuals**2).sum(axis=1) / 2.385**2).sum())

    distance, angle = difference(ours, theirs)
    assert distance < 0.01 and np.degrees(angle) < 0.1
    assert cost(ours.cam_from_world) < 1.001 * cost(theirs)


def error_vector(found: RigidTransform, truth: RigidTransform) -> np.ndarray:
    true_from_found = truth @ found.inverse()
    vector = Rotation.from_matrix(true_from_found.rotation_matrix()).as_rotvec()
    return np.concatenate([vector, true_from_found.translation])


def test_the_covariance_is_that_of_repeated_estimates() -> None:
    """Errors over their covariance follow chi-squared with six degrees of freedom."""
    rng = np.random.default_rng(7)
    truth, views = rig(30)
    options = AbsolutePoseOptions(min_iterations=10, max_iterations=50)
    squared = []
    for _ in range(150):
        noisy = [
            View(v.camera, v.cam_from_rig, v.points_px + rng.normal(size=(30, 2)), v.points_world)
            for v in views
        ]
        pose = located(rig_pose(noisy, options))
        assert pose.covariance is not None
        error = error_vector(pose.cam_from_world, truth)
        squared.append(float(error @ np.linalg.solve(pose.covariance, error)))
    assert 5.2 < np.mean(squared) < 7.2
    assert (np.array(squared) < chi2.ppf(0.95, 6)).mean() > 0.9


def test_a_rig_is_located_better_than_its_best_camera() -> None:
    rng = np.random.default_rng(8)
    truth, views = rig(30)
    of_rig, of_camera = [], []
    for _ in range(30):
        noisy = [
            View(v.camera, v.cam_from_rig, v.points_px + rng.normal(size=(30, 2)), v.points_world)
            for v in views
        ]
        of_rig.append(difference(located(rig_pose(noisy)), truth)[0])
        of_camera.append(min(difference(located(rig_pose([v])), truth)[0] for v in noisy))
    assert np.mean(of_rig) < 0.8 * np.mean(of_camera)
