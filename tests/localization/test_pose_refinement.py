"""The refinement: its derivatives, its minimum, its covariance, and rejected poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import poselib
import pytest
from camera_models import CAMERAS, CX, CY, PINHOLE, F
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from poses import error_vector, located, random_pose
from scipy.stats import chi2

from megloc_kapture.geometry.cameras import bearing_rays, focal_px, project, px_from_cam
from megloc_kapture.geometry.poses import perturbed
from megloc_kapture.localization import absolute_pose as module
from megloc_kapture.localization.absolute_pose import (
    AbsolutePoseOptions,
    PoseEstimate,
    refine_pose,
    rig_pose,
)
from megloc_kapture.localization.map_index import PoseProblem, View
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform

Array = NDArray[np.float64]
AT_ORIGIN = RigidTransform.identity()
LOOSE = AbsolutePoseOptions(max_error_px=100)


@pytest.fixture
def whole_covariance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Weight points by their full covariance."""
    monkeypatch.setattr(module, "_MAP_NOISE", 1.0)


def in_unit(pose: RigidTransform, unit: float) -> RigidTransform:
    return RigidTransform(pose.quat_wxyz, tuple(unit * np.array(pose.translation)))


def squared_error(pose: Pose, truth: RigidTransform) -> float:
    """Return the squared Mahalanobis distance by the pose's covariance."""
    assert pose.covariance is not None
    error = error_vector(pose.cam_from_world, truth)
    return float(error @ np.linalg.solve(pose.covariance, error))


def refined(
    view: View,
    start: RigidTransform,
    options: AbsolutePoseOptions | None = None,
    usable: NDArray[np.bool_] | None = None,
) -> Pose | Failure:
    """Refine a start; ``usable`` None means all matches."""
    count = len(view.points_px)
    usable = np.ones(count, dtype=np.bool_) if usable is None else usable
    estimate = PoseEstimate(start, usable, usable, np.zeros(count))
    return refine_pose(PoseProblem.of([view]), estimate, options or AbsolutePoseOptions())


def six(matrices: Array) -> Array:
    """Return symmetric (N, 3, 3) as (N, 6): xx, xy, xz, yy, yz, zz."""
    return matrices[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]


def random_covariances(rng: np.random.Generator, count: int, size: float) -> Array:
    """Return anisotropic (N, 3, 3) whose longest axes are about ``size``."""
    factors = rng.normal(size=(count, 3, 3)) * (size * np.array([1.0, 0.3, 0.1]))
    return factors @ factors.transpose(0, 2, 1)


def noisy_view(
    camera: Camera, pose: RigidTransform, rng: np.random.Generator, count: int, sigma: float = 1.0
) -> View:
    world = pose.inverse().apply(rng.uniform((-2, -1.5, 4), (2, 1.5, 9), (count, 3)))
    pixels = project(camera, pose, world) + sigma * rng.normal(size=(count, 2))
    return View(camera, AT_ORIGIN, pixels, world)


def refined_by_poselib(view: View, start: RigidTransform) -> RigidTransform:
    """Refine twice by poselib with our rule for the scale, on undistorted pixels."""
    focal = focal_px(view.camera)
    pinhole = {"model": "PINHOLE", "width": 1, "height": 1, "params": [focal, focal, 0.0, 0.0]}
    undistorted = np.ascontiguousarray(bearing_rays(view.camera, view.points_px)[:, :2]) * focal
    actual = poselib.CameraPose()
    actual.q, actual.t = np.array(start.quat_wxyz), np.array(start.translation)
    pose = start
    for _ in range(2):
        residuals = project(view.camera, pose, view.points_world) - view.points_px
        errors = np.linalg.norm(residuals, axis=1)
        near = errors <= 12.0
        loss_scale = 2.385 * max(float(np.median(errors[near])) / 1.1774, 0.1)
        loss = {"loss_type": "CAUCHY", "loss_scale": loss_scale}
        actual, _ = poselib.refine_absolute_pose(
            undistorted[near], view.points_world[near], actual, pinhole, loss
        )
        pose = RigidTransform.from_matrix(actual.R, actual.t)
    return pose


@pytest.mark.parametrize("sigma_px", [0.05, 3.0])
def test_without_covariances_the_pose_equals_poselibs(sigma_px: float) -> None:
    rng = np.random.default_rng(1)
    square = replace(PINHOLE, params=(F, F, CX, CY))
    for _ in range(4):
        truth = random_pose(rng)
        view = noisy_view(square, truth, rng, 100, sigma_px)
        view.points_px[:10] += 8.0 * rng.normal(size=(10, 2))
        start = perturbed(truth, 2e-3 * sigma_px * rng.normal(size=6))
        # in standard deviations of the pose
        off = squared_error(located(refined(view, start)), refined_by_poselib(view, start))
        assert np.sqrt(off) < 0.01


@pytest.mark.usefixtures("whole_covariance")
@given(st.sampled_from(sorted(CAMERAS)), st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 1, 1e3]))
def test_refinement_converges_under_any_model(model: str, seed: int, unit: float) -> None:
    rng = np.random.default_rng(seed)
    truth = random_pose(rng)
    view = noisy_view(CAMERAS[model], truth, rng, 40, 0.0)
    start = perturbed(truth, 0.01 * rng.normal(size=6))
    scaled = replace(view, points_world=unit * view.points_world)
    pose = located(refined(scaled, in_unit(start, unit), LOOSE))
    apart = error_vector(pose.cam_from_world, in_unit(truth, unit))
    assert np.abs(apart[:3]).max() < 1e-9 and np.abs(apart[3:]).max() < 1e-8 * unit
    assert pose.num_inliers == 40


