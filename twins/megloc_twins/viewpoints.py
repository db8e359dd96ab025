"""Viewpoints of queries: away from the map's cameras, but covered by its images."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import TypeVar

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from megloc_kapture.values import Camera, RigidTransform
from megloc_twins.frames import Frame, day_lighting, night_lighting, reduced
from megloc_twins.moving_objects import place_moving_objects
from megloc_twins.options import SyntheticWorldOptions, stream
from megloc_twins.portable import Bools, Float32, Float64, looking_at
from megloc_twins.rasterization import depth_map, intrinsics, project, sample_grid, visible_surfaces
from megloc_twins.squares import Place
from megloc_twins.surfaces import Surfaces

_DEPTH_TOLERANCE = 0.05  # relative; the other view's depth is read at the nearest coarse pixel
# largest differences between two views of a point that SIFT can match: angle between the rays,
# ratios of sizes and of foreshortenings
_MAX_ANGLE_DEG = 32.0
_MAX_SIZE_RATIO = 2.0
_MIN_BASELINE_DEG = 1.5  # smallest triangulation angle of a point

_MAX_OVERLAP = 0.85  # with any map image, so that no query is almost a copy
_MIN_SUPPORT = 0.6  # share of a query's view that the map covers
_ATTEMPTS = 300

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class CoarseView:
    """A view's depth at reduced resolution, and visible points on a sparse grid of it."""

    camera: Camera  # of that resolution
    cam_from_world: RigidTransform
    depth: Float32  # (h, w), metres, 0 without a surface
    points: Float64  # (P, 3), in the surfaces' frame
    normals: Float64  # (P, 3)
    surface: NDArray[np.int16]  # (P,), indices


def coarse_view(
    surfaces: Surfaces,
    camera: Camera,
    cam_from_world: RigidTransform,
    *,
    reduction: int = 8,
    stride: int = 4,
) -> CoarseView:
    """Return a reduced view, with points from every ``stride``-th row and column of it."""
    grid = sample_grid(reduced(camera, reduction), 1)
    seen = visible_surfaces(surfaces, cam_from_world, grid)
    depth = depth_map(seen)
    sparse = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    z = depth[sparse].astype(np.float64)
    points = cam_from_world.inverse().apply((grid.rays()[sparse] * z[..., None])[z > 0])
    surface = seen.surface[sparse][z > 0]
    normals = surfaces.normals()[surface]
    return CoarseView(grid.camera, cam_from_world, depth, points, normals, surface)


def visible(points: Float64, view: CoarseView) -> Bools:
    """Return the visibility, bool (P,), of points (P, 3) in a view."""
    in_camera = view.cam_from_world.apply(points)
    z = in_camera[:, 2]
    ahead = np.where((z > 0.1)[:, None], in_camera, [0.0, 0.0, 1.0])
    column, row = np.floor(project(view.camera, ahead)).astype(np.int64).T
    height, width = view.depth.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    inside &= z > 0.1
    seen = view.depth[np.where(inside, row, 0), np.where(inside, column, 0)]
    return inside & (np.abs(seen - z) < _DEPTH_TOLERANCE * z + 0.05)


def overlap(view: CoarseView, other: CoarseView) -> float:
    """Return the share (0..1) of points of ``view`` that ``other`` also sees."""
    return float(visible(view.points, other).mean()) if len(view.points) else 0.0


def support(view: CoarseView, others: Sequence[CoarseView]) -> float:
    """Return the share (0..1) of points of ``view`` that a map of the views ``others`` covers.

    A point counts if one of the others sees it similarly enough to match, and a further view
    triangulates it.
    """
    if not len(view.points) or len(others) < 2:
        return 0.0
    sees = np.stack([visible(view.points, other) for other in others])
    aspects = [_aspect(view, other) for other in others]
    rays, sizes, slants = (np.stack(parts) for parts in zip(*aspects, strict=True))
    ray, size, slant = _aspect(view, view)
    matches = sees & _similar((rays * ray).sum(-1), sizes / size, slants / slant)
    between = np.einsum("apk,bpk->abp", rays, rays)
    alike = _similar(between, sizes[:, None] / sizes[None], slants[:, None] / slants[None])
    pairs = alike & (between < np.cos(np.radians(_MIN_BASELINE_DEG))) & sees[:, None] & sees[None]
    return float((matches & pairs.any(axis=1)).any(axis=0).mean())


def _aspect(points_of: CoarseView, view: CoarseView) -> tuple[Float64, Float64, Float64]:
    """Return unit rays (P, 3), sizes and slants (P,) of a view's points as seen in ``view``."""
    difference = points_of.points - view.cam_from_world.center()
    distance = np.linalg.norm(difference, axis=1)
    rays = difference / distance[:, None]
    slant = np.clip(-(rays * points_of.normals).sum(1), 0.02, None)
    return rays, intrinsics(view.camera)[0] / distance, slant


