"""How much of what one view shows can be seen in another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.cameras import reduced
from megloc_kapture.datasets.synthetic.render import (
    depth_map,
    project,
    sample_grid,
    visible_surfaces,
)
from megloc_kapture.datasets.synthetic.surfaces import Surfaces
from megloc_kapture.values import Camera, RigidTransform

_REDUCTION = 8
_STRIDE = 4
_DEPTH_TOLERANCE = 0.05  # relative; the other view's depth is read at the nearest coarse pixel


@dataclass(frozen=True, eq=False)
class CoarseView:
    """A view's depth at an eighth of its resolution, and points on a sparse grid of it.

    Parameters
    ----------
    camera, cam_from_world : of the view; the frame is that of the surfaces.
    depth : float32 (h, w), metres, 0 where nothing is seen.
    points : float64 (P, 3), what the view sees.
    """

    camera: Camera
    cam_from_world: RigidTransform
    depth: NDArray[np.float32]
    points: NDArray[np.float64]


def coarse_view(surfaces: Surfaces, camera: Camera, cam_from_world: RigidTransform) -> CoarseView:
    """Look at surfaces coarsely."""
    grid = sample_grid(reduced(camera, _REDUCTION), 1)
    depth = depth_map(visible_surfaces(surfaces, cam_from_world, grid))
    sparse = np.s_[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE]
    z = depth[sparse].astype(np.float64)
    x = np.broadcast_to(grid.x, depth.shape)[sparse] * z
    y = np.broadcast_to(grid.y, depth.shape)[sparse] * z
    in_camera = np.stack([x, y, z], axis=-1)[z > 0]
    points = cam_from_world.inverse().apply(in_camera)
    return CoarseView(camera, cam_from_world, depth, points)


def overlap(view: CoarseView, other: CoarseView) -> float:
    """Share (0..1) of what ``view`` sees that ``other`` sees too."""
    if not len(view.points):
        return 0.0
    in_other = other.cam_from_world.apply(view.points)
    in_other = in_other[in_other[:, 2] > 0.1]
    small = reduced(other.camera, _REDUCTION)
    column, row = np.floor(project(small, in_other)).astype(np.int64).T
    inside = (column >= 0) & (column < small.width) & (row >= 0) & (row < small.height)
    z = in_other[inside, 2]
    seen = other.depth[row[inside], column[inside]]
    agree = np.abs(seen - z) < _DEPTH_TOLERANCE * z + 0.05
    return float(np.count_nonzero(agree)) / len(view.points)