@pytest.mark.usefixtures("whole_covariance")
def test_the_covariance_predicts_the_spread_of_estimates() -> None:
    """Errors over their covariance follow chi-squared with six degrees of freedom."""
    rng = np.random.default_rng(2)
    truth, sigma_px = random_pose(rng), 2.0
    drawn = []
    for _ in range(200):
        view = noisy_view(PINHOLE, truth, rng, 80, sigma_px)
        matrices = random_covariances(rng, 80, 0.02)
        drawn_m = sigma_px * rng.normal(size=(80, 3))
        world = view.points_world + np.einsum("nij,nj->ni", np.linalg.cholesky(matrices), drawn_m)
        weighted_view = replace(view, points_world=world, point_covariances=six(matrices))
        drawn.append(squared_error(located(refined(weighted_view, truth, LOOSE)), truth))
    squared = np.array(drawn)
    assert 5.2 < squared.mean() < 7.2
    assert (squared < chi2.ppf(0.95, 6)).mean() > 0.9
    assert (squared < chi2.ppf(0.5, 6)).mean() < 0.62


def test_points_count_by_the_noise_of_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half the map noise scales covariances by a quarter; zero makes the points exact."""
    rng = np.random.default_rng(8)
    truth = random_pose(rng)
    view = noisy_view(PINHOLE, truth, rng, 60)
    covariances = six(random_covariances(rng, 60, 0.03))

    def pose(of: View, map_noise: float) -> RigidTransform:
        monkeypatch.setattr(module, "_MAP_NOISE", map_noise)
        return located(refined(of, truth)).cam_from_world

    known = replace(view, point_covariances=covariances)
    quarter = replace(view, point_covariances=covariances / 4)
    assert pose(known, 0.5) == pose(quarter, 1.0) != pose(known, 1.0)
    assert pose(known, 0.0) == pose(view, 1.0)
    # rig_pose passes covariances on
    plain, weighted = (located(rig_pose([each])).cam_from_world for each in (view, known))
    assert plain != weighted


def test_an_unknown_covariance_means_an_exact_point() -> None:
    rng = np.random.default_rng(5)
    truth = random_pose(rng)
    view = noisy_view(PINHOLE, truth, rng, 60)

    def pose(covariances: Array | None) -> Pose:
        return located(refined(replace(view, point_covariances=covariances), truth))

    plain = pose(None)
    for unknown in (np.nan, np.inf, 0.0):
        same = pose(np.full((60, 6), unknown))
        assert same.cam_from_world == plain.cam_from_world
        np.testing.assert_array_equal(same.covariance, plain.covariance)
    mixed = np.zeros((60, 6))
    mixed[:, [0, 3, 5]] = 1e-3
    mixed[::2] = np.nan
    first, second = pose(mixed), pose(np.nan_to_num(mixed))
    assert first.cam_from_world == second.cam_from_world != plain.cam_from_world


def test_inliers_are_counted_in_pixels() -> None:
    rng = np.random.default_rng(6)
    truth = random_pose(rng)
    view = noisy_view(PINHOLE, truth, rng, 80)
    view.points_px[:5] += 20.0
    vague = np.zeros((80, 6))
    vague[:, [0, 3, 5]] = 0.05
    pose = located(refined(replace(view, point_covariances=vague), truth))
    seen = project(PINHOLE, pose.cam_from_world, view.points_world)
    errors = np.linalg.norm(seen - view.points_px, axis=1)
    np.testing.assert_array_equal(pose.inliers, errors <= 12.0)
    assert pose.num_inliers == 75


def test_an_unstable_pose_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """All points lie within millimetres of a line: the camera can nearly rotate about it."""
    rng = np.random.default_rng(8)
    truth = random_pose(rng)
    along = rng.uniform(-2, 2, (30, 1)) * np.array([0.8, 0.3, 0.5])
    in_cam = np.array([0.2, -0.3, 6.0]) + along + 0.003 * rng.normal(size=(30, 3))
    world = truth.inverse().apply(in_cam)
    pixels = px_from_cam(PINHOLE, in_cam) + rng.normal(size=(30, 2))
    view = View(PINHOLE, AT_ORIGIN, pixels, world)
    result = refined(view, truth)
    assert isinstance(result, Failure)
    assert "unstable" in result.reason
    assert result.num_matches == result.num_inliers == 30
    monkeypatch.setattr(module, "_MAX_CENTER_DEVIATION", 1e9)
    pose = located(refined(view, truth))
    assert pose.covariance is not None
    # the criterion: the centre's deviation over the median depth, in any unit
    deviation = np.sqrt(np.linalg.eigvalsh(pose.covariance[3:, 3:])[-1])
    depth = np.median(pose.cam_from_world.apply(world)[:, 2])
    for unit in (1.0, 1e-3, 1e3):
        scaled = replace(view, points_world=unit * world)
        for factor, stable in ((0.99, False), (1.01, True)):
            monkeypatch.setattr(module, "_MAX_CENTER_DEVIATION", factor * deviation / depth)
            assert bool(refined(scaled, in_unit(truth, unit))) == stable


def test_too_few_inliers_after_refinement_are_a_failure() -> None:
    rng = np.random.default_rng(9)
    truth = random_pose(rng)
    view = noisy_view(PINHOLE, truth, rng, 20)
    view.points_px[:9] += 30.0
    result = refined(view, truth)
    assert isinstance(result, Failure)
    assert "11 of 20 2D-3D matches agree" in result.reason
    assert (result.num_matches, result.num_inliers) == (20, 11)
