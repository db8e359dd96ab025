"""Parts of a query that something else hides are told by what does not correlate there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from megloc_kapture.geometry.cameras import project
from megloc_kapture.refinement.photometric import LevelProblem, perturbed
from megloc_kapture.refinement.photometric_occluders import agreeing
from megloc_kapture.values import RigidTransform

Problems = Callable[..., tuple[LevelProblem, RigidTransform]]


def test_points_behind_something_else_are_left_out(problem: Problems) -> None:
    aligned, truth = problem(count=6000, noise=0.2)
    other, _ = problem(count=1, seed=9)
    values = aligned.level.values.copy()
    values[:, :80] = other.level.values[:, :80]
    hidden = LevelProblem(
        aligned.chosen, replace(aligned.level, values=values), aligned.camera, truth
    )
    keep = agreeing(hidden, hidden.nuisance_at(truth))
    behind = project(aligned.camera, truth, aligned.chosen.points)[:, 0] < 320
    assert keep[behind].mean() < 0.1
    assert keep[~behind].mean() > 0.95
    assert agreeing(aligned, aligned.nuisance_at(truth)).all()


def test_points_that_are_not_seen_are_kept(problem: Problems) -> None:
    aligned, truth = problem()
    behind = perturbed(truth, np.array([np.pi, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert agreeing(aligned, aligned.nuisance_at(behind)).all()
