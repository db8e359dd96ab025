"""Wrong focal lengths are detected, unknown ones are estimated."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from poses import rigid
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import project, px_from_cam
from megloc_kapture.io.images import guessed_camera
from megloc_kapture.localization.absolute_pose import (
    AbsolutePoseOptions,
    PoseEstimate,
    center_deviation,
    match_errors,
    rig_pose,
)
from megloc_kapture.localization.focal_length import (
    _linearized,
    estimate_with_intrinsics,
    focal_misfit,
    misfits_text,
    refine_with_intrinsics,
    solve_with_shared_camera,
)
from megloc_kapture.localization.map_index import PoseProblem, View
from megloc_kapture.values import (
    Camera,
    Failure,
    LocalizationResult,
    Pose,
    PoseRefinement,
    RigidTransform,
)

Floats = NDArray[np.float64]
ALONE = RigidTransform.identity()
OPTIONS = AbsolutePoseOptions()


def seen_by(
    camera: Camera, *, seed: int = 0, noise_px: float = 1.0
) -> tuple[Floats, Floats, RigidTransform]:
    """Return pixels and points of a facade 10 m away, a quarter of them wrong, and the pose."""
    rng = np.random.default_rng(seed)
    pose = rigid(np.radians([5, 20, 2]), [0.3, -0.2, 0.5])
    points = rng.uniform((-5, -4, 8.0), (5, 4, 12.0), (400, 3))
    pixels = project(camera, pose, points) + rng.normal(0, noise_px, (400, 2))
    pixels[:100] = rng.uniform((0, 0), (camera.width, camera.height), (100, 2))
    return pixels, points, pose


def misfit(factor: float, *, noise_px: float = 1.0, seed: int = 0) -> tuple[str, float] | None:
    pixels, points, _ = seen_by(Camera.pinhole(1600, 1200, 1400.0), seed=seed, noise_px=noise_px)
    view = View(Camera.pinhole(1600, 1200, 1400.0 * factor), ALONE, pixels, points)
    result = rig_pose([view])
    assert isinstance(result, Pose)
    return focal_misfit(PoseProblem.of([view]), result, OPTIONS)


# the pose columns ignore the distortion
@pytest.mark.parametrize(("distortion", "compared"), [((), slice(0, 9)), ((0.1,), slice(6, 10))])
def test_derivatives_of_a_freed_camera_equal_central_differences(
    distortion: tuple[float, ...], compared: slice
) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -2, 3), (2, 2, 8), (30, 3))
    rays, change = rng.uniform(-0.5, 0.5, (30, 2)), np.array([0.05, 0.01, -0.02, *distortion])

    def residuals(step: Floats) -> Floats:
        moved = Rotation.from_rotvec(step[:3]).apply(points) + step[3:6]
        return _linearized(rays, moved, change + step[6:])[0]

    steps = 1e-6 * np.eye(6 + len(change))
    expected = np.stack([(residuals(s) - residuals(-s)) / 2e-6 for s in steps], axis=2)
    actual = _linearized(rays, points, change)[1]
    np.testing.assert_allclose(actual[..., compared], expected[..., compared], atol=1e-8)


@pytest.mark.parametrize("factor", [0.5, 1.05, 10.0])
def test_a_wrong_focal_length_is_detected(factor: float) -> None:
    result = misfit(factor)
    assert result is not None
    remark, shift = result
    numbers = re.fullmatch(
        r"the focal length of (\d+) px does not fit: (\d+) \+- (\d+) px would", remark
    )
    assert numbers is not None
    given, better, deviation = map(int, numbers.groups())
    assert given == round(1400 * factor)
    assert better == pytest.approx(1400, rel=0.03)
    assert abs(better - 1400) <= 3 * deviation
    # the camera is 10 m away: too near or too far by the same factor
    assert shift == pytest.approx(abs(factor - 1), rel=0.25, abs=0.02)
    results = [LocalizationResult(remarks=remarks) for remarks in (("no image", remark), ())]
    assert "in 2 queries" in misfits_text([results[0], *results], "status.csv")


@pytest.mark.parametrize("noise_px", [0.3, 3.0])
def test_a_right_focal_length_has_no_misfit(noise_px: float) -> None:
    assert misfit(1.0, seed=0, noise_px=noise_px) is None
    assert misfit(1.01, seed=1, noise_px=noise_px) is None


def straight_on() -> tuple[Floats, Floats]:
    """Return pixels and points of a wall 10 m away; the focal length is 1400 px."""
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-4, 4, (200, 2)), np.full(200, 10.0)]
    pixels = project(Camera.pinhole(1600, 1200, 1400.0), ALONE, points)
    return pixels + rng.normal(0, 1, (200, 2)), points


def test_no_misfit_of_a_wall_seen_straight_on() -> None:
    view = View(Camera.pinhole(1600, 1200, 1700.0), ALONE, *straight_on())
    pose = Pose(RigidTransform(ALONE.quat_wxyz, (0.0, 0.0, 2.14)), 200, 200, np.ones(200, bool))
    assert focal_misfit(PoseProblem.of([view]), pose, OPTIONS) is None


def solved(camera: Camera, pixels: Floats, points: Floats) -> Pose | Failure:
    problem = PoseProblem.of([View(camera, ALONE, pixels, points)])
    problem, estimate = estimate_with_intrinsics(problem, OPTIONS)
    assert isinstance(estimate, PoseEstimate)
    problem, result = refine_with_intrinsics(problem, estimate, OPTIONS, camera)
    if isinstance(result, Pose) and result.camera:
        # the returned problem has the estimated camera
        assert problem.views[0].camera.params == result.camera.params
        assert result.inliers is not None
        errors, _ = match_errors(problem, result.cam_from_world)
        assert ((errors <= OPTIONS.max_error_px) == result.inliers).all()
    return result


@pytest.mark.parametrize(("given_px", "deviation"), [(980, 0.1), (1920, 0.7)])
def test_an_uncertain_camera_is_estimated(given_px: float, deviation: float) -> None:
    true = Camera("SIMPLE_RADIAL", 1600, 1200, (1400.0, 806.0, 595.0, -0.03))
    pixels, points, pose = seen_by(true)
    given = Camera("SIMPLE_RADIAL", 1600, 1200, (given_px, 800.0, 600.0, 0.0), deviation)
    result = solved(given, pixels, points)
    assert isinstance(result, Pose) and result.camera is not None
    off = result.camera.params[0] / 1400 - 1
    assert abs(off) < min(0.01, 3 * result.camera.focal_deviation)
    assert abs(result.camera.params[3] + 0.03) < 0.01
    assert np.linalg.norm(result.cam_from_world.center() - pose.center()) < 0.06


@pytest.mark.parametrize("exif_px", [350.0, 90000.0])
def test_a_wrong_focal_length_of_exif_is_corrected(exif_px: float) -> None:
    pixels, points, pose = seen_by(Camera.pinhole(1600, 1200, 1400.0))
    given = replace(guessed_camera(1600, 1200), focal_deviation=0.1)
    result = solved(replace(given, params=(exif_px, *given.params[1:])), pixels, points)
    assert isinstance(result, Pose) and result.camera is not None
    assert result.camera.params[0] == pytest.approx(1400, rel=0.02)
    assert np.linalg.norm(result.cam_from_world.center() - pose.center()) < 0.1
    # an estimate from several images is kept
    known = replace(given, params=(1500.0, *given.params[1:]), focal_deviation=0.005)
    result = solved(known, pixels, points)
    assert isinstance(result, Pose) and result.camera is not None
    assert result.camera.params[0] > 1430


@pytest.mark.parametrize("focal_px", [500.0, 5000.0])
def test_very_short_and_very_long_lenses(focal_px: float) -> None:
    """The guess is 1920 px."""
    rng = np.random.default_rng(1)
    true = Camera.pinhole(1600, 1200, focal_px)
    half = 600 / focal_px
    rays = rng.uniform((-half, -half, 1), (half, half, 1), (300, 3))
    points = rays * rng.uniform(6, 14, (300, 1))
    pixels = project(true, ALONE, points) + rng.normal(0, 0.5, (300, 2))
    result = solved(guessed_camera(1600, 1200), pixels, points)
    assert isinstance(result, Pose) and result.camera is not None
    assert result.camera.params[0] == pytest.approx(focal_px, rel=0.02)


def test_a_wall_seen_straight_on_keeps_the_known_focal_length() -> None:
    pixels, points = straight_on()
    known = Camera("SIMPLE_RADIAL", 1600, 1200, (1500.0, 800.0, 600.0, 0.0), 0.1)
    result = solved(known, pixels, points)
    assert isinstance(result, Pose) and result.camera is not None
    assert 0.05 < result.camera.focal_deviation <= 0.1
    assert result.covariance is not None
    # the focal length's uncertainty is the distance's
    deviation = 10.0 * result.camera.focal_deviation
    assert center_deviation(result.covariance) == pytest.approx(deviation, rel=0.3)
    unknown = solved(replace(known, focal_deviation=0.7), pixels, points)
    assert isinstance(unknown, Failure) and "unstable" in unknown.reason


TRUE = Camera("SIMPLE_RADIAL", 1536, 1024, (1380.0, 768.0, 512.0, 0.0))


def photograph(seed: int, focal: float, deviation: float) -> tuple[Pose, RigidTransform]:
    """Return a pose with its estimate of the camera, and the true pose."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-6, -4, 9), (6, 4, 12), (300, 3))
    true = rigid(rng.uniform(-0.05, 0.05, 3), rng.uniform(-0.5, 0.5, 3))
    px = px_from_cam(TRUE, true.apply(points)) + rng.normal(0, 1.0, (300, 2))
    camera = replace(TRUE, params=(focal, 768.0, 512.0, 0.0), focal_deviation=deviation)
    # nearer or farther by the error of the focal length
    away = 10.5 * (focal / 1380 - 1)
    pose = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, away)) @ true
    return Pose(
        pose, 300, 300, camera=camera, inlier_points_px=px, inlier_points_world=points
    ), true


