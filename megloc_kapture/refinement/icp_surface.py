"""Clouds and surfaces of ICP: the map around a query, surfaces through it, clouds fitted to them.

The adapter of small_gicp, with one thread throughout: with more, its voxel grid does not give the
same points twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import small_gicp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import focal_px, px_from_cam
from megloc_kapture.geometry.poses import deviation_by_median, rotation_angles_deg
from megloc_kapture.plugins import DepthView, RankingScene
from megloc_kapture.refinement.depth_points import DepthCloudOptions, depth_cloud
from megloc_kapture.values import Camera, RigidTransform

Floats = NDArray[np.float64]
NORMAL_NEIGHBOURS = 20
_MAX_ITERATIONS = 20
# a tenth of what a refined pose has to be good to
_ROTATION_EPSILON_RAD = 1e-4
_TRANSLATION_EPSILON_M = 1e-4
_CONVERGED = 5e-5  # radians and metres, a hundredth of what a refined pose has to be good to
# the scale at which the Cauchy loss has 95 % of least squares' efficiency under Gaussian noise
_CAUCHY_EFFICIENT = 2.385
# pixels of a reference's depth map between those by which its overlap is measured
_OVERLAP_STEP_PX = 8
# views this near to each other are one view: a depth sensor's errors depend on where a surface
# lies in its image, and only those of different views average out
_SAME_VIEW_M, _SAME_VIEW_DEG = 0.2, 10.0


"""Points that a normal is estimated from; small_gicp's own number."""


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


def downsample(points: Floats, voxel_m: float) -> Floats:
    """One point per voxel, the mean of those in it: float64 (M, 3) of (N, 3)."""
    if not len(points):
        return np.zeros((0, 3))
    # voxel indices have 21 bits: far from the origin there are none
    origin = points.mean(axis=0)
    cloud = small_gicp.voxelgrid_sampling(np.ascontiguousarray(points - origin), voxel_m)
    return np.array(cloud.points())[:, :3] + origin


def surface_of(points: Floats) -> Surface:
    """The surface through points (N, 3) near the origin, :func:`downsample`.

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
    deviation = deviation_by_median(fit.residuals_m)
    return np.linalg.inv(jacobian.T @ jacobian) * deviation**2


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
        scale = deviation_by_median(relative)
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


@dataclass(frozen=True)
class MapCloudOptions:
    """Options of a map's cloud.

    Parameters
    ----------
    depth : which depths are trusted.
    max_references : depth maps that are read into the cloud.
    voxel_m : of the cloud, metres.
    margin_m : points this far from the query's are kept; depths that differ by less agree.
    """

    depth: DepthCloudOptions
    max_references: int
    voxel_m: float
    margin_m: float


def map_cloud(
    query_depth: DepthView,
    query_points: Floats,
    cam_from_world: RigidTransform,
    references: Sequence[str],
    scene: RankingScene,
    options: MapCloudOptions,
) -> Floats:
    """The map around a query's points under its estimated pose.

    The depth maps of the references that overlap most with the query's, of those within 0.2 m and
    10 deg of each other only one; where no reference has depth, the points of the map that the
    references observe.

    Parameters
    ----------
    query_points : float64 (N, 3) in the query camera's frame.
    references : map images, best first.

    Returns
    -------
    points : float64 (M, 3) in the world.
    """
    overlaps = _overlaps(query_depth, cam_from_world, references, scene, options)
    if overlaps:
        clouds = [np.zeros((0, 3))]
        for name in _different_views(overlaps, scene, options.max_references):
            cloud = _crop(
                query_points, _depth_in_world(name, scene, options), cam_from_world, options
            )
            # a vote per image and voxel: a near image has more pixels there, not more right
            clouds.append(downsample(cloud, options.voxel_m))
        return np.concatenate(clouds)
    observed = [scene.map_points(name) for name in references]
    points = np.unique(np.concatenate([np.zeros((0, 3)), *observed]), axis=0)
    return _crop(query_points, points, cam_from_world, options)


def _overlaps(
    query_depth: DepthView,
    cam_from_world: RigidTransform,
    references: Sequence[str],
    scene: RankingScene,
    options: MapCloudOptions,
) -> list[tuple[str, float]]:
    """References that have depth, and the share of it that agrees with the query's; most first."""
    found = []
    depth_from_world = query_depth.image_from_depth.inverse() @ cam_from_world
    for name in references:
        view = scene.map_depth(name)
        if view is None:
            continue
        points = depth_cloud(view, options.depth, step_px=_OVERLAP_STEP_PX)
        world_from_image = scene.map_pose(name).inverse()
        agrees = _agrees(
            query_depth, (depth_from_world @ world_from_image).apply(points), options.margin_m
        )
        found.append((name, float(agrees.mean()) if len(agrees) else 0.0))
    # stable: of equals the better reference stays first
    return sorted(found, key=lambda each: -each[1])


def _different_views(
    overlaps: Sequence[tuple[str, float]], scene: RankingScene, count: int
) -> list[str]:
    """The first references that overlap at all and do not repeat the view of an earlier one."""
    names: list[str] = []
    quats, centers = np.zeros((0, 4)), np.zeros((0, 3))
    for name, overlap in overlaps:
        if overlap <= 0 or len(names) == count:
            break
        pose = scene.map_pose(name)
        quat, center = np.array(pose.quat_wxyz), pose.center()
        near = np.linalg.norm(centers - center, axis=1) < _SAME_VIEW_M
        if (near & (rotation_angles_deg(quats, quat) < _SAME_VIEW_DEG)).any():
            continue
        names.append(name)
        quats, centers = np.vstack([quats, quat]), np.vstack([centers, center])
    return names


def _agrees(view: DepthView, points_in_depth: Floats, tolerance_m: float) -> NDArray[np.bool_]:
    """Mask (N,) of points (N, 3) in the depth camera's frame that lie near a measured depth."""
    pixels = px_from_cam(view.camera, points_in_depth)
    height, width = view.depth_m.shape
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    column, row = pixels[inside].astype(np.int64).T
    depth = view.depth_m[row, column].astype(np.float64)
    with np.errstate(invalid="ignore"):
        near = (depth > 0) & (np.abs(points_in_depth[inside, 2] - depth) <= tolerance_m)
    agrees = np.zeros(len(points_in_depth), bool)
    agrees[inside] = near
    return agrees


def _depth_in_world(name: str, scene: RankingScene, options: MapCloudOptions) -> Floats:
    view = scene.map_depth(name)
    if view is None:
        return np.zeros((0, 3))
    points = depth_cloud(
        view,
        options.depth,
        image_camera=scene.map_camera(name),
        image_mask=scene.map_mask(name),
        step_px=_step_px(view.camera, options),
    )
    return scene.map_pose(name).inverse().apply(points)


def _step_px(camera: Camera, options: MapCloudOptions) -> int:
    """Pixels of a depth map that half a voxel covers at the greatest depth."""
    return max(1, round(0.5 * options.voxel_m * focal_px(camera) / options.depth.max_depth_m))


def _crop(
    query_points: Floats, points: Floats, cam_from_world: RigidTransform, options: MapCloudOptions
) -> Floats:
    """Of points in the world, those in the box around the query's, margin included."""
    low, high = query_points.min(axis=0), query_points.max(axis=0)
    in_camera = cam_from_world.apply(points)
    inside = (in_camera >= low - options.margin_m) & (in_camera <= high + options.margin_m)
    return points[inside.all(axis=1)]
