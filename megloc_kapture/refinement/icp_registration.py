"""Surfaces out of clouds of points, and clouds fitted to them: the adapter of small_gicp.

One thread throughout: with more, small_gicp's voxel grid does not give the same points twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import small_gicp
from numpy.typing import NDArray

from megloc_kapture.values import RigidTransform

Floats = NDArray[np.float64]

NORMAL_NEIGHBOURS = 20
"""Points that a normal is estimated from; small_gicp's own number."""

_MAX_ITERATIONS = 20
# a tenth of what a refined pose has to be good to
_ROTATION_EPSILON_RAD = 1e-4
_TRANSLATION_EPSILON_M = 1e-4


@dataclass(frozen=True, eq=False)
class Surface:
    """Points on a surface, with its normals.

    Attributes
    ----------
    points : float64 (N, 3).
    normals : float64 (N, 3), unit length, of either sign.
    """

    points: Floats
    normals: Floats
    _cloud: Any
    _tree: Any

    def nearest(self, points: Floats) -> tuple[NDArray[np.int64], Floats]:
        """Rows of the nearest points of the surface, and their distances, of points (M, 3)."""
        rows, squared = self._tree.batch_knn_search(np.ascontiguousarray(points), 1)
        return rows[:, 0].astype(np.int64), np.sqrt(squared[:, 0])

    def spacing(self) -> float:
        """Median distance from a point to the last of those that its normal comes from.

        Of at least :data:`NORMAL_NEIGHBOURS` points.
        """
        _, squared = self._tree.batch_knn_search(self.points, NORMAL_NEIGHBOURS)
        return float(np.sqrt(np.median(squared[:, -1])))


def thinned(points: Floats, voxel_m: float) -> Floats:
    """One point per voxel, the mean of those in it: float64 (M, 3) of (N, 3)."""
    if not len(points):
        return np.zeros((0, 3))
    # voxel indices have 21 bits: far from the origin there are none
    origin = points.mean(axis=0)
    cloud = small_gicp.voxelgrid_sampling(np.ascontiguousarray(points - origin), voxel_m)
    return np.array(cloud.points())[:, :3] + origin


def surface_of(points: Floats) -> Surface:
    """The surface through points (N, 3) near the origin, :func:`thinned`.

    Its normals are the directions in which the nearest points vary least.
    """
    cloud = small_gicp.PointCloud(np.ascontiguousarray(points))
    tree = small_gicp.KdTree(cloud)
    small_gicp.estimate_normals(cloud, tree, min(NORMAL_NEIGHBOURS, len(points)))
    return Surface(np.array(points), np.array(cloud.normals())[:, :3], cloud, tree)


def fit_to_surface(
    surface: Surface, points: Floats, surface_from_points: RigidTransform, max_distance_m: float
) -> RigidTransform | None:
    """Move points (N, 3) onto a surface: point-to-plane ICP by Levenberg-Marquardt.

    Chen and Medioni, "Object modelling by registration of multiple range images", Image and Vision
    Computing 10(3), 1992; small_gicp's ``PLANE_ICP``.

    Returns
    -------
    surface_from_points : the better transform, or None where no point of the surface is within
        ``max_distance_m``, or the result is not finite.
    """
    start = np.eye(4)
    start[:3, :3] = surface_from_points.rotation_matrix()
    start[:3, 3] = surface_from_points.translation
    result = small_gicp.align(
        surface._cloud,
        small_gicp.PointCloud(np.ascontiguousarray(points)),
        surface._tree,
        start,
        registration_type="PLANE_ICP",
        max_correspondence_distance=max_distance_m,
        max_iterations=_MAX_ITERATIONS,
        rotation_epsilon=_ROTATION_EPSILON_RAD,
        translation_epsilon=_TRANSLATION_EPSILON_M,
    )
    moved = np.array(result.T_target_source)
    if result.num_inliers == 0 or not np.isfinite(moved).all():
        return None
    return RigidTransform.from_matrix(moved[:3, :3], moved[:3, 3])
