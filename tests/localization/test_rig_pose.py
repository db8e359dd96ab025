"""The pose of a rig from the matches of all its cameras."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from camera_models import CAMERAS, PINHOLE, STRONG
from numpy.typing import NDArray
from poses import located, rigid

from megloc_kapture.geometry.cameras import bearing_rays, project
from megloc_kapture.geometry.poses import movement
from megloc_kapture.localization.absolute_pose import (
    AbsolutePoseOptions,
    PoseEstimate,
    estimate_pose,
    rig_pose,
)
from megloc_kapture.localization.map_index import PoseProblem, View
from megloc_kapture.values import Failure, Pose, RigidTransform

RIG_CAMERAS = (PINHOLE, CAMERAS["OPENCV_FISHEYE"], STRONG)
AT_ORIGIN = RigidTransform.identity()


def rig(
    count: int, seed: int = 0, *, shift: float = 0.0, noise_px: float = 0.0, wrong: bool = False
) -> tuple[RigidTransform, list[View]]:
    """Return ``rig_from_world`` and three views in different directions.

    ``wrong`` replaces every second match by a random one.
    """
    rng = np.random.default_rng(seed)
    rig_from_world = rigid([0.3, -1.2, 0.4], [3.0, -2.0, 1.0]) @ RigidTransform(
        (1.0, 0.0, 0.0, 0.0), (-shift, -shift, shift)
    )
    views = []
    for k, camera in enumerate(RIG_CAMERAS):
        cam_from_rig = rigid([0.05 * k, 1.5 * k, 0.1], [0.4 * k, 0.1, -0.2 * k])
        cam_from_world = cam_from_rig @ rig_from_world
        world = cam_from_world.inverse().apply(rng.uniform((-2, -1.5, 4), (2, 1.5, 9), (count, 3)))
        pixels = project(camera, cam_from_world, world) + noise_px * rng.normal(size=(count, 2))
        if wrong:
            pixels[::2] = rng.uniform((0, 0), (640, 480), pixels[::2].shape)
        views.append(View(camera, cam_from_rig, pixels, world))
    return rig_from_world, views


def without_matches(view: View) -> View:
    return replace(view, points_px=np.zeros((0, 2)), points_world=np.zeros((0, 3)))


def exact(result: Pose | Failure, truth: RigidTransform, within: float = 1e-7) -> bool:
    distance, angle_deg = movement(located(result).cam_from_world, truth)
    return distance < within and np.radians(angle_deg) < 1e-8


@pytest.mark.parametrize(
    ("count", "seed", "shift", "within"), [(30, 0, 0, 1e-7), (30, 0, 4.5e6, 1e-5), (8, 1, 0, 1e-7)]
)
def test_exact_matches_give_the_exact_pose(
    count: int, seed: int, shift: float, within: float
) -> None:
    """Also far from the origin, and with too few matches per camera for a pose of each."""
    truth, views = rig(count, seed, shift=shift)
    result = rig_pose(views)
    assert exact(result, truth, within)
    assert result.num_inliers == result.num_matches == 3 * count


@pytest.mark.parametrize("used", [[1], [0, 1], [0, 1, 2]])
def test_some_of_a_rigs_cameras_may_have_no_matches(used: list[int]) -> None:
    truth, views = rig(80, noise_px=1.0, wrong=True)
    some = [view if k in used else without_matches(view) for k, view in enumerate(views)]
    problem = PoseProblem.of(some)
    estimate = estimate_pose(problem, AbsolutePoseOptions())
    assert isinstance(estimate, PoseEstimate)
    assert movement(estimate.rig_from_world, truth)[0] < 0.05
    assert estimate.num_inliers == estimate.inliers.sum() <= estimate.usable.sum()
    result = located(rig_pose(some))
    distance, angle_deg = movement(result.cam_from_world, truth)
    assert distance < 0.03 and angle_deg < 0.2
    for mask in (estimate.inliers, result.inliers):
        for k, inliers in enumerate(problem.split(mask)):
            if k in used:
                assert inliers[1::2].all() and inliers[::2].mean() < 0.1
            else:
                assert len(inliers) == 0


def test_invalid_points_and_pixels_without_rays_are_outliers() -> None:
    truth, views = rig(30)
    views[0].points_world[2:4, 1] = np.nan, np.inf
    views[0].points_px[4, 0] = np.nan
    # pixels without rays under this distortion; the second is 5 px beyond the limit
    views[2].points_px[5] = (0.0, 0.0)
    cam_from_world = views[2].cam_from_rig @ truth
    views[2].points_px[6] = (320 + 0.8 * 356, 240 + 0.6 * 356)
    views[2].points_world[6] = cam_from_world.inverse().apply(np.array([[4.2, 3.15, 5.0]]))[0]
    seen = project(STRONG, cam_from_world, views[2].points_world[6:7])
    assert np.linalg.norm(seen - views[2].points_px[6]) < 6
    assert np.isnan(bearing_rays(STRONG, views[2].points_px[5:7])).any(axis=1).all()
    result = located(rig_pose(views))
    assert exact(result, truth)
    assert result.inliers is not None
    assert np.flatnonzero(~result.inliers).tolist() == [2, 3, 4, 65, 66]
    # the same without a rig
    alone = located(rig_pose(views[2:]))
    assert exact(alone, truth) and alone.inliers is not None
    assert np.flatnonzero(~alone.inliers).tolist() == [5, 6]


def test_failures_have_a_reason_and_counts() -> None:
    _, views = rig(30)
    rng = np.random.default_rng(2)
    mixed = [replace(view, points_px=rng.permutation(view.points_px)) for view in views]
    nan = [replace(view, points_world=np.nan * view.points_world) for view in views]
    for matched, reason in (
        ([], "0 2D-3D matches"),
        (rig(3)[1], "9 2D-3D matches, at least 12"),
        (nan, "0 of 90 2D-3D matches can be used"),
        (mixed, "of 90 2D-3D matches agree"),
    ):
        failed = rig_pose(matched)
        assert isinstance(failed, Failure) and reason in failed.reason
        assert failed.num_matches == sum(len(view.points_px) for view in matched)
        assert 0 <= failed.num_inliers < 12


def test_many_threads_give_the_same_poses() -> None:
    """GP3P draws from a random generator that all threads share."""
    problems = [PoseProblem.of(rig(30, seed, noise_px=1.0, wrong=True)[1]) for seed in range(2)]
    problems.append(PoseProblem.of(problems[0].views[:1]))

    def estimated(problem: PoseProblem) -> RigidTransform:
        estimate = estimate_pose(problem, AbsolutePoseOptions())
        assert isinstance(estimate, PoseEstimate)
        return estimate.rig_from_world

    expected = list(map(estimated, problems))
    with ThreadPoolExecutor(4) as executor:
        assert list(executor.map(estimated, problems * 4)) == expected * 4


def colmap_rigid(transform: RigidTransform) -> pycolmap.Rigid3d:
    w, x, y, z = transform.quat_wxyz
    rotation = pycolmap.Rotation3d(np.array([x, y, z, w]))
    return pycolmap.Rigid3d(rotation, np.array(transform.translation))


def colmaps(views: list[View]) -> RigidTransform:
    """Return COLMAP's refined generalized pose."""
    ransac = pycolmap.RANSACOptions()
    ransac.max_error = 12.0
    ransac.random_seed = 0
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.gradient_tolerance = 1e-8
    result = pycolmap.estimate_and_refine_generalized_absolute_pose(
        np.concatenate([view.points_px for view in views]),
        np.concatenate([view.points_world for view in views]),
        np.repeat(np.arange(len(views)), [len(view.points_px) for view in views]).tolist(),
        [colmap_rigid(view.cam_from_rig) for view in views],
        [
            pycolmap.Camera(model=c.model, width=640, height=480, params=list(c.params))
            for c in RIG_CAMERAS
        ],
        ransac,
        refinement,
    )
    assert result is not None
    matrix = result["rig_from_world"].matrix()
    return RigidTransform.from_matrix(matrix[:, :3], matrix[:, 3])


