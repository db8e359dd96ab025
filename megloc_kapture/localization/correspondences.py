"""2D-3D matches of a query, from its matches with map images and the map's observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.localization.map_index import MapIndex


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


@dataclass(frozen=True, eq=False)
class ObservedMatches:
    """Matches of a query with map keypoints that observe a point, conflicts and all.

    Attributes
    ----------
    keypoint_ids : int64 (M,), rows of the query's keypoints, not negative.
    point_ids : int64 (M,), rows of the map's points, not negative.
    similarities : float64 (M,), higher is better.
    image_rows : int64 (M,), which of the map images the match is with, from 0.
    num_images : int, of the map images, whether they have matches or not.
    """

    keypoint_ids: NDArray[np.int64]
    point_ids: NDArray[np.int64]
    similarities: NDArray[np.float64]
    image_rows: NDArray[np.int64]
    num_images: int

    def resolve(self, rows: NDArray[np.bool_] | None = None) -> Correspondences:
        """One point per keypoint and one keypoint per point, of the matches with some images.

        The same keypoint can meet several points through different map images, and the reverse.
        What most images say wins; then the most similar descriptors; then the smaller ids.
        Conflicts are settled greedily from the best on, so that a loser may still get its second
        choice. Images that are left out have no say.

        Parameters
        ----------
        rows : bool (num_images,), the images whose matches count; all where it is None.
        """
        from megloc_kapture.localization import index_kernels

        if rows is None:
            rows = np.ones(self.num_images, dtype=np.bool_)
        elif rows.shape != (self.num_images,):
            raise ValueError(f"rows has shape {rows.shape}, expected ({self.num_images},)")
        found = index_kernels.resolve(
            self.keypoint_ids, self.point_ids, self.similarities, self.image_rows, rows
        )
        return Correspondences(*found)


def observed_matches(
    index: MapIndex,
    matches: Sequence[tuple[str, NDArray[np.integer[Any]], NDArray[np.floating[Any]]]],
) -> ObservedMatches:
    """The matches whose map keypoint observes a point.

    Parameters
    ----------
    matches : of each map image: its name, rows of query and map keypoints (K, 2), scores (K,). An
        image that is not in the map has nothing to say.
    """
    from megloc_kapture.localization import index_kernels

    if not matches:
        empty = np.zeros(0, dtype=np.int64)
        return ObservedMatches(empty, empty, np.zeros(0), empty, 0)
    starts = np.zeros(len(matches) + 1, dtype=np.int64)
    np.cumsum([len(pairs) for _, pairs, _ in matches], out=starts[1:])
    keypoint_ids, point_ids, similarities, image_rows = index_kernels.observed(
        index.offsets,
        index.keypoint_ids,
        index.point_ids,
        index.rows_of([image for image, _, _ in matches]),
        starts,
        np.concatenate([pairs for _, pairs, _ in matches], dtype=np.int64),
        np.concatenate([scores for _, _, scores in matches], dtype=np.float64),
    )
    return ObservedMatches(keypoint_ids, point_ids, similarities, image_rows, len(matches))
