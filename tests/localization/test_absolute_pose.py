"""The pose of a camera or a rig: exact matches, outliers, refinement, covariance and failures."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import poselib
import pycolmap
import pytest
from camera_models import CAMERAS, CX, CY, PINHOLE, STRONG, F
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from poses import error_vector, located, random_pose, rigid
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from megloc_kapture.geometry.cameras import bearing_rays, focal_px, project, px_from_cam
from megloc_kapture.geometry.poses import cross_matrix, movement, perturbed
from megloc_kapture.io.colmap import colmap_camera, new_colmap_pose
from megloc_kapture.localization import absolute_pose as module
from megloc_kapture.localization.absolute_pose import (
    AbsolutePoseOptions,
    PoseEstimate,
    absolute_pose,
    center_deviation,
    estimate_pose,
    pose_covariance,
    refine_pose,
    rig_pose,
)
from megloc_kapture.localization.map_index import PoseProblem, View
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform

Array = NDArray[np.float64]


def scene(
    camera: Camera, pose: RigidTransform, rng: np.random.Generator, count: int = 100
) -> tuple[Array, Array]:
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


DIRECTIONS = np.random.default_rng(0).normal(size=(40, 6))
MATRIX = DIRECTIONS.T @ DIRECTIONS


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_in_any_unit_the_covariance_is_the_inverse_or_none_if_degenerate(unit: float) -> None:
    scale = np.diag([1.0, 1.0, 1.0, unit, unit, unit])
    # a few exact matches do not prove a zero variance
    for variance, expected in ((4.0, 4.0), (1e-12, 0.01)):
        result = pose_covariance(scale @ MATRIX @ scale, variance)
        assert result is not None
        inverse = expected * np.linalg.inv(MATRIX)
        np.testing.assert_allclose(scale @ result @ scale, inverse, rtol=1e-8)
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
    refined = pycolmap.estimate_and_refine_absolute_pose(
        pixels, world, colmap_camera(camera), options, refinement, return_covariance=True
    )
    assert refined is not None
    # COLMAP's rotation is half of the angle, and does not act on its translation:
    # exp(r, v) x = R(r) x + v, so the translation changes by v + r x t
    cross = cross_matrix(np.array(pose.translation))
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
    ("count", "seed", "shift", "within"), [(30, 0, 0, 1e-7), (30, 0, 4.5e6, 1e-5), (4, 1, 0, 1e-7)]
)
def test_exact_matches_of_a_rig_give_the_exact_pose(
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


def colmaps(views: list[View]) -> RigidTransform:
    ransac = pycolmap.RANSACOptions()
    ransac.max_error = 12.0
    ransac.random_seed = 0
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.gradient_tolerance = 1e-8
    result = pycolmap.estimate_and_refine_generalized_absolute_pose(
        np.concatenate([view.points_px for view in views]),
        np.concatenate([view.points_world for view in views]),
        np.repeat(np.arange(len(views)), [len(view.points_px) for view in views]).tolist(),
        [new_colmap_pose(view.cam_from_rig) for view in views],
        list(map(colmap_camera, RIG_CAMERAS)),
        ransac,
        refinement,
    )
    assert result is not None
    matrix = result["rig_from_world"].matrix()
    return RigidTransform.from_matrix(matrix[:, :3], matrix[:, 3])


def residuals(views: list[View], rig_from_world: RigidTransform) -> Array:
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
    pixels, world = scene(camera, pose, rng, count)
    return View(camera, AT_ORIGIN, pixels + sigma * rng.normal(size=(count, 2)), world)


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
