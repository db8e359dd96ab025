"""Point clouds and surfaces for ICP: points from depth maps, normals and fits.

small_gicp runs in one thread because its voxel grid is not deterministic with more.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import small_gicp
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import pixel_rays, px_from_cam, values_at
from megloc_kapture.geometry.poses import deviation_by_median
from megloc_kapture.plugins import DepthView
from megloc_kapture.values import Camera, Options, RigidTransform

Floats = NDArray[np.float64]
NORMAL_NEIGHBOURS = 20  # small_gicp's default
_MAX_ITERATIONS = 20
_ROTATION_EPSILON_RAD = 1e-4
_TRANSLATION_EPSILON_M = 1e-4
_CONVERGED = 5e-5  # a step with a smaller norm (radians, metres) is the last
# Cauchy scale with 95 % efficiency under Gaussian noise
_CAUCHY_EFFICIENT = 2.385
# pixels whose depth differs from a neighbour's by more than this share of the smaller depth are
# edges; on a plane tilted by 80 degrees, with a focal length of 585 px, the share is about 0.014
_MAX_JUMP = 0.05


class DepthCloudOptions(Options):
    max_depth_m: float = Field(
        default=4.0,
        gt=0,
        description="largest depth, metres. The noise of structured-light sensors grows with the "
        "square of the distance and is 2.6 cm at 4 m, the end of their rated range; raise the "
        "limit for laser scanners",
    )


def depth_cloud(
    view: DepthView,
    options: DepthCloudOptions | None = None,
    *,
    image_camera: Camera | None = None,
    image_mask: NDArray[np.bool_] | None = None,
    step_px: int = 1,
) -> Floats:
    """Return the points (N, 3) of a depth map in the frame of its image, in metres.

    Pixels are dropped if their depth is unknown or too large, if they are at depth edges, which
    sensors smear (Khoshelham and Elberink, Sensors 12(2), 2012), or if the image is masked there.
    """
    options = options or DepthCloudOptions()
    depth = np.asarray(view.depth_m, np.float32)
    sampled = np.s_[step_px // 2 :: step_px, step_px // 2 :: step_px]
    z = depth[sampled]
    with np.errstate(invalid="ignore"):
        trusted = (z > 0) & (z <= options.max_depth_m) & ~_on_edge(depth, sampled)
    rows = np.arange(depth.size).reshape(depth.shape)[sampled][trusted]
    points = view.image_from_depth.apply(
        pixel_rays(view.camera)[rows] * z[trusted].astype(np.float64)[:, None]
    )
    if image_camera is None or image_mask is None:
        return points
    px = px_from_cam(image_camera, points)
    return points[values_at(image_mask, image_camera, px, outside=True)]


def _on_edge(depth: NDArray[np.float32], sampled: tuple[slice, slice]) -> NDArray[np.bool_]:
    height, width = depth.shape
    padded = np.pad(depth, 1)
    z, limit = depth[sampled], np.float32(1.0 + _MAX_JUMP)
    edge = np.zeros(z.shape, bool)
    with np.errstate(invalid="ignore"):
        for down, right in product((0, 1, 2), (0, 1, 2)):
            other = padded[down : down + height, right : right + width][sampled]
            # pixels without depth (0, NaN) do not count as edges
            edge |= (other > limit * z) | ((other > 0) & (limit * other < z))
    return edge


@dataclass(frozen=True, eq=False)
class Surface:
    points: Floats  # float64 (N, 3)
    normals: Floats  # float64 (N, 3), unit length, of either sign
    _cloud: Any
    _tree: Any

    def nearest(self, points: Floats) -> tuple[NDArray[np.int64], Floats]:
        rows, squared = self._tree.batch_knn_search(np.ascontiguousarray(points), 1)
        return rows[:, 0].astype(np.int64), np.sqrt(squared[:, 0])

    def spacing(self) -> float:
        """Return the points' median distance to the farthest neighbour used for their normals."""
        _, squared = self._tree.batch_knn_search(self.points, NORMAL_NEIGHBOURS)
        return float(np.sqrt(np.median(squared[:, -1])))


def downsample(points: Floats, voxel_m: float) -> Floats:
    """Average the points (N, 3) of each voxel: float64 (M, 3)."""
    if not len(points):
        return np.zeros((0, 3))
    # voxel indices have 21 bits, too few for points far from the origin
    origin = points.mean(axis=0)
    cloud = small_gicp.voxelgrid_sampling(np.ascontiguousarray(points - origin), voxel_m)
    return np.array(cloud.points())[:, :3] + origin


def surface_of(points: Floats) -> Surface:
    """Estimate the surface through points (N, 3), which must be near the origin."""
    cloud = small_gicp.PointCloud(np.ascontiguousarray(points))
    tree = small_gicp.KdTree(cloud)
    small_gicp.estimate_normals(cloud, tree, min(NORMAL_NEIGHBOURS, len(points)))
    return Surface(np.array(points), np.array(cloud.normals())[:, :3], cloud, tree)


