"""Photometric alignment: derivatives, steps, covariance and acceptance of poses."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from camera_models import CAMERAS
from numpy.typing import NDArray
from poses import displaced, error_vector, random_pose
from scipy.ndimage import map_coordinates

from megloc_kapture.geometry.cameras import bearing_rays, project
from megloc_kapture.geometry.poses import perturbed
from megloc_kapture.plugins import PoseRefinement
from megloc_kapture.refinement import acceptance
from megloc_kapture.refinement.acceptance import (
    Candidate,
    RenderingOptions,
    accept_or_keep,
    compare_poses,
    correlation,
    covariance,
    perturbed_starts,
    squared_distance,
    whitened_directions,
)
from megloc_kapture.refinement.photometric import (
    Alignment,
    LevelProblem,
    minimise,
    unoccluded_points,
)
from megloc_kapture.refinement.pyramid import ChosenPoints, Level
from megloc_kapture.values import Camera, RigidTransform

Array = NDArray[np.float64]
WIDTH, HEIGHT = 160, 120


def texture(rng: np.random.Generator, channels: int, deviation_px: float = 1.5) -> Array:
    noise = rng.normal(size=(HEIGHT, WIDTH, channels))
    smooth = cv2.GaussianBlur(noise, (0, 0), deviation_px).reshape(noise.shape)
    return np.asarray(smooth / smooth.std())


def problem(
    model: str = "PINHOLE",
    *,
    channels: int = 1,
    count: int = 400,
    noise: float = 0.0,
    wrong: float = 0.0,
    seed: int = 0,
) -> tuple[LevelProblem, RigidTransform]:
    """Return points with the query's values at the true pose, up to gain and bias."""
    rng = np.random.default_rng(seed)
    camera, pose = CAMERAS[model], random_pose(rng)
    image = texture(rng, channels)
    px = rng.uniform((20, 20), (camera.width - 20, camera.height - 20), (count, 2))
    points = pose.inverse().apply(bearing_rays(camera, px) * rng.uniform(2.0, 9.0, (count, 1)))
    scale = WIDTH / camera.width
    # float32 like the level
    at = (scale * px.T - 0.5)[::-1]
    levels = np.moveaxis(image.astype(np.float32).astype(float), 2, 0)
    values = np.stack([map_coordinates(level, at, order=1) for level in levels], axis=1)
    groups = rng.integers(0, 2, count)
    values = np.array([0.7, 1.3])[groups, None] * values + np.array([0.2, -0.4])[groups, None]
    outliers = rng.random(count) < wrong
    values[outliers] += rng.normal(size=(outliers.sum(), channels)) * 3
    # a level's noise is blurred like the level
    query = (image + noise * texture(rng, channels, 0.8)).astype(np.float32)
    level = Level(query, np.ones((HEIGHT, WIDTH), bool), scale, scale)
    chosen = ChosenPoints(points, values, groups)
    return LevelProblem(chosen, level, camera, pose), pose


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_derivatives_equal_differences(model: str) -> None:
    aligned, truth = problem(model, channels=2)
    pose = displaced(truth, 3, 0.02, 0.3)
    gains, biases = np.array([[0.8, 1.1], [1.4, 0.9]]), np.array([[0.1, 0.0], [0.3, -0.2]])
    rows = aligned.rows(Alignment(pose, gains, biases, 1.0))
    # bilinear interpolation has kinks at the pixels' centres
    px = project(aligned.camera, pose, aligned.chosen.points) * aligned.level.scale_x - 0.5
    clear = (np.abs(px - np.round(px)) > 1e-3).all(1) & ~np.isnan(rows[:, 0, 0])
    assert clear.sum() > 300
    for i in range(6):
        step = np.zeros(6)
        step[i] = 1e-6
        above = aligned.rows(Alignment(perturbed(pose, step), gains, biases, 1.0))[..., 0]
        below = aligned.rows(Alignment(perturbed(pose, -step), gains, biases, 1.0))[..., 0]
        size = np.abs(rows[clear, :, 1 + i]).max()
        difference = (above - below)[clear] / 2e-6 - rows[clear, :, 1 + i]
        assert np.abs(difference).max() < 1e-6 * size


def test_points_beyond_the_fold_of_a_lens_are_not_visible() -> None:
    # r (1 - 0.3 r^2) is largest at r = 1.05 and zero again at r = 1.83
    camera = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.3))
    chosen = ChosenPoints(
        np.array([[1.8, 0.0, 1.0], [0.1, 0.0, 1.0]]), np.zeros((2, 1)), np.zeros(2, np.int64)
    )
    level = Level(np.ones((480, 640, 1), np.float32), np.ones((480, 640), bool), 1.0, 1.0)
    aligned = LevelProblem(chosen, level, camera, RigidTransform.identity())
    at = Alignment(RigidTransform.identity(), np.ones((1, 1)), np.zeros((1, 1)), 1.0)
    rows = aligned.rows(at)
    np.testing.assert_array_equal(np.isnan(rows[:, 0, 0]), [True, False])


