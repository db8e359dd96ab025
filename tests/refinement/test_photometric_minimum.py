"""The least cost near an alignment is at the true pose."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.refinement.photometric import LevelProblem, perturbed
from megloc_kapture.refinement.photometric_minimum import minimised
from megloc_kapture.values import RigidTransform

Array = NDArray[np.float64]
Problems = Callable[..., tuple[LevelProblem, RigidTransform]]


def error_vector(found: RigidTransform, truth: RigidTransform) -> Array:
    true_from_found = truth @ found.inverse()
    vector = Rotation.from_matrix(true_from_found.rotation_matrix()).as_rotvec()
    return np.concatenate([vector, true_from_found.translation])


@pytest.mark.parametrize("channels", [1, 3])
def test_the_true_pose_is_found_with_gains_and_biases_among_outliers(
    problem: Problems, channels: int
) -> None:
    aligned, truth = problem("OPENCV", channels=channels, count=1500, wrong=0.3)
    start = perturbed(truth, np.array([1e-3, -1e-3, 1e-3, 0.006, -0.005, 0.006]))
    found = minimised(aligned, aligned.nuisance_at(start), last_step_px=1e-4)
    assert np.abs(error_vector(found.cam_from_world, truth)).max() < 1e-4
    np.testing.assert_allclose(found.gains, [[0.7] * channels, [1.3] * channels], atol=1e-3)
    np.testing.assert_allclose(found.biases, [[0.2] * channels, [-0.4] * channels], atol=1e-3)
