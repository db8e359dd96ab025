"""The last step of ICP: noise and outliers that least squares would follow."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.refinement.icp_registration import Surface, fit_to_surface, surface_of, thinned
from megloc_kapture.refinement.icp_weighted import fit_weighted
from megloc_kapture.values import RigidTransform

IDENTITY = RigidTransform.identity()


def walls(rng: np.random.Generator, count: int) -> np.ndarray:
    points = rng.uniform(0.1, 2.0, (count, 3))
    points[np.arange(count), np.arange(count) % 3] = 0.0
    return points


@pytest.fixture(scope="module")
def surface() -> Surface:
    return surface_of(thinned(walls(np.random.default_rng(0), 60000), 0.05))


def error(found: RigidTransform | None) -> tuple[float, float]:
    assert found is not None
    turn = Rotation.from_matrix(found.rotation_matrix()).magnitude()
    # of the points' middle: what the origin does depends on the turn
    middle = np.ones((1, 3))
    return float(np.linalg.norm(found.apply(middle) - middle)), float(np.degrees(turn))


@pytest.mark.parametrize("seed", range(3))
def test_exact_points_come_back(surface: Surface, seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(np.radians(rng.uniform(-0.5, 0.5, 3))).as_matrix()
    start = RigidTransform.from_matrix(turn, rng.uniform(-0.01, 0.01, 3))
    found = fit_weighted(surface, walls(rng, 3000), np.ones(3000), start, 0.1)
    assert error(found)[0] < 1e-4
    assert error(found)[1] < 1e-2


def test_outliers_hardly_count(surface: Surface) -> None:
    rng = np.random.default_rng(1)
    points = walls(rng, 3000) + 0.002 * rng.standard_normal((3000, 3))
    # a fifth of the floor has 5 cm on it that the map does not
    covered = (np.arange(3000) % 3 == 2) & (points[:, 0] < 0.5)
    points[covered, 2] += 0.05
    found = fit_weighted(surface, points, np.ones(3000), IDENTITY, 0.1)
    squares = fit_to_surface(surface, points, IDENTITY, 0.1)
    assert error(found)[0] < 0.001
    assert error(found)[1] < 0.05
    assert error(squares)[0] > 3 * error(found)[0]


def test_noise_weighs(surface: Surface) -> None:
    """Half of the points are ten times worse, and wrong by 1 cm: what the noise says of them."""
    rng = np.random.default_rng(2)
    noise = np.where(rng.random(3000) < 0.5, 0.02, 0.002)
    points = walls(rng, 3000) + noise[:, None] * rng.standard_normal((3000, 3))
    points[noise > 0.01] += 0.01
    weighted = error(fit_weighted(surface, points, noise, IDENTITY, 0.2))[0]
    alike = error(fit_weighted(surface, points, np.ones(3000), IDENTITY, 0.2))[0]
    assert weighted < 0.001
    assert alike > 2 * weighted


def test_the_scale_of_the_noise_does_not_matter(surface: Surface) -> None:
    rng = np.random.default_rng(3)
    points = walls(rng, 1000) + 0.005 * rng.standard_normal((1000, 3))
    noise = rng.uniform(0.5, 2.0, 1000)
    first = fit_weighted(surface, points, noise, IDENTITY, 0.1)
    second = fit_weighted(surface, points, 64.0 * noise, IDENTITY, 0.1)
    assert first is not None and second is not None
    np.testing.assert_allclose(first.translation, second.translation, atol=1e-12)


def test_nothing_near(surface: Surface) -> None:
    far = RigidTransform((1.0, 0.0, 0.0, 0.0), (9.0, 9.0, 9.0))
    points = walls(np.random.default_rng(0), 100)
    assert fit_weighted(surface, points, np.ones(100), far, 0.1) is None
    assert fit_to_surface(surface, points, far, 0.1) is None
