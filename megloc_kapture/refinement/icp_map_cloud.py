"""The map's cloud of points around a query: from depth maps, or from the map's own points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import focal_px, px_from_cam
from megloc_kapture.geometry.poses import rotation_angles_deg
from megloc_kapture.plugins import DepthView, RankingScene
from megloc_kapture.refinement.depth_cloud import DepthCloudOptions, depth_cloud
from megloc_kapture.refinement.icp_registration import thinned
from megloc_kapture.values import Camera, RigidTransform

Floats = NDArray[np.float64]

# pixels of a reference's depth map between those by which its overlap is measured
_OVERLAP_STEP_PX = 8
# views this near to each other are one view: a depth sensor's errors depend on where a surface
# lies in its image, and only those of different views average out
_SAME_VIEW_M, _SAME_VIEW_DEG = 0.2, 10.0


@dataclass(frozen=True)
class MapCloudOptions:
    """How a map's cloud is put together.

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
            cloud = _around(
                query_points, _depth_in_world(name, scene, options), cam_from_world, options
            )
            # a vote per image and place: a near image has more pixels there, not more right
            clouds.append(thinned(cloud, options.voxel_m))
        return np.concatenate(clouds)
    observed = [scene.map_points(name) for name in references]
    points = np.unique(np.concatenate([np.zeros((0, 3)), *observed]), axis=0)
    return _around(query_points, points, cam_from_world, options)


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
    """Which points (N, 3) in the depth camera's frame lie near a depth that it measured."""
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


def _around(
    query_points: Floats, points: Floats, cam_from_world: RigidTransform, options: MapCloudOptions
) -> Floats:
    """Of points in the world, those in the box around the query's, margin included."""
    low, high = query_points.min(axis=0), query_points.max(axis=0)
    in_camera = cam_from_world.apply(points)
    inside = (in_camera >= low - options.margin_m) & (in_camera <= high + options.margin_m)
    return points[inside.all(axis=1)]
