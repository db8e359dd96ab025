"""2D-3D matches of a query, from its matches with map images and the map's observations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Correspondences:
    """2D-3D matches: every keypoint and every point at most once.

    Attributes
    ----------
    keypoint_ids : int64 (N,), rows of the query's keypoints, ascending.
    point_ids : int64 (N,), rows of the map's points.
    support : int64 (N,), number of map images that say so.
    """

    keypoint_ids: NDArray[np.int64]
    point_ids: NDArray[np.int64]
    support: NDArray[np.int64]


def resolve(
    keypoint_ids: NDArray[np.int64],
    point_ids: NDArray[np.int64],
    similarities: NDArray[np.floating],
) -> Correspondences:
    """One point per keypoint and one keypoint per point.

    The same keypoint can meet several points through different map images, and the reverse. What
    most images say wins; then the most similar descriptors; then the smaller ids. Conflicts are
    settled greedily from the best on, so that a loser may still get its second choice.

    Parameters
    ----------
    keypoint_ids, point_ids : int64 (M,), one row per match with an observed map keypoint.
    similarities : (M,), higher is better.
    """
    if len(keypoint_ids) == 0:
        empty = np.zeros(0, dtype=np.int64)
        return Correspondences(empty, empty, empty)
    pairs, inverse, support = np.unique(
        np.stack([keypoint_ids, point_ids], axis=1),
        axis=0,
        return_inverse=True,
        return_counts=True,
    )
    best = np.full(len(pairs), -np.inf)
    np.maximum.at(best, inverse.reshape(-1), np.asarray(similarities, dtype=np.float64))
    order = np.lexsort((pairs[:, 1], pairs[:, 0], -best, -support))
    taken_keypoints: set[int] = set()
    taken_points: set[int] = set()
    chosen = []
    for row, (keypoint, point) in zip(order.tolist(), pairs[order].tolist(), strict=True):
        if keypoint in taken_keypoints or point in taken_points:
            continue
        taken_keypoints.add(keypoint)
        taken_points.add(point)
        chosen.append(row)
    rows = np.sort(np.array(chosen, dtype=np.int64))
    return Correspondences(pairs[rows, 0], pairs[rows, 1], support[rows].astype(np.int64))
