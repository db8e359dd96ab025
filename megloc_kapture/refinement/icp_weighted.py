"""The last step of ICP: every pixel by its noise, and outliers by little."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.refinement.icp_registration import Surface
from megloc_kapture.values import RigidTransform

Floats = NDArray[np.float64]

_MAX_ITERATIONS = 20
_CONVERGED = 5e-5  # radians and metres, a hundredth of what a refined pose has to be good to
# the scale at which the Cauchy loss has 95 % of least squares' efficiency under Gaussian noise
_CAUCHY_EFFICIENT = 2.385
# the standard deviation of Gaussian values over the median of their lengths
_DEVIATION_FROM_MEDIAN = 1.482602218505602


def fit_weighted(
    surface: Surface,
    points: Floats,
    noise: Floats,
    surface_from_points: RigidTransform,
    max_distance_m: float,
) -> RigidTransform | None:
    """Move points onto a surface that they are near already, point to plane.

    Gauss-Newton on Cauchy's loss of the distances over their noise, whose scale follows their
    median: small_gicp's least squares give the far and noisy, and what only one of the two clouds
    has, the same weight as the rest. Corresponding points are sought anew in every step.

    Parameters
    ----------
    points : float64 (N, 3).
    noise : float64 (N,), what the deviations of the points are proportional to.

    Returns
    -------
    surface_from_points : or None where fewer than six points are within ``max_distance_m`` or they
        do not determine the transform.
    """
    transform = surface_from_points
    for _ in range(_MAX_ITERATIONS):
        moved = transform.apply(points)
        rows, distances = surface.nearest(moved)
        near = distances <= max_distance_m
        if near.sum() < 6:
            return None
        normals, moved = surface.normals[rows[near]], moved[near]
        residuals = np.einsum("ni,ni->n", moved - surface.points[rows[near]], normals)
        relative = residuals / noise[near]
        scale = _DEVIATION_FROM_MEDIAN * np.median(np.abs(relative))
        if scale == 0:
            return transform
        weights = 1.0 / (1.0 + (relative / (_CAUCHY_EFFICIENT * scale)) ** 2) / noise[near] ** 2
        # turned about the points' own origin: rotation and translation are nearly independent
        origin = np.array(transform.translation)
        jacobian = np.column_stack([np.cross(moved - origin, normals), normals])
        weighted = jacobian * weights[:, None]
        try:
            step = -np.linalg.solve(weighted.T @ jacobian, weighted.T @ residuals)
        except np.linalg.LinAlgError:
            return None
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        transform = RigidTransform.from_matrix(
            turn @ transform.rotation_matrix(), origin + step[3:]
        )
        if np.linalg.norm(step) < _CONVERGED:
            break
    return transform
