"""What is asked of small_gicp, against scipy and brute force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from megloc_kapture.refinement.icp_registration import (
    NORMAL_NEIGHBOURS,
    fit_to_surface,
    surface_of,
    thinned,
)
from megloc_kapture.values import RigidTransform


def walls(seed: int, count: int) -> np.ndarray:
    points = np.random.default_rng(seed).uniform(0.0, 2.0, (count, 3))
    points[np.arange(count), np.arange(count) % 3] = 0.0
    return points


def test_thinned_points_are_means_of_voxels() -> None:
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (5000, 3)) + [1e6, -2e6, 3e5]
    found = thinned(points, 0.25)
    local = points - points.mean(axis=0)
    _, voxel = np.unique(np.floor(local / 0.25), axis=0, return_inverse=True)
    counts = np.bincount(voxel.ravel())
    means = np.stack([np.bincount(voxel.ravel(), points[:, k]) / counts for k in range(3)], axis=1)
    assert len(found) == len(means)
    np.testing.assert_allclose(
        found[np.lexsort(found.round(4).T)], means[np.lexsort(means.round(4).T)], atol=1e-6
    )
    assert thinned(np.zeros((0, 3)), 0.1).shape == (0, 3)


def test_normals_are_the_least_varying_directions() -> None:
    points = thinned(walls(1, 20000) + 0.002 * np.random.default_rng(1).standard_normal(3), 0.05)
    surface = surface_of(points)
    np.testing.assert_array_equal(surface.points, points)
    _, rows = cKDTree(points).query(points, NORMAL_NEIGHBOURS)
    around = points[rows] - points[rows].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    clear = values[:, 0] < 0.1 * values[:, 1]
    along = np.abs((surface.normals * vectors[:, :, 0]).sum(axis=1))
    assert clear.mean() > 0.8
    np.testing.assert_allclose(along[clear], 1.0, atol=1e-6)


def test_nearest_and_spacing() -> None:
    points = thinned(walls(2, 20000), 0.05)
    surface, tree = surface_of(points), cKDTree(points)
    asked = np.random.default_rng(2).uniform(-0.5, 2.5, (300, 3))
    expected, expected_rows = tree.query(asked)
    rows, distances = surface.nearest(asked)
    np.testing.assert_array_equal(rows, expected_rows)
    np.testing.assert_allclose(distances, expected, atol=1e-12)
    last = tree.query(points, NORMAL_NEIGHBOURS)[0][:, -1]
    assert surface.spacing() == pytest.approx(np.median(last))


def test_a_corner_is_found_again() -> None:
    surface = surface_of(thinned(walls(3, 60000), 0.05))
    points = thinned(walls(4, 6000), 0.1)
    turn = Rotation.from_rotvec(np.radians([2.0, -1.5, 1.0])).as_matrix()
    start = RigidTransform.from_matrix(turn, np.array([0.03, -0.02, 0.04]))
    found = fit_to_surface(surface, points, start, 0.3)
    assert found is not None
    assert np.linalg.norm(found.translation) < 2e-3
    assert np.degrees(Rotation.from_matrix(found.rotation_matrix()).magnitude()) < 0.1
