"""What a pose is estimated from: the 2D-3D matches of one camera, or of each camera of a rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.values import Camera, RigidTransform


@dataclass(frozen=True, eq=False)
class View:
    """One camera and its matches; a camera on its own is a rig of one, at its origin.

    Attributes
    ----------
    camera : the intrinsics.
    cam_from_rig : the camera in its rig; the identity for a camera on its own.
    points_px : float (N, 2) pixels, first pixel's centre at (0.5, 0.5).
    points_world : float64 (N, 3) the points that they are matched with.
    point_covariances : float64 (N, 6) of the points as xx, xy, xz, yy, yz, zz in the map's unit
        squared, for a measurement noise of 1 px, not finite where unknown; or None. An unknown
        covariance counts as none at all.

    Raises
    ------
    DataError : the arrays do not have these shapes.
    """

    camera: Camera
    cam_from_rig: RigidTransform
    points_px: NDArray[np.floating[Any]]
    points_world: NDArray[np.float64]
    point_covariances: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        count = len(self.points_px)
        if self.points_px.shape != (count, 2) or self.points_world.shape != (count, 3):
            raise DataError(
                f"pixels {self.points_px.shape} and points {self.points_world.shape} of a view "
                "are not (N, 2) and (N, 3)"
            )
        if self.point_covariances is not None and self.point_covariances.shape != (count, 6):
            raise DataError(
                f"covariances {self.point_covariances.shape} of {count} points are not ({count}, 6)"
            )


def split_by_view(views: Sequence[View], per_match: NDArray[Any]) -> list[NDArray[Any]]:
    """One part for each view of what runs over the matches of all views, such as inliers (N,)."""
    return np.split(per_match, np.cumsum([len(view.points_px) for view in views])[:-1])


@dataclass(frozen=True, eq=False)
class StackedViews:
    """All matches of all views in arrays, as the compiled loops read them.

    Attributes
    ----------
    views : what was stacked.
    points_px, points : float64 (N, 2) and (N, 3), the latter minus ``offset``.
    covariances : float64 (N, 6), or (0, 6) where no view has any.
    starts : int64 (V + 1,) first match of each view.
    rotations, translations : float64 (V, 3, 3) and (V, 3) of ``cam_from_rig``.
    models, params : int64 (V,) and float64 (V, 12) as :mod:`megloc_kapture.geometry.projection`
        numbers and packs them.
    offset : float64 (3,) a place amid the points: far from the origin (ECEF) float64 loses what
        a recentred world keeps.
    """

    views: tuple[View, ...]
    points_px: NDArray[np.float64]
    points: NDArray[np.float64]
    covariances: NDArray[np.float64]
    starts: NDArray[np.int64]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    models: NDArray[np.int64]
    params: NDArray[np.float64]
    offset: NDArray[np.float64]


def stack_views(views: Sequence[View]) -> StackedViews:
    """The arrays of any number of views, with the same matches in the same order."""
    from megloc_kapture.geometry.projection import model_id, packed_params

    starts = np.zeros(len(views) + 1, dtype=np.int64)
    np.cumsum([len(view.points_px) for view in views], out=starts[1:])
    world = _joined([view.points_world for view in views], 3)
    offset = _amid(world)
    covariances = np.zeros((0, 6))
    if any(view.point_covariances is not None for view in views):
        covariances = _joined(
            [
                np.zeros((len(view.points_px), 6))
                if view.point_covariances is None
                else view.point_covariances
                for view in views
            ],
            6,
        )
    cams_from_rig = [view.cam_from_rig for view in views]
    return StackedViews(
        views=tuple(views),
        points_px=_joined([view.points_px for view in views], 2),
        points=world - offset,
        covariances=covariances,
        starts=starts,
        rotations=np.array([c.rotation_matrix() for c in cams_from_rig]).reshape(-1, 3, 3),
        translations=np.array([c.translation for c in cams_from_rig]).reshape(-1, 3),
        models=np.array([model_id(view.camera) for view in views], dtype=np.int64),
        params=np.array([packed_params(view.camera) for view in views]).reshape(-1, 12),
        offset=offset,
    )


def _joined(parts: Sequence[NDArray[np.floating[Any]]], width: int) -> NDArray[np.float64]:
    return np.concatenate([np.zeros((0, width)), *parts], dtype=np.float64)


def _amid(points: NDArray[np.float64]) -> NDArray[np.float64]:
    # the median of some of them: any place nearby serves, and wrong points must not move it far
    some = points[:: max(1, len(points) // 64)]
    some = np.sort(some[np.isfinite(some).all(axis=1)], axis=0)
    return some[len(some) // 2] if len(some) else np.zeros(3)


def undo_recentring(pose: RigidTransform, offset: NDArray[np.float64]) -> RigidTransform:
    """``rig_from_world`` of a pose in a world that was moved by minus ``offset`` (3,)."""
    t = np.array(pose.translation) - pose.rotation_matrix() @ offset
    return RigidTransform(pose.quat_wxyz, (float(t[0]), float(t[1]), float(t[2])))