def _similar(cosine: Float64, size_ratio: Float64, slant_ratio: Float64) -> Bools:
    limit = np.log(_MAX_SIZE_RATIO)
    similar: Bools = cosine > np.cos(np.radians(_MAX_ANGLE_DEG))
    return similar & (np.abs(np.log(size_ratio)) < limit) & (np.abs(np.log(slant_ratio)) < limit)


def query_frames(
    options: SyntheticWorldOptions, place: Place, mapping: list[Frame], condition: str, total: int
) -> Iterator[Frame]:
    """Yield the queries of a condition in one place, out of ``total`` in all places."""
    map_views = views_of(place, mapping)
    for number in range(place.index, total, options.num_places):
        sensor_id = f"{condition}_{number:05d}"
        image = f"query/{condition}/{number:05d}.jpg"
        rng = stream(options.seed, "query", sensor_id)
        camera = query_camera(options, rng)
        poses = _query_poses(place, camera, map_views, rng)
        position, yaw, cam_from_place = first_fitting(poses)
        if condition == "night":
            lighting = night_lighting(rng)
        else:
            sun = float(rng.uniform(-np.pi, np.pi)), float(np.radians(rng.uniform(35, 60)))
            lighting = day_lighting(rng, sun, overcast=float(rng.choice([0.1, 0.5, 1.0])))
        yield Frame(
            name=image,
            condition=condition,
            place=place.index,
            timestamp=(100_000 if condition == "day" else 200_000) + number,
            sensor_id=sensor_id,
            camera=camera,
            cam_from_world=cam_from_place @ place.place_from_world,
            lighting=lighting,
            noise_seed=options.noise_seed(image),
            moving_objects=place_moving_objects(
                place.plan, rng, options.moving_objects, position, yaw
            ),
        )


def views_of(place: Place, frames: Iterable[Frame]) -> list[CoarseView]:
    """Return coarse views of the frames of a place, in the place's coordinates."""
    return [coarse_view(place.surfaces, f.camera, place.cam_from_place(f)) for f in frames]


def query_camera(options: SyntheticWorldOptions, rng: Generator) -> Camera:
    """Draw a phone's camera: focal length, principal point and distortion."""
    width, height = options.width, options.height
    focal = rng.uniform(0.7, 0.95) * width
    cx, cy = width / 2 + rng.normal(0, 2), height / 2 + rng.normal(0, 2)
    return Camera("SIMPLE_RADIAL", width, height, (focal, cx, cy, rng.uniform(-0.09, 0.04)))


def _query_poses(
    place: Place, camera: Camera, map_views: list[CoarseView], rng: Generator
) -> Iterator[tuple[float, tuple[Float64, float, RigidTransform]]]:
    """Yield the :func:`misfit` of random viewpoints away from obstacles, and the viewpoint.

    A viewpoint is a position (3,), a yaw and ``cam_from_place``.
    """
    low, high = place.plan.outline.min(0), place.plan.outline.max(0)
    for _ in range(_ATTEMPTS):
        x, y = (float(v) for v in rng.uniform(low, high))
        yaw = float(rng.uniform(-np.pi, np.pi))
        pitch, roll = float(rng.normal(0.04, 0.06)), float(rng.normal(0, 0.06))
        position = np.array([x, y, rng.uniform(1.45, 1.8)])
        if not place.plan.is_free(x, y, 0.9):
            continue
        pose = looking_at(position, yaw, pitch, roll)
        view = coarse_view(place.surfaces, camera, pose)
        depth = view.depth[view.depth > 0]
        if np.percentile(depth, 10) >= 1.2 and np.median(depth) >= 3.5:
            yield misfit(view, map_views), (position, yaw, pose)


def misfit(view: CoarseView, map_views: Sequence[CoarseView], *, min_overlap: float = 0.0) -> float:
    """Measure how much a view lacks support from the map or repeats a map image; 0 is good.

    Map images with an overlap of at most ``min_overlap`` give no support.
    """
    shares = [overlap(view, other) for other in map_views]
    seen = [o for o, share in zip(map_views, shares, strict=True) if share > min_overlap]
    return max(_MIN_SUPPORT - support(view, seen), max(shares) - _MAX_OVERLAP, 0.0)


def first_fitting(candidates: Iterable[tuple[float, Item]]) -> Item:
    """Return the first candidate with misfit 0, else the one with the smallest misfit.

    ``candidates`` are pairs (misfit, candidate); none is drawn after a misfit of 0.
    """
    drawn = []
    for misfit_and_candidate in candidates:
        drawn.append(misfit_and_candidate)
        if misfit_and_candidate[0] == 0.0:
            break
    return min(drawn, key=itemgetter(0))[1]
