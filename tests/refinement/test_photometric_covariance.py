"""The covariance of an alignment is that of its errors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.refinement.photometric import LevelProblem
from megloc_kapture.refinement.photometric_covariance import covariance
from megloc_kapture.refinement.photometric_minimum import minimised
from megloc_kapture.refinement.photometric_pyramid import Level
from megloc_kapture.values import RigidTransform

Array = NDArray[np.float64]
Problems = Callable[..., tuple[LevelProblem, RigidTransform]]


def error_vector(found: RigidTransform, truth: RigidTransform) -> Array:
    true_from_found = truth @ found.inverse()
    vector = Rotation.from_matrix(true_from_found.rotation_matrix()).as_rotvec()
    return np.concatenate([vector, true_from_found.translation])


def test_covariance_is_that_of_the_errors(problem: Problems) -> None:
    errors, claimed = [], []
    for seed in range(60):
        aligned, truth = problem(count=3000, noise=0.3, seed=seed)
        found = minimised(aligned, aligned.nuisance_at(truth), last_step_px=1e-3)
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
