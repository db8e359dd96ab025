"""Steps of pose, gains and biases against the whole system."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from megloc_kapture.refinement.photometric import LevelProblem, perturbed
from megloc_kapture.values import RigidTransform

Problems = Callable[..., tuple[LevelProblem, RigidTransform]]


def test_a_step_solves_the_whole_system(problem: Problems) -> None:
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
    own = np.stack([gains, biases], axis=-1).ravel()
    np.testing.assert_allclose(own, expected[6:], rtol=1e-5, atol=1e-8)
