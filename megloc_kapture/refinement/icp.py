"""Refinement of query poses by depth alone: the plugin ``icp``.

The query's point cloud is fitted to the map's, point to plane and coarse to fine. Since it may
slide along a wall or fit the wrong wall, the new pose is accepted only if it explains the query
better, is near the old pose and is determined in every direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from megloc_kapture.geometry.cameras import (
    STRUCTURED_LIGHT,
    depth_noise,
    focal_px,
    px_from_cam,
    values_at,
)
from megloc_kapture.geometry.poses import rotation_angles_deg
from megloc_kapture.plugins import DepthView, PoseRefinement, RankingScene
from megloc_kapture.refinement.icp_surface import (
    NORMAL_NEIGHBOURS,
    DepthCloudOptions,
    Surface,
    SurfaceFit,
    condition_number,
    depth_cloud,
    downsample,
    fit_covariance,
    fit_to_surface,
    fit_weighted,
    surface_fit,
    surface_of,
)
from megloc_kapture.values import Camera, Options, RigidTransform

Floats = NDArray[np.float64]

# map images with depth: those that overlap most, without similar views
_MAX_REFERENCES = 10
# smallest number of points in either cloud at the finest voxels
_MIN_POINTS = 1000
# smallest share of the query's points close to the map: within the first of max_distances_m before
# refinement, within the last after it
_MIN_OVERLAP = 0.5
# largest accepted rotation; the largest accepted movement is the first of max_distances_m
_MAX_MOVED_DEG = 10.0
# largest condition number of the normal matrix at the coarsest level; above it the surfaces do not
# determine the pose: a bare wall has 10000, a corridor 2000, a furnished room 15
_MAX_CONDITION = 100.0
# query pixels in the last step; more take longer but have no effect
_MAX_PIXELS = 10000
# sampling step in a reference's depth map to measure its overlap
_OVERLAP_STEP_PX = 8
# views this close count as one: the errors of a depth sensor depend on the position in the image,
# so they average out only over different views
_SAME_VIEW_M, _SAME_VIEW_DEG = 0.2, 10.0


class IcpOptions(Options):
    """Options for refinement by ICP.

    The last of ``max_distances_m`` is about three standard deviations of a structured-light
    sensor's depth at the end of its range, 4 m. The deviation is 0.0012 + 0.0019 (z - 0.4)^2 m
    (Nguyen et al., 3DIMPVT 2012, eq. 4).
    """

    voxels_m: tuple[float, ...] = Field(
        default=(0.1, 0.05, 0.025),
        min_length=1,
        description="voxel sizes for thinning both clouds, metres, coarse to fine",
    )
    max_distances_m: tuple[float, ...] = Field(
        default=(0.3, 0.15, 0.075),
        min_length=1,
        description="largest distance between corresponding points, metres, one per voxel size; "
        "the first is the largest accepted movement of the camera; the last defines the overlap: "
        "the share of the query's points that close to the map",
    )
    depth: DepthCloudOptions = Field(
        default_factory=DepthCloudOptions, description="limits of trusted depths"
    )
    noise: tuple[float, float, float] = Field(
        default=STRUCTURED_LIGHT,
        description="a, b, c of the depth noise a + b z + c z^2 at depth z, metres; weights the "
        "query's pixels",
    )
    accept_always: bool = Field(
        default=False,
        description="accept refined poses without tests of overlap, residual and movement, unless "
        "the condition number is infinite",
    )

    @model_validator(mode="after")
    def _coarse_to_fine(self) -> IcpOptions:
        for name in ("voxels_m", "max_distances_m"):
            values = getattr(self, name)
            if min(values) <= 0 or list(values) != sorted(values, reverse=True):
                raise ValueError(f"{name} must be positive and decreasing: {values}")
        if len(self.voxels_m) != len(self.max_distances_m):
            raise ValueError("voxels_m and max_distances_m must have the same number of levels")
        if (depth_noise(np.linspace(0.0, self.depth.max_depth_m, 256), self.noise) <= 0).any():
            raise ValueError(f"noise must be positive at every depth: {self.noise}")
        return self


@dataclass(frozen=True, eq=False)
class _Level:
    surface: Surface
    points: Floats
    max_distance_m: float

    def fit(self, local_from_cam: RigidTransform, options: IcpOptions) -> SurfaceFit:
        near_m, far_m = self.max_distance_m, options.max_distances_m[0]
        return surface_fit(self.surface, self.points, local_from_cam, near_m=near_m, far_m=far_m)


def refine_by_icp(
    query_points: Floats,
    map_points: Floats,
    cam_from_world: RigidTransform,
    options: IcpOptions,
) -> PoseRefinement:
    """Fit a query's points (N, 3), in the camera frame, to the map's (M, 3), float64 in metres.

    ``measures`` of the result: residuals are median distances from the map's planes within
    ``max_distances_m[0]``, overlaps the shares of points within ``max_distances_m[-1]``.
    """
    # move the origin to the camera, so that coordinates are small
    center = cam_from_world.center()
    local_from_cam = RigidTransform(cam_from_world.inverse().quat_wxyz, (0.0, 0.0, 0.0))
    fine_points = downsample(query_points, options.voxels_m[-1])
    fine_map = downsample(map_points - center, options.voxels_m[-1])
    if len(fine_points) < _MIN_POINTS:
        reason = f"the query's depth has only {len(fine_points)} points"
        return PoseRefinement(cam_from_world, reason)
    if len(fine_map) < _MIN_POINTS:
        return PoseRefinement(cam_from_world, f"the map has only {len(fine_map)} points here")
    coarser = zip(options.voxels_m[:-1], options.max_distances_m[:-1], strict=True)
    levels = [
        _Level(surface_of(downsample(fine_map, voxel_m)), downsample(fine_points, voxel_m), limit_m)
        for voxel_m, limit_m in coarser
    ]
    levels.append(_Level(surface_of(fine_map), fine_points, options.max_distances_m[-1]))
    if reason := _reason_to_skip(levels, local_from_cam, options):
        return PoseRefinement(cam_from_world, reason)
    before = levels[-1].fit(local_from_cam, options)
    measures = {"residual_before_m": before.residual_m, "overlap_before": before.overlap}
    pixels = query_points[:: -(-len(query_points) // _MAX_PIXELS)]
    moved, reason = _fit_levels(levels, pixels, local_from_cam, options)
    if reason:
        return PoseRefinement(cam_from_world, reason, measures)
    after = levels[-1].fit(moved, options)
    # use the coarsest level: on a bare wall, the noisy normals of the finest look like structure
    condition = condition_number(levels[0].fit(moved, options))
    moved_m, moved_deg = _movement(local_from_cam, moved)
    measures |= {
        "residual_after_m": after.residual_m,
        "overlap_after": after.overlap,
        "moved_m": moved_m,
        "moved_deg": moved_deg,
        "condition": condition,
    }
    if reason := _reason_to_refuse(before, after, len(fine_points), condition, options):
        return PoseRefinement(cam_from_world, reason, measures)
    x, y, z = (center + np.array(moved.translation)).tolist()
    world_from_cam = RigidTransform(moved.quat_wxyz, (x, y, z))
    return PoseRefinement(
        world_from_cam.inverse(), measures=measures, covariance=fit_covariance(after)
    )


def _reason_to_skip(
    levels: Sequence[_Level], local_from_cam: RigidTransform, options: IcpOptions
) -> str:
    if options.accept_always:
        return ""
    spacing, limit = levels[-1].surface.spacing(), options.max_distances_m[-1]
    if spacing > limit:
        return (
            f"the map is too sparse here: the {NORMAL_NEIGHBOURS} nearest points reach "
            f"{spacing:.3f} m, at most {limit:g} m is allowed"
        )
    reach = levels[0].fit(local_from_cam, options).reach
    if reach < _MIN_OVERLAP:
        return (
            f"{100 * reach:.0f} % of the query's points are within {options.max_distances_m[0]:g} "
            f"m of the map, but at least {100 * _MIN_OVERLAP:g} % must be"
        )
    return ""


def _fit_levels(
    levels: Sequence[_Level], pixels: Floats, start: RigidTransform, options: IcpOptions
) -> tuple[RigidTransform, str]:
    moved = start
    for level in levels:
        fitted = fit_to_surface(level.surface, level.points, moved, level.max_distance_m)
        if fitted is None:
            return start, "no point of the map is near the query's points"
        moved = fitted
        if reason := _reason_too_far(start, moved, options):
            return start, reason
    finest, noise = levels[-1], depth_noise(pixels[:, 2], options.noise)
    fitted = fit_weighted(finest.surface, pixels, noise, moved, finest.max_distance_m)
    if fitted is None:
        return start, "the surfaces do not determine the pose"
    return fitted, _reason_too_far(start, fitted, options)


def _movement(start: RigidTransform, end: RigidTransform) -> tuple[float, float]:
    moved_m = np.linalg.norm(np.subtract(end.translation, start.translation))
    angle = rotation_angles_deg(np.array(end.quat_wxyz), np.array(start.quat_wxyz))
    return float(moved_m), float(angle)


def _reason_too_far(start: RigidTransform, end: RigidTransform, options: IcpOptions) -> str:
    if options.accept_always:
        return ""
    moved_m, moved_deg = _movement(start, end)
    limit_m = options.max_distances_m[0]
    if moved_m > limit_m:
        return f"the pose moved by {moved_m:.3f} m, at most {limit_m:g} m is allowed"
    if moved_deg > _MAX_MOVED_DEG:
        return f"the pose rotated by {moved_deg:.2f} deg, at most {_MAX_MOVED_DEG:g} deg is allowed"
    return ""


def _reason_to_refuse(
    before: SurfaceFit, after: SurfaceFit, num_points: int, condition: float, options: IcpOptions
) -> str:
    if options.accept_always and math.isfinite(condition):
        return ""
    if after.overlap < _MIN_OVERLAP:
        return (
            f"{100 * after.overlap:.0f} % of the query's points are on the map, "
            f"but at least {100 * _MIN_OVERLAP:g} % must be"
        )
    if condition > _MAX_CONDITION:
        return (
            f"the surfaces do not determine the pose: condition number {condition:.0f}, "
            f"at most {_MAX_CONDITION:g} is allowed"
        )
    # the overlap varies with the voxel grid: tolerate two binomial standard deviations
    noise = 2 * math.sqrt(before.overlap * (1 - before.overlap) / num_points)
    if after.overlap < before.overlap - noise:
        return f"the overlap fell from {before.overlap:.4f} to {after.overlap:.4f}"
    if after.residual_m >= before.residual_m:
        return (
            f"the residual did not fall: {1e3 * before.residual_m:.2f} mm before, "
            f"{1e3 * after.residual_m:.2f} mm after"
        )
    return ""


def map_cloud(
    query_depth: DepthView,
    query_points: Floats,
    cam_from_world: RigidTransform,
    references: Sequence[str],
    scene: RankingScene,
    options: IcpOptions,
) -> Floats:
    """Return the map's points (M, 3) around a query under its estimated pose.

    They come from the depth maps of the references with the most overlap, no two of them within
    0.2 m and 10 deg of each other. Without depth maps they are the map points that the references
    observe, which must be dense.
    """
    margin_m = options.max_distances_m[0]
    low, high = query_points.min(axis=0) - margin_m, query_points.max(axis=0) + margin_m

    def cropped(points: Floats) -> Floats:
        in_camera = cam_from_world.apply(points)
        return points[((in_camera >= low) & (in_camera <= high)).all(axis=1)]

    overlaps = _overlaps(query_depth, cam_from_world, references, scene, options)
    if not overlaps:
        observed = [scene.map_points(name) for name in references]
        return cropped(np.unique(np.concatenate([np.zeros((0, 3)), *observed]), axis=0))
    clouds, voxel_m = [np.zeros((0, 3))], options.voxels_m[-1]
    for name in _different_views(overlaps, scene):
        view = scene.map_depth(name)
        assert view is not None
        step_px = max(1, round(0.5 * voxel_m * focal_px(view.camera) / options.depth.max_depth_m))
        camera, mask = scene.map_camera(name), scene.map_mask(name)
        points = depth_cloud(
            view, options.depth, image_camera=camera, image_mask=mask, step_px=step_px
        )
        # thin per image, since a near image has more pixels per voxel but is no more reliable
        clouds.append(downsample(cropped(scene.map_pose(name).inverse().apply(points)), voxel_m))
    return np.concatenate(clouds)


def _overlaps(
    query_depth: DepthView,
    cam_from_world: RigidTransform,
    references: Sequence[str],
    scene: RankingScene,
    options: IcpOptions,
) -> list[tuple[str, float]]:
    shares = []
    depth_from_world = query_depth.image_from_depth.inverse() @ cam_from_world
    for name in references:
        view = scene.map_depth(name)
        if view is None:
            continue
        points = depth_cloud(view, options.depth, step_px=_OVERLAP_STEP_PX)
        seen = (depth_from_world @ scene.map_pose(name).inverse()).apply(points)
        px = px_from_cam(query_depth.camera, seen)
        depth = values_at(query_depth.depth_m, query_depth.camera, px, outside=0.0)
        with np.errstate(invalid="ignore"):
            agrees = (depth > 0) & (np.abs(seen[:, 2] - depth) <= options.max_distances_m[0])
        shares.append((name, float(agrees.mean()) if len(agrees) else 0.0))
    return sorted(shares, key=lambda each: -each[1])


def _different_views(overlaps: Sequence[tuple[str, float]], scene: RankingScene) -> list[str]:
    names: list[str] = []
    quats, centers = np.zeros((0, 4)), np.zeros((0, 3))
    for name, overlap in overlaps:
        if overlap <= 0 or len(names) == _MAX_REFERENCES:
            break
        pose = scene.map_pose(name)
        quat, center = np.array(pose.quat_wxyz), pose.center()
        near = np.linalg.norm(centers - center, axis=1) < _SAME_VIEW_M
        if (near & (rotation_angles_deg(quats, quat) < _SAME_VIEW_DEG)).any():
            continue
        names.append(name)
        quats, centers = np.vstack([quats, quat]), np.vstack([centers, center])
    return names


class Icp:
    """Plugin ``icp``, which fits the query's depth to the references' depth or dense points."""

    name = "icp"
    Options = IcpOptions

    def __init__(self, options: IcpOptions | None = None) -> None:
        self.options = options or IcpOptions()

    def refine(
        self,
        query: str,
        camera: Camera,
        cam_from_world: RigidTransform,
        references: Sequence[str],
        scene: RankingScene,
    ) -> PoseRefinement:
        options, view = self.options, scene.query_depth(query)
        if view is None:
            return PoseRefinement(cam_from_world, "the query has no depth")
        mask = scene.query_mask(query)
        points = depth_cloud(view, options.depth, image_camera=camera, image_mask=mask)
        if not len(points):
            return PoseRefinement(cam_from_world, "the query's depth has no usable points")
        cloud = map_cloud(view, points, cam_from_world, references, scene, options)
        return refine_by_icp(points, cloud, cam_from_world, options)
