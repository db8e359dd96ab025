"""How two poses compare: costs on the points that both see, and by how much that is chance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from megloc_kapture.geometry.cameras import project
from megloc_kapture.refinement.photometric import LevelProblem, perturbed
from megloc_kapture.refinement.photometric_fit import compared, correlation
from megloc_kapture.refinement.photometric_minimum import minimised
from megloc_kapture.values import RigidTransform

Problems = Callable[..., tuple[LevelProblem, RigidTransform]]
# by about thirty pixels: some points leave the image
AWAY = np.array([0.06, -0.06, 0.01, 0.02, -0.01, 0.02])


def test_costs_and_significance_are_those_of_a_plain_loop(problem: Problems) -> None:
    aligned, truth = problem(count=3000, noise=0.3, wrong=0.1)
    old = perturbed(truth, AWAY)
    comparison = compared(aligned, old, truth)
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
        tuned = minimised(aligned, aligned.nuisance_at(truth), last_step_px=1e-3)
        comparison = compared(aligned, truth, tuned.cam_from_world)
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
