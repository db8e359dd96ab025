"""Fit, covariance and acceptance of poses found by rendering."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import project
from megloc_kapture.refinement.acceptance import (
    compare_poses,
    correlation,
    covariance,
    perturbed_starts,
    squared_distance,
    whitened_directions,
)
from megloc_kapture.refinement.photometric import LevelProblem, minimise, perturbed
from megloc_kapture.refinement.pyramid import Level
from megloc_kapture.values import RigidTransform

Problems = Callable[..., tuple[LevelProblem, RigidTransform]]
# by about thirty pixels: some points leave the image
AWAY = np.array([0.06, -0.06, 0.01, 0.02, -0.01, 0.02])
Array = NDArray[np.float64]


def test_costs_and_significance_are_those_of_a_plain_loop(problem: Problems) -> None:
    aligned, truth = problem(count=3000, noise=0.3, wrong=0.1)
    old = perturbed(truth, AWAY)
    comparison = compare_poses(aligned, old, truth)
    rows, scale2 = [], 0.0
    for pose in (old, truth):
        at = aligned.nuisance_at(pose)
        rows.append(aligned.rows(at)[:, 0, 0])
        scale2 = (2.0 * at.deviation) ** 2
    px = project(aligned.camera, truth, aligned.chosen.points)
    gained: dict[tuple[float, float], float] = {}
    costs, count = [0.0, 0.0], 0
    for before, after, (x, y) in zip(*rows, px, strict=True):
        if np.isnan(before) or np.isnan(after):
            continue
        losses = [0.5 * r * r / (scale2 + r * r) for r in (before, after)]
        costs = [cost + loss for cost, loss in zip(costs, losses, strict=True)]
        count += 1
        cell = (x // 64, y // 64)  # ten along the longer side of 640 px
        gained[cell] = gained.get(cell, 0.0) + losses[0] - losses[1]
    assert comparison.after.count == comparison.before.count == count < 3000
    assert comparison.before.cost == pytest.approx(costs[0] / count, rel=1e-9)
    assert comparison.after.cost == pytest.approx(costs[1] / count, rel=1e-9)
    sums = np.array(list(gained.values()))
    expected = sums.sum() / np.sqrt((sums**2).sum())
    assert comparison.significance == pytest.approx(expected, rel=1e-9)
    assert expected > 4


def test_a_pose_tuned_to_noise_is_not_significant(problem: Problems) -> None:
    found = []
    for seed in range(20):
        aligned, truth = problem(count=3000, noise=0.3, seed=seed)
        tuned = minimise(aligned, aligned.nuisance_at(truth), last_step_px=1e-3)
        comparison = compare_poses(aligned, truth, tuned.cam_from_world)
        assert comparison.after.cost < comparison.before.cost
        found.append(comparison.significance)
    # six parameters tuned to noise gain half of chi-squared / sqrt(chi-squared): about 1.2
    assert 0.6 < np.mean(found) < 1.8


def test_correlation_is_that_of_numpy_about_each_references_mean(problem: Problems) -> None:
    aligned, truth = problem(channels=1, count=500, noise=0.5)
    at = aligned.nuisance_at(truth)
    query, groups = aligned.rows(at)[:, 0, 7], aligned.chosen.groups
    reference = aligned.chosen.values[:, 0].copy()
    query = query.copy()
    for group in (0, 1):
        query[groups == group] -= query[groups == group].mean()
        reference[groups == group] -= reference[groups == group].mean()
    expected = np.corrcoef(query, reference)[0, 1]
    assert correlation(aligned, at) == pytest.approx(expected, rel=1e-9)
    assert 0.5 < expected < 0.99


def error_vector(found: RigidTransform, truth: RigidTransform) -> Array:
    true_from_found = truth @ found.inverse()
    vector = Rotation.from_matrix(true_from_found.rotation_matrix()).as_rotvec()
    return np.concatenate([vector, true_from_found.translation])


def test_covariance_is_that_of_the_errors(problem: Problems) -> None:
    errors, claimed = [], []
    for seed in range(60):
        aligned, truth = problem(count=3000, noise=0.3, seed=seed)
        found = minimise(aligned, aligned.nuisance_at(truth), last_step_px=1e-3)
        claim = covariance(aligned, found)
        assert claim is not None
        np.testing.assert_allclose(claim, claim.T)
        vector = error_vector(found.cam_from_world, truth)
        errors.append(vector @ np.linalg.solve(claim, vector) / 6)
        claimed.append(np.sqrt(np.diagonal(claim)))
    # one where it is right; a few dozen cells estimate a covariance itself only roughly
    assert 0.6 < np.mean(errors) < 2.0
    assert np.min(claimed) > 0 and np.max(claimed) < 0.02


def test_a_flat_query_determines_nothing(problem: Problems) -> None:
    aligned, truth = problem()
    flat = Level(np.ones_like(aligned.level.values), aligned.level.valid, 0.25, 0.25)
    empty = LevelProblem(aligned.chosen, flat, aligned.camera, truth)
    assert covariance(empty, empty.nuisance_at(truth)) is None


def test_even_steps_change_the_image_alike(problem: Problems) -> None:
    aligned, truth = problem(noise=0.2)
    at = aligned.nuisance_at(truth)
    system = aligned.system_at(at, at.squared_scale)
    found, reduced = whitened_directions(aligned, system), system.reduced()
    assert found is not None and reduced is not None
    steps, change = found
    np.testing.assert_allclose(steps.T @ reduced[0] @ steps, change * np.eye(6), atol=1e-8 * change)
    # the image says least of the first: it is the longest
    lengths = np.linalg.norm(steps * aligned.px_per_step()[:, None], axis=0)
    assert (np.diff(lengths) < 0).all()


def test_alignments_beside_one_come_by_their_cost(problem: Problems) -> None:
    aligned, truth = problem(noise=0.2)
    at = aligned.nuisance_at(truth)
    found = perturbed_starts(aligned, at)
    costs = [aligned.system_at(each, at.squared_scale).mean_cost for each in found]
    assert len(found) == 24 and costs == sorted(costs)
    assert costs[0] > aligned.system_at(at, at.squared_scale).mean_cost


def test_there_is_nothing_beside_what_a_flat_query_says(problem: Problems) -> None:
    aligned, truth = problem()
    flat = Level(np.ones_like(aligned.level.values), aligned.level.valid, 0.25, 0.25)
    empty = LevelProblem(aligned.chosen, flat, aligned.camera, truth)
    assert perturbed_starts(empty, empty.nuisance_at(truth)) == []


def test_squared_distance_is_that_of_the_step_between_the_poses() -> None:
    rng = np.random.default_rng(0)
    new = RigidTransform.from_matrix(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    root = rng.normal(size=(6, 6))
    covariance = root @ root.T
    step = 1e-4 * rng.normal(size=6)
    expected = step @ np.linalg.solve(covariance, step)
    found = squared_distance(perturbed(new, step), new, covariance)
    assert found == pytest.approx(expected, rel=1e-6)
    assert squared_distance(new, new, covariance) == pytest.approx(0.0, abs=1e-20)
