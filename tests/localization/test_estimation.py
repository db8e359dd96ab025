"""The first estimate of a pose, of one camera or several."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import project
from megloc_kapture.localization.estimation import (
    AbsolutePoseOptions,
    PoseEstimate,
    PoseProblem,
    View,
    estimate_pose,
    split_by_view,
)
from megloc_kapture.values import Camera, Failure, RigidTransform

Array = NDArray[np.float64]
CAMERAS = [
    Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.5, 239.0)),
    Camera("OPENCV_FISHEYE", 640, 480, (400.0, 410.0, 320.0, 240.0, 0.02, -0.01, 0.0, 0.0)),
    Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.1)),
]
PINHOLE = Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.5, 239.0))
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
    for k, camera in enumerate(CAMERAS):
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
    for k, inliers in enumerate(split_by_view(views, estimate.inliers)):
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
    parts = split_by_view(views, np.array([True, False, False, True, True]))
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
