"""Directions of a pose that the image tells alike, and alignments beside one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from megloc_kapture.refinement.photometric import LevelProblem
from megloc_kapture.refinement.photometric_directions import beside, even_steps
from megloc_kapture.refinement.photometric_pyramid import Level
from megloc_kapture.values import RigidTransform

Problems = Callable[..., tuple[LevelProblem, RigidTransform]]


def test_even_steps_change_the_image_alike(problem: Problems) -> None:
    aligned, truth = problem(noise=0.2)
    at = aligned.nuisance_at(truth)
    system = aligned.system_at(at, at.squared_scale)
    found, reduced = even_steps(aligned, system), system.reduced()
    assert found is not None and reduced is not None
    steps, change = found
    np.testing.assert_allclose(steps.T @ reduced[0] @ steps, change * np.eye(6), atol=1e-8 * change)
    # the image says least of the first: it is the longest
    lengths = np.linalg.norm(steps * aligned.px_per_step()[:, None], axis=0)
    assert (np.diff(lengths) < 0).all()


def test_alignments_beside_one_come_by_their_cost(problem: Problems) -> None:
    aligned, truth = problem(noise=0.2)
    at = aligned.nuisance_at(truth)
    found = beside(aligned, at)
    costs = [aligned.system_at(each, at.squared_scale).mean_cost for each in found]
    assert len(found) == 24 and costs == sorted(costs)
    assert costs[0] > aligned.system_at(at, at.squared_scale).mean_cost


def test_there_is_nothing_beside_what_a_flat_query_says(problem: Problems) -> None:
    aligned, truth = problem()
    flat = Level(np.ones_like(aligned.level.values), aligned.level.valid, 0.25, 0.25)
    empty = LevelProblem(aligned.chosen, flat, aligned.camera, truth)
    assert beside(empty, empty.nuisance_at(truth)) == []