def test_a_shared_camera_improves_the_poses() -> None:
    estimates = ((1310.0, 0.05), (1372.0, 0.006), (1385.0, 0.006), (1420.0, 0.03), (1384.0, 0.005))
    alone = [photograph(seed, *estimate) for seed, estimate in enumerate(estimates)]
    solved = solve_with_shared_camera([pose for pose, _ in alone], OPTIONS)
    before, after = (
        [float(np.linalg.norm(p.cam_from_world.center() - true.center())) for p, true in pairs]
        for pairs in (alone, list(zip(solved, (true for _, true in alone), strict=True)))
    )
    assert max(after) < 0.3 * max(before) and np.median(after) <= np.median(before)
    for pose in solved:
        assert pose.camera is not None and abs(pose.camera.params[0] / 1380 - 1) < 0.008
        assert "5 photographs" in pose.remarks[-1]


def test_another_zoom_and_a_refined_pose_stay() -> None:
    poses = [photograph(seed, focal, 0.005)[0] for seed, focal in enumerate((1378, 1383, 1900))]
    poses.append(replace(poses[1], refinements=(PoseRefinement(poses[1].cam_from_world),)))
    solved = solve_with_shared_camera(poses, OPTIONS)
    assert solved[2] is poses[2] and solved[3] is poses[3]
    assert solved[0].camera != poses[0].camera
    for few in ([], poses[:1]):
        assert solve_with_shared_camera(few, OPTIONS) == few
