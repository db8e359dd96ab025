"""How well a cloud fits a surface, against analytic answers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from megloc_kapture.refinement.icp_fit import (
    SurfaceFit,
    condition_number,
    fit_covariance,
    surface_fit,
)
from megloc_kapture.refinement.icp_registration import surface_of, thinned
from megloc_kapture.refinement.icp_weighted import fit_weighted
from megloc_kapture.values import RigidTransform


def fit_of(points: np.ndarray, normals: np.ndarray) -> SurfaceFit:
    return SurfaceFit(1.0, 1.0, 0.0, points, normals, np.zeros(len(points)))


def corner(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on three walls, and the walls' normals."""
    points = rng.uniform(0.1, 2.0, (count, 3))
    walls = np.arange(count) % 3
    points[np.arange(count), walls] = 0.0
    return points, np.eye(3)[walls]


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_what_slides_has_no_finite_condition() -> None:
    rng = np.random.default_rng(0)
    around = directions(rng, 500)
    plane = np.column_stack([rng.uniform(-1, 1, (500, 2)), np.full(500, 3.0)])
    cylinder = np.column_stack([around[:, :2] / np.hypot(*around[:, :2].T)[:, None], around[:, 2]])
    assert condition_number(fit_of(plane, np.tile([0.0, 0.0, 1.0], (500, 1)))) > 1e12
    assert condition_number(fit_of(around * 2.0 + 5.0, around)) > 1e12
    assert condition_number(fit_of(cylinder, cylinder * [1, 1, 0])) > 1e12
    assert condition_number(fit_of(plane[:5], directions(rng, 5))) == np.inf


def test_the_condition_of_a_cube() -> None:
    """On the faces of a cube all directions are alike, and all turns."""
    grid = (np.arange(40) + 0.5) / 20 - 1
    u, v = (each.ravel() for each in np.meshgrid(grid, grid))
    faces, normals = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = np.insert(np.column_stack([u, v]), axis, side, axis=1)
            faces.append(face)
            normals.append(np.tile(side * np.eye(3)[axis], (len(u), 1)))
    points, outward = np.concatenate(faces), np.concatenate(normals)
    scale = np.linalg.norm(points, axis=1).mean()
    # a turn about x moves the faces +-y by z and +-z by y: 4 of 6 faces, mean square u^2 each
    turning, moving = 4 / 6 * np.mean(u**2) / scale**2, 2 / 6
    expected = max(turning, moving) / min(turning, moving)
    assert condition_number(fit_of(points, outward)) == pytest.approx(expected, rel=1e-9)
    # where it lies and how large it is do not matter
    assert condition_number(fit_of(7.0 * points + 100.0, outward)) == pytest.approx(expected)


def test_the_fit_is_that_of_the_nearest_planes() -> None:
    rng = np.random.default_rng(1)
    surface = surface_of(thinned(corner(rng, 20000)[0], 0.05))
    points = rng.uniform(-0.2, 1.0, (400, 3))
    turn = Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix()
    surface_from_points = RigidTransform.from_matrix(turn, np.array([0.05, 0.0, -0.05]))
    fit = surface_fit(surface, points, surface_from_points, near_m=0.1, far_m=0.3)
    moved = points @ turn.T + [0.05, 0.0, -0.05]
    distances, rows = cKDTree(surface.points).query(moved)
    residuals = ((moved - surface.points[rows]) * surface.normals[rows]).sum(axis=1)
    assert fit.overlap == np.mean(distances <= 0.1)
    assert fit.reach == np.mean(distances <= 0.3)
    assert 0.0 < fit.overlap < fit.reach < 1.0
    assert fit.residual_m == pytest.approx(np.median(np.abs(residuals[distances <= 0.3])))
    np.testing.assert_allclose(fit.residuals_m, residuals[distances <= 0.1])
    np.testing.assert_allclose(fit.points, points[distances <= 0.1])
    np.testing.assert_allclose(
        fit.normals @ turn.T, surface.normals[rows[distances <= 0.1]], atol=1e-12
    )


def test_nothing_near() -> None:
    surface = surface_of(thinned(corner(np.random.default_rng(0), 5000)[0], 0.05))
    far = RigidTransform((1.0, 0.0, 0.0, 0.0), (50.0, 0.0, 0.0))
    fit = surface_fit(surface, np.zeros((30, 3)), far, near_m=0.1, far_m=0.3)
    assert (fit.overlap, fit.reach, fit.residual_m) == (0.0, 0.0, np.inf)


def test_the_covariance_is_that_of_many_trials() -> None:
    """Left perturbation of ``cam_from_world``, the camera two metres away from the corner."""
    rng = np.random.default_rng(2)
    surface = surface_of(thinned(corner(rng, 60000)[0], 0.05))
    truth = RigidTransform.from_matrix(
        Rotation.from_euler("xyz", [0.4, -0.3, 0.2]).as_matrix(), np.array([0.3, -0.4, 2.0])
    )
    errors, predicted = [], []
    for _ in range(60):
        world, normals = corner(rng, 600)
        seen = truth.apply(world + 0.01 * rng.standard_normal((600, 1)) * normals)
        found = fit_weighted(surface, seen, np.ones(600), truth.inverse(), 0.2)
        assert found is not None
        delta = found.inverse() @ truth.inverse()
        turn = Rotation.from_matrix(delta.rotation_matrix()).as_rotvec()
        errors.append([*turn, *delta.translation])
        fit = surface_fit(surface, seen, found, near_m=0.2, far_m=0.3)
        predicted.append(fit_covariance(fit))
    measured = np.cov(np.array(errors).T)
    # along every direction of the mean prediction's, within what 60 trials tell
    values, vectors = np.linalg.eigh(np.mean(predicted, axis=0))
    ratio = np.diag(vectors.T @ measured @ vectors) / values
    assert (ratio > 0.5).all() and (ratio < 2.0).all()
