"""Directions of a pose by what the image says of them, and alignments that look much the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.refinement.photometric import Alignment, LevelProblem, perturbed
from megloc_kapture.refinement.photometric_equations import NormalEquations

Float64 = NDArray[np.float64]

# by about how many pixels of the level points move to either side of a difference
_CURVATURE_PX = 0.5
# how far alignments are tried again, in steps that change the image by that much
_BESIDE = (-4.0, -2.0, 0.0, 2.0, 4.0)
# eigenvalue over the largest, in units that move points as far, from which a pose is determined
_LEAST_CURVATURE = 1e-7


def even_steps(problem: LevelProblem, system: NormalEquations) -> tuple[Float64, float] | None:
    """Steps (6, 6), in columns, that change the image alike, as half a pixel of the level does.

    They are uncorrelated by the normal equations; the first is the one that the image determines
    least. Also by how much each changes the residuals, squared and weighted. None where the image
    leaves a direction free.
    """
    reduced = system.reduced()
    if reduced is None:
        return None
    usual = _CURVATURE_PX / problem.px_per_step()
    scaled = reduced[0] * np.outer(usual, usual)
    values, vectors = np.linalg.eigh(scaled)
    if not values[0] > _LEAST_CURVATURE * values[-1]:
        return None
    change = float(np.trace(scaled)) / 6.0
    return usual[:, None] * vectors * np.sqrt(change / values), change


def beside(problem: LevelProblem, at: Alignment) -> list[Alignment]:
    """Alignments that look much the same, those of the least cost first.

    They are off by pixels along the two directions that the image determines least.
    """
    scale2 = at.squared_scale
    found = even_steps(problem, problem.system_at(at, scale2)) if scale2 > 0 else None
    if found is None:
        return []
    first, second = found[0][:, 0], found[0][:, 1]
    poses = [
        perturbed(at.cam_from_world, a * first + b * second)
        for a in _BESIDE
        for b in _BESIDE
        if a or b
    ]
    others = [replace(at, cam_from_world=pose) for pose in poses]
    costs = [problem.system_at(each, scale2).mean_cost for each in others]
    return [others[k] for k in np.argsort(costs, kind="stable")]