def fit_to_surface(
    surface: Surface, points: Floats, surface_from_points: RigidTransform, max_distance_m: float
) -> RigidTransform | None:
    """Fit points (N, 3) to a surface: point-to-plane ICP by Levenberg-Marquardt (``PLANE_ICP``).

    Return None without correspondences within ``max_distance_m``, or if the fit is not finite.
    """
    cloud = small_gicp.PointCloud(np.ascontiguousarray(points))
    result = small_gicp.align(
        *(surface._cloud, cloud, surface._tree, surface_from_points.matrix()),
        registration_type="PLANE_ICP",
        max_correspondence_distance=max_distance_m,
        max_iterations=_MAX_ITERATIONS,
        rotation_epsilon=_ROTATION_EPSILON_RAD,
        translation_epsilon=_TRANSLATION_EPSILON_M,
    )
    target_from_source = np.array(result.T_target_source)
    if result.num_inliers == 0 or not np.isfinite(target_from_source).all():
        return None
    return RigidTransform.from_matrix(target_from_source[:3, :3], target_from_source[:3, 3])


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    overlap: float  # share of the points within the near distance of the surface
    reach: float  # share of the points within the far distance
    # median point-to-plane distance of the points within the far distance; infinite if none
    residual_m: float
    # points within the near distance and the surface's normals there, both float64 (K, 3) in the
    # points' frame
    points: Floats
    normals: Floats
    residuals_m: Floats  # float64 (K,), signed point-to-plane distances


def surface_fit(
    surface: Surface,
    points: Floats,
    surface_from_points: RigidTransform,
    *,
    near_m: float,
    far_m: float,
) -> SurfaceFit:
    rotation = surface_from_points.rotation_matrix()
    transformed = surface_from_points.apply(points)
    rows, distances = surface.nearest(transformed)
    normals = surface.normals[rows]
    residuals = np.einsum("ni,ni->n", transformed - surface.points[rows], normals)
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
    """Return the condition number of the fit's normal matrix; infinite with fewer than 6 points.

    Points are centred and scaled, so that rotation and translation have equal weight (Gelfand et
    al., 3DIM 2003, section 2).
    """
    if len(fit.points) < 6:
        return np.inf
    centred = fit.points - fit.points.mean(axis=0)
    scale = np.linalg.norm(centred, axis=1).mean()
    jacobian = np.column_stack([np.cross(centred / scale, fit.normals), fit.normals])
    eigenvalues = np.linalg.eigvalsh(jacobian.T @ jacobian)
    return float(eigenvalues[-1] / eigenvalues[0]) if eigenvalues[0] > 0 else np.inf


def fit_covariance(fit: SurfaceFit) -> Floats:
    """Estimate the covariance (6, 6) of ``cam_from_world``, rotation first, left perturbation.

    Residuals are assumed independent; systematic sensor errors are not included.
    """
    jacobian = np.column_stack([np.cross(fit.points, fit.normals), fit.normals])
    deviation = deviation_by_median(fit.residuals_m)
    return np.linalg.inv(jacobian.T @ jacobian) * deviation**2


def fit_weighted(
    surface: Surface,
    points: Floats,
    noise: Floats,
    surface_from_points: RigidTransform,
    max_distance_m: float,
) -> RigidTransform | None:
    """Refine a point-to-plane fit of points (N, 3) with noise deviations (N,) to a nearby surface.

    It minimises a Cauchy loss by Gauss-Newton. Returns None with fewer than six points within
    ``max_distance_m``, or if the transform is undetermined.
    """
    transform = surface_from_points
    for _ in range(_MAX_ITERATIONS):
        transformed = transform.apply(points)
        rows, distances = surface.nearest(transformed)
        near = distances <= max_distance_m
        if near.sum() < 6:
            return None
        normals, transformed = surface.normals[rows[near]], transformed[near]
        residuals = np.einsum("ni,ni->n", transformed - surface.points[rows[near]], normals)
        relative = residuals / noise[near]
        scale = deviation_by_median(relative)
        if scale == 0:
            return transform
        weights = 1.0 / (1.0 + (relative / (_CAUCHY_EFFICIENT * scale)) ** 2) / noise[near] ** 2
        # rotations are about the camera centre, which is the origin of the points' frame
        origin = np.array(transform.translation)
        jacobian = np.column_stack([np.cross(transformed - origin, normals), normals])
        weighted = jacobian * weights[:, None]
        try:
            step = -np.linalg.solve(weighted.T @ jacobian, weighted.T @ residuals)
        except np.linalg.LinAlgError:
            return None
        rotation = Rotation.from_rotvec(step[:3]).as_matrix()
        transform = RigidTransform.from_matrix(
            rotation @ transform.rotation_matrix(), origin + step[3:]
        )
        if np.linalg.norm(step) < _CONVERGED:
            break
    return transform