def residuals(views: list[View], rig_from_world: RigidTransform) -> NDArray[np.float64]:
    return np.concatenate(
        [
            project(v.camera, v.cam_from_rig @ rig_from_world, v.points_world) - v.points_px
            for v in views
        ]
    )


@pytest.mark.parametrize("seed", range(2))
def test_the_minimum_is_at_least_as_good_as_colmaps(seed: int) -> None:
    """Costs are compared, because COLMAP's refinement sometimes stops early."""
    rng = np.random.default_rng(seed)
    views = rig(60, seed, noise_px=1.0)[1]
    for view in views:
        view.points_px[:10] = rng.uniform(0, 480, (10, 2))
    ours, theirs = located(rig_pose(views)), colmaps(views)

    def cost(pose: RigidTransform) -> float:
        squared = (residuals(views, pose)[ours.inliers] ** 2).sum(axis=1)
        return float(np.log1p(squared / 2.385**2).sum())

    distance, angle_deg = movement(ours.cam_from_world, theirs)
    assert distance < 0.01 and angle_deg < 0.1
    assert cost(ours.cam_from_world) < 1.001 * cost(theirs)


def test_views_are_stacked_and_split() -> None:
    points = np.arange(6.0).reshape(2, 3)
    covariances = np.arange(12.0).reshape(2, 6)
    known = View(PINHOLE, AT_ORIGIN, np.zeros((2, 2)), points, covariances)
    unknown = View(PINHOLE, AT_ORIGIN, np.zeros((1, 2)), np.zeros((1, 3)))
    stacked = PoseProblem.of([unknown, without_matches(unknown), known])
    np.testing.assert_array_equal(stacked.covariances, [[0] * 6, *covariances])
    np.testing.assert_array_equal(stacked.points[1:] + stacked.offset, points)
    assert len(PoseProblem.of([unknown]).covariances) == 0
    parts = stacked.split(np.array([True, False, True]))
    assert [part.tolist() for part in parts] == [[True], [], [False, True]]
