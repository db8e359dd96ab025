"""The distance of two poses over a covariance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.refinement.photometric import perturbed
from megloc_kapture.refinement.rendering_acceptance import squared_distance
from megloc_kapture.values import RigidTransform


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
