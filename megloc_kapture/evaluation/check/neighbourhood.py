"""How near poses are to the map's cameras, in position and in orientation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.evaluation.check.reference import MapCameras

# how many map cameras a pose's orientation is compared with: a panoramic scan has 36 of one centre
_NEIGHBOURS = 48
# a neighbour may be this much farther than the nearest: which one it is does not matter far away,
# and a tree finds it many times faster
_TREE_SLACK = 0.2
# cameras nearer to each other than this share of the extent stand in one place
_ONE_PLACE = 1 / 200
# this many spacings, or this share of the extent, from a map camera a pose is still near it
_NEAR_SPACINGS, _NEAR_EXTENT = 10.0, 0.1
# coordinates that no map has; their squares must not overflow
_INFINITE = 1e100
# orientations this near are alike, beyond the second all are equally unlike; what one counts
_ALIKE_DEG, _UNLIKE_DEG, _ANGLE_SCALE_DEG = 45.0, 90.0, 20.0


@dataclass(frozen=True, eq=False)
class Nearness:
    """N poses among the map's cameras.

    Parameters
    ----------
    distance : float64 (N,), to the nearest camera, in the map's unit; infinite without any.
    score : float64 (N,), how well each pose fits: 0 is best. It is that of the map camera which is
        most alike, in distance and orientation together, and falls with the logarithm of both.
        Distances count in spacings of the map's cameras, so that a table top and a city are alike.
    fits : bool (N,), whether a camera that is near looks alike.
    near : float64 (N,), the distance up to which a camera of its pool is near.
    extent : float64 (N,), of the cameras of its pool.
    """

    distance: NDArray[np.float64]
    score: NDArray[np.float64]
    fits: NDArray[np.bool_]
    near: NDArray[np.float64]
    extent: NDArray[np.float64]


class Neighbourhood:
    """The map's cameras, by pools: each pose is compared with the cameras of its pool only.

    The spacing of a pool is the median distance from a place to the next, where cameras that
    stand together (a rig, a panoramic scan) are one place; infinite where there is only one.

    Parameters
    ----------
    cameras : of the map.
    pools : positions in ``cameras``, int64 (K,) each, K > 0.
    """

    def __init__(self, cameras: MapCameras, pools: Sequence[NDArray[np.int64]]) -> None:
        self._rows = np.concatenate(pools)
        self._pool_of_row = np.repeat(np.arange(len(pools)), [len(pool) for pool in pools])
        self._quats, self._centers = cameras.quats, cameras.centers
        # pools lie apart in a fourth dimension, so that one tree and one call serve all of them
        size = float(np.ptp(cameras.centers, axis=0).max()) if len(cameras.centers) else 0.0
        self._gap = 1e4 * (size or 1.0)
        self._tree = cKDTree(self._placed(cameras.centers[self._rows], self._pool_of_row))
        scales = [_scales(cameras.centers[pool]) for pool in pools]
        self.spacing, self.near, self.extent = np.array(scales).T

    def look(
        self,
        quats: NDArray[np.float64],
        centers: NDArray[np.float64],
        pools: NDArray[np.int64],
    ) -> Nearness:
        """How near poses are to the cameras of their pools.

        Parameters
        ----------
        quats, centers : float64 (N, 4) and (N, 3), of ``cam_from_local``; a centre that is not
            finite is infinitely far.
        pools : int64 (N,).
        """
        count = min(_NEIGHBOURS, len(self._rows))
        with np.errstate(invalid="ignore"):
            finite = np.abs(centers).max(axis=1, initial=0.0) < _INFINITE
        centers = np.where(finite[:, None], centers, 0.0)
        placed = self._placed(centers, pools)
        _, found = self._tree.query(placed, k=np.arange(1, count + 1), eps=_TREE_SLACK)
        same = (self._pool_of_row[found] == pools[:, None]) & finite[:, None]
        cameras = self._rows[found]
        offsets = self._centers[cameras] - centers[:, None]
        distance = np.where(same, np.linalg.norm(offsets, axis=2), np.inf)
        cosine = np.abs(np.einsum("nkd,nd->nk", self._quats[cameras], quats))
        angle_deg = np.rad2deg(2.0 * np.arccos(np.minimum(cosine, 1.0)))
        near = self.near[pools]
        turned = np.log1p((np.minimum(angle_deg, _UNLIKE_DEG) / _ANGLE_SCALE_DEG) ** 2)
        with np.errstate(invalid="ignore"):
            spacings = np.where(same, distance / self.spacing[pools, None], np.inf)
        score = -np.log1p(spacings) - turned
        alike = same & (distance <= near[:, None]) & (angle_deg <= _ALIKE_DEG)
        return Nearness(
            distance.min(axis=1), score.max(axis=1), alike.any(axis=1), near, self.extent[pools]
        )

    def _placed(
        self, centers: NDArray[np.float64], pools: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        return np.column_stack([centers, pools * self._gap])


def _scales(centers: NDArray[np.float64]) -> tuple[float, float, float]:
    """Spacing, the distance that is near, and the extent of the cameras of one pool."""
    extent = float(np.quantile(np.linalg.norm(centers - np.median(centers, axis=0), axis=1), 0.9))
    if extent == 0.0:
        return np.inf, np.inf, np.inf
    places = np.unique(np.round(centers / (extent * _ONE_PLACE)), axis=0) * extent * _ONE_PLACE
    if len(places) < 2:
        return np.inf, np.inf, np.inf
    spacing = float(np.median(cKDTree(places).query(places, k=2)[0][:, 1]))
    return spacing, max(_NEAR_SPACINGS * spacing, _NEAR_EXTENT * extent), extent