def test_a_step_solves_the_whole_system() -> None:
    aligned, truth = problem(channels=2, wrong=0.1)
    at = aligned.nuisance_at(perturbed(truth, np.array([2e-3, -2e-3, 1e-3, 0.01, -0.01, 0.015])))
    rows = aligned.rows(at)
    seen = ~np.isnan(rows[:, 0, 0])
    rows, groups = rows[seen], aligned.chosen.groups[seen]
    scale2 = 4.0 * at.deviation**2
    weights = (1 + (rows[..., 0] ** 2).mean(1) / scale2) ** -2 / 2
    # unknowns: the pose, then gain and bias of reference 0 channel 0, of reference 0 channel 1 ...
    jacobian = np.zeros((len(rows), 2, 6 + 8))
    jacobian[..., :6] = rows[..., 1:7]
    for c in range(2):
        first = 6 + 2 * (2 * groups + c)
        jacobian[np.arange(len(rows)), c, first] = rows[:, c, 7]
        jacobian[np.arange(len(rows)), c, first + 1] = 1
    matrix = np.einsum("n,nci,ncj->ij", weights, jacobian, jacobian)
    gradient = np.einsum("n,nci,nc->i", weights, jacobian, rows[..., 0])
    expected = np.linalg.solve(matrix, -gradient)
    step = aligned.system_at(at, scale2).step(0.0)
    assert step is not None
    pose_step, gains, biases = step
    np.testing.assert_allclose(pose_step, expected[:6], rtol=1e-5)
    gains_and_biases = np.stack([gains, biases], axis=-1).ravel()
    np.testing.assert_allclose(gains_and_biases, expected[6:], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("channels", [1, 3])
def test_pose_gains_and_biases_are_estimated_among_outliers(channels: int) -> None:
    aligned, truth = problem("OPENCV", channels=channels, count=1500, wrong=0.3)
    start = perturbed(truth, np.array([1e-3, -1e-3, 1e-3, 0.006, -0.005, 0.006]))
    result = minimise(aligned, aligned.nuisance_at(start), last_step_px=1e-4)
    assert np.abs(error_vector(result.cam_from_world, truth)).max() < 1e-4
    np.testing.assert_allclose(result.gains, [[0.7] * channels, [1.3] * channels], atol=1e-3)
    np.testing.assert_allclose(result.biases, [[0.2] * channels, [-0.4] * channels], atol=1e-3)


def test_occluded_points_are_left_out() -> None:
    aligned, truth = problem(count=6000, noise=0.2)
    other, _ = problem(count=1, seed=9)
    values = aligned.level.values.copy()
    values[:, :80] = other.level.values[:, :80]
    level = replace(aligned.level, values=values)
    hidden = LevelProblem(aligned.chosen, level, aligned.camera, truth)
    keep = unoccluded_points(hidden, hidden.nuisance_at(truth))
    behind = project(aligned.camera, truth, aligned.chosen.points)[:, 0] < 320
    assert keep[behind].mean() < 0.1
    assert keep[~behind].mean() > 0.95
    assert unoccluded_points(aligned, aligned.nuisance_at(truth)).all()
    # invisible points are kept
    away = perturbed(truth, np.array([np.pi, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert unoccluded_points(aligned, aligned.nuisance_at(away)).all()


# thirty pixels: some points leave the image
AWAY = np.array([0.06, -0.06, 0.01, 0.02, -0.01, 0.02])


def test_costs_and_significance_are_sums_over_points_and_cells() -> None:
    aligned, truth = problem(count=3000, noise=0.3, wrong=0.1)
    assert len(aligned.thinned(100).chosen.points) <= 100
    old = perturbed(truth, AWAY)
    comparison = compare_poses(aligned, old, truth)
    at = [aligned.nuisance_at(pose) for pose in (old, truth)]
    residuals = np.stack([aligned.rows(each)[:, 0, 0] for each in at])
    seen = ~np.isnan(residuals).any(axis=0)
    squared = residuals[:, seen] ** 2
    losses = 0.5 * squared / ((2.0 * at[1].deviation) ** 2 + squared)
    assert comparison["points"] == seen.sum() < 3000
    assert comparison["cost_before"] == pytest.approx(losses[0].mean(), rel=1e-9)
    assert comparison["cost_after"] == pytest.approx(losses[1].mean(), rel=1e-9)
    # ten cells along the longer side of 640 px
    cells = project(aligned.camera, truth, aligned.chosen.points)[seen] // 64
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    sums = np.bincount(cell.ravel(), losses[0] - losses[1])
    expected = sums.sum() / np.sqrt((sums**2).sum())
    assert comparison["significance"] == pytest.approx(expected, rel=1e-9)
    assert expected > 4


def test_the_correlation_is_about_each_references_mean() -> None:
    aligned, truth = problem(channels=1, count=500, noise=0.5)
    at = aligned.nuisance_at(truth)
    query, groups = aligned.rows(at)[:, 0, 7], aligned.chosen.groups
    reference = aligned.chosen.values[:, 0].copy()
    query = query.copy()
    for group in (0, 1):
        query[groups == group] -= query[groups == group].mean()
        reference[groups == group] -= reference[groups == group].mean()
    expected = np.corrcoef(query, reference)[0, 1]
    assert correlation(aligned, aligned.rows(at)) == pytest.approx(expected, rel=1e-9)
    assert 0.5 < expected < 0.99


def test_the_covariance_predicts_errors_and_noise_is_not_significant() -> None:
    errors, claimed, significance = [], [], []
    for seed in range(8):
        aligned, truth = problem(count=3000, noise=0.3, seed=seed)
        result = minimise(aligned, aligned.nuisance_at(truth), last_step_px=1e-3)
        claim = covariance(aligned, result)
        np.testing.assert_allclose(claim, claim.T)
        vector = error_vector(result.cam_from_world, truth)
        errors.append(vector @ np.linalg.solve(claim, vector) / 6)
        claimed.append(np.sqrt(np.diagonal(claim)))
        comparison = compare_poses(aligned, truth, result.cam_from_world)
        assert comparison["cost_after"] < comparison["cost_before"]
        significance.append(comparison["significance"])
    # 1 for the true covariance; a few dozen cells estimate it roughly
    assert 0.6 < np.mean(errors) < 2.0
    assert np.min(claimed) > 0 and np.max(claimed) < 0.02
    # six parameters tuned to noise gain half of chi-squared / sqrt(chi-squared): about 1.2
    assert 0.6 < np.mean(significance) < 1.8


def test_poses_beyond_a_bound_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    aligned, truth = problem(count=3000, noise=0.3)
    start = displaced(truth, 0)
    candidate = Candidate(aligned, aligned, aligned.nuisance_at(truth))

    def result(overlap: float = 0.9, **options: float) -> PoseRefinement:
        chosen = RenderingOptions.model_validate(options)
        return accept_or_keep(start, candidate, (0.9, overlap), chosen)

    assert result().accepted and result().cam_from_world == truth
    for options, reason in (
        ({"max_translation_m": 0.05}, "would move"),
        ({"max_rotation_deg": 1.0}, "would turn"),
    ):
        refused = result(**options)
        assert reason in refused.reason and refused.cam_from_world is start
    for name, bound, reason in (
        ("MIN_CORRELATION", 0.99, "correlation"),
        ("_MIN_SIGNIFICANCE", 1000.0, "standard errors"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(acceptance, name, bound)
            assert reason in result().reason and result().cam_from_world is start
    # the overlap may fall by a tenth
    assert result(overlap=0.82).accepted and "overlap falls" in result(overlap=0.8).reason
    assert result(overlap=0.0, accept_always=True).accepted


def test_a_flat_query_determines_nothing() -> None:
    aligned, truth = problem()
    flat = Level(np.ones_like(aligned.level.values), aligned.level.valid, 0.25, 0.25)
    empty = LevelProblem(aligned.chosen, flat, aligned.camera, truth)
    assert covariance(empty, empty.nuisance_at(truth)) is None
    assert perturbed_starts(empty, empty.nuisance_at(truth)) == []


def test_whitened_steps_change_the_image_equally() -> None:
    aligned, truth = problem(noise=0.2)
    at = aligned.nuisance_at(truth)
    system = aligned.system_at(at, at.squared_scale)
    result, reduced = whitened_directions(aligned, system), system.reduced()
    assert result is not None and reduced is not None
    steps, change = result
    np.testing.assert_allclose(steps.T @ reduced[0] @ steps, change * np.eye(6), atol=1e-8 * change)
    # the image determines the first least: it is the longest
    lengths = np.linalg.norm(steps * aligned.px_per_step()[:, None], axis=0)
    assert (np.diff(lengths) < 0).all()
    # starts near the given alignment are sorted by cost
    starts = perturbed_starts(aligned, at)
    costs = [aligned.system_at(each, at.squared_scale).mean_cost for each in starts]
    assert len(starts) == 24 and costs == sorted(costs)
    assert costs[0] > aligned.system_at(at, at.squared_scale).mean_cost


def test_squared_distance_is_that_of_the_step_between_the_poses() -> None:
    rng = np.random.default_rng(0)
    new, root = random_pose(rng), rng.normal(size=(6, 6))
    covariance = root @ root.T
    step = 1e-4 * rng.normal(size=6)
    expected = step @ np.linalg.solve(covariance, step)
    result = squared_distance(perturbed(new, step), new, covariance)
    assert result == pytest.approx(expected, rel=1e-6)
    assert squared_distance(new, new, covariance) == pytest.approx(0.0, abs=1e-20)
