"""How well a cloud lies on a surface, and how well that determines where it lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.refinement.icp_registration import Surface
from megloc_kapture.values import RigidTransform

Floats = NDArray[np.float64]

# the standard deviation of Gaussian values over the median of their lengths
_DEVIATION_FROM_MEDIAN = 1.482602218505602


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """A cloud on a surface.

    Attributes
    ----------
    overlap, reach : shares of the points with the surface within the near and the far distance.
    residual_m : median distance from the planes, over the points with the surface within the far
        distance; infinite where there are none.
    points, normals : float64 (K, 3) in the cloud's frame: points that are near, and the
        normals of their planes.
    residuals_m : float64 (K,), their signed distances from the planes.
    """

    overlap: float
    reach: float
    residual_m: float
    points: Floats
    normals: Floats
    residuals_m: Floats


def surface_fit(
    surface: Surface,
    points: Floats,
    surface_from_points: RigidTransform,
    *,
    near_m: float,
    far_m: float,
) -> SurfaceFit:
    """Compare points (N, 3) with the surface under a transform."""
    rotation = surface_from_points.rotation_matrix()
    moved = surface_from_points.apply(points)
    rows, distances = surface.nearest(moved)
    normals = surface.normals[rows]
    residuals = np.einsum("ni,ni->n", moved - surface.points[rows], normals)
    near, far = distances <= near_m, distances <= far_m
    return SurfaceFit(
        overlap=float(near.mean()) if len(near) else 0.0,
        reach=float(far.mean()) if len(far) else 0.0,
        residual_m=float(np.median(np.abs(residuals[far]))) if far.any() else np.inf,
        points=points[near],
        normals=normals[near] @ rotation,
        residuals_m=residuals[near],
    )


def condition_number(fit: SurfaceFit) -> float:
    """Greatest over least eigenvalue of the fit's normal matrix; infinite for fewer than 6 points.

    A plane, a sphere or a corridor slides along itself without a residual. Points are centred
    and scaled to a mean distance of 1, so that turning counts as much as moving (Gelfand, Ikemoto,
    Rusinkiewicz and Levoy, "Geometrically stable sampling for the ICP algorithm", 3DIM 2003,
    section 2).
    """
    if len(fit.points) < 6:
        return np.inf
    centred = fit.points - fit.points.mean(axis=0)
    scale = np.linalg.norm(centred, axis=1).mean()
    jacobian = np.column_stack([np.cross(centred / scale, fit.normals), fit.normals])
    eigenvalues = np.linalg.eigvalsh(jacobian.T @ jacobian)
    return float(eigenvalues[-1] / eigenvalues[0]) if eigenvalues[0] > 0 else np.inf


def fit_covariance(fit: SurfaceFit) -> Floats:
    """Covariance (6, 6) of ``cam_from_world`` for a cloud in the camera's frame.

    Rotation in radians, then translation in metres, of a left perturbation. Residuals count as
    independent, with the deviation that their median tells; what a sensor does to all of its
    pixels alike is not in it.
    """
    jacobian = np.column_stack([np.cross(fit.points, fit.normals), fit.normals])
    deviation = _DEVIATION_FROM_MEDIAN * np.median(np.abs(fit.residuals_m))
    return np.linalg.inv(jacobian.T @ jacobian) * deviation**2
