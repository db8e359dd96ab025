"""How much of what one view shows can be seen, or recognised, in others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.cameras import reduced
from megloc_kapture.datasets.synthetic.render import (
    depth_map,
    intrinsics,
    project,
    sample_grid,
    visible_surfaces,
)
from megloc_kapture.datasets.synthetic.surfaces import Surfaces
from megloc_kapture.values import Camera, RigidTransform

_REDUCTION = 8
_STRIDE = 4
_DEPTH_TOLERANCE = 0.05  # relative; the other view's depth is read at the nearest coarse pixel
# what SIFT bears between two views of a point: angle between the rays, ratio of sizes and of
# foreshortenings
_MAX_ANGLE_DEG = 32.0
_MAX_SIZE_RATIO = 2.0
_MIN_BASELINE_DEG = 1.5  # less gives a point without depth

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CoarseView:
    """A view's depth at an eighth of its resolution, and points on a sparse grid of it.

    Parameters
    ----------
    camera, cam_from_world : of the view; the frame is that of the surfaces.
    depth : float32 (h, w), metres, 0 where nothing is seen.
    points, normals : float64 (P, 3), what the view sees, in the surfaces' frame.
    """

    camera: Camera
    cam_from_world: RigidTransform
    depth: NDArray[np.float32]
    points: Floats
    normals: Floats


def coarse_view(surfaces: Surfaces, camera: Camera, cam_from_world: RigidTransform) -> CoarseView:
    """Look at surfaces coarsely."""
    grid = sample_grid(reduced(camera, _REDUCTION), 1)
    seen = visible_surfaces(surfaces, cam_from_world, grid)
    depth = depth_map(seen)
    sparse = np.s_[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE]
    z = depth[sparse].astype(np.float64)
    x = np.broadcast_to(grid.x, depth.shape)[sparse] * z
    y = np.broadcast_to(grid.y, depth.shape)[sparse] * z
    in_camera = np.stack([x, y, z], axis=-1)[z > 0]
    return CoarseView(
        camera,
        cam_from_world,
        depth,
        points=cam_from_world.inverse().apply(in_camera),
        normals=surfaces.normals()[seen.surface[sparse][z > 0]],
    )


def visible(points: Floats, view: CoarseView) -> Bools:
    """Which points (P, 3) a view sees, bool (P,)."""
    in_camera = view.cam_from_world.apply(points)
    z = in_camera[:, 2]
    small = reduced(view.camera, _REDUCTION)
    ahead = np.where((z > 0.1)[:, None], in_camera, [0.0, 0.0, 1.0])
    column, row = np.floor(project(small, ahead)).astype(np.int64).T
    inside = (column >= 0) & (column < small.width) & (row >= 0) & (row < small.height)
    inside &= z > 0.1
    seen = view.depth[np.where(inside, row, 0), np.where(inside, column, 0)]
    return inside & (np.abs(seen - z) < _DEPTH_TOLERANCE * z + 0.05)


def overlap(view: CoarseView, other: CoarseView) -> float:
    """Share (0..1) of what ``view`` sees that ``other`` sees too."""
    return float(visible(view.points, other).mean()) if len(view.points) else 0.0


def support(view: CoarseView, others: Sequence[CoarseView]) -> float:
    """Share (0..1) of what ``view`` sees that a map of the ``others`` can tell it.

    A point counts when another view sees it similarly enough to match, and a third view is there
    to triangulate it with.
    """
    if not len(view.points) or len(others) < 2:
        return 0.0
    sees = np.stack([visible(view.points, other) for other in others])
    rays, sizes, slants = map(
        np.stack, zip(*(_aspect(view, other) for other in others), strict=True)
    )
    ray, size, slant = _aspect(view, view)
    matches = sees & _similar((rays * ray).sum(-1), sizes / size, slants / slant)
    between = np.einsum("apk,bpk->abp", rays, rays)
    alike = _similar(between, sizes[:, None] / sizes[None], slants[:, None] / slants[None])
    pairs = alike & (between < np.cos(np.radians(_MIN_BASELINE_DEG))) & sees[:, None] & sees[None]
    return float((matches & pairs.any(axis=1)).any(axis=0).mean())


def _aspect(points_of: CoarseView, view: CoarseView) -> tuple[Floats, Floats, Floats]:
    """How ``view`` looks at the points of another: unit rays (P, 3), sizes and slants (P,)."""
    difference = points_of.points - view.cam_from_world.center()
    distance = np.linalg.norm(difference, axis=1)
    rays = difference / distance[:, None]
    slant = np.clip(-(rays * points_of.normals).sum(1), 0.02, None)
    return rays, intrinsics(view.camera)[0] / distance, slant


def _similar(cosine: Floats, size_ratio: Floats, slant_ratio: Floats) -> Bools:
    limit = np.log(_MAX_SIZE_RATIO)
    similar: Bools = cosine > np.cos(np.radians(_MAX_ANGLE_DEG))
    return similar & (np.abs(np.log(size_ratio)) < limit) & (np.abs(np.log(slant_ratio)) < limit)
