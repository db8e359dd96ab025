"""The least cost near an alignment, by Levenberg's and Marquardt's steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from megloc_kapture.refinement.photometric import (
    MIN_POINTS,
    Alignment,
    LevelProblem,
    perturbed,
)

_MAX_STEPS = 12
_LAST_GAIN = 1e-5  # share of the cost
_DAMPING = 1e-3
_MOST_DAMPING = 1e2


def minimised(
    problem: LevelProblem,
    start: Alignment,
    *,
    last_step_px: float = 0.01,
    rounds: int = 2,
) -> Alignment:
    """The alignment of least cost near one, to a step of so many pixels of the level.

    Each round has a scale of the loss of its own.
    """
    at = start
    for _ in range(rounds):
        at = _levenberg_marquardt(problem, at, last_step_px)
        at = replace(at, deviation=problem.deviation(at))
    return at


def _levenberg_marquardt(problem: LevelProblem, at: Alignment, last_step_px: float) -> Alignment:
    scale2 = at.squared_scale
    if not scale2 > 0:
        return at  # residuals are zero: there is nothing to gain
    reach = problem.px_per_step()
    system = problem.system_at(at, scale2)
    damping = _DAMPING
    for _ in range(_MAX_STEPS):
        if system.count < MIN_POINTS:
            return at
        step = system.step(damping)
        if step is None:
            return at
        pose_step, gain_step, bias_step = step
        trial = at.moved(perturbed(at.cam_from_world, pose_step), gain_step, bias_step)
        new = problem.system_at(trial, scale2)
        # of means: points that leave the image neither cost nor pay
        small = float(np.abs(pose_step) @ reach) < last_step_px
        if new.count >= MIN_POINTS and new.mean_cost < system.mean_cost:
            small = small or new.mean_cost > (1.0 - _LAST_GAIN) * system.mean_cost
            at, system = trial, new
            damping = max(0.1 * damping, 1e-9)
        else:
            damping = max(10.0 * damping, _DAMPING)
        if small or damping > _MOST_DAMPING:
            return at
    return at
