"""A map's points and observations as arrays, and the 2D-3D matches of a query with them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class MapIndex:
    """Observations grouped by image; read-only, and safe to use from many threads.

    Attributes
    ----------
    xyz : float64 (N, 3), the points in the world frame.
    row_of_image : image name -> row of ``offsets``.
    offsets : int64 (I + 1,); image i's observations are rows offsets[i] to offsets[i + 1].
    keypoint_ids : int32 (O,), ascending within an image.
    point_ids : int32 (O,), rows of ``xyz``.
    covariances : float64 (N, 6) of the points as xx, xy, xz, yy, yz, zz in the map's unit squared,
        for a measurement noise of 1 px, NaN where unknown; None where the map has none.
    local_type : the keypoints type that it is of; empty where nobody asks.
    noise_rad, noise_px : median angle, and distance in the image, between an observation and its
        point, seen by the map's image; NaN where they are not known.
    """

    xyz: NDArray[np.float64]
    row_of_image: dict[str, int]
    offsets: NDArray[np.int64]
    keypoint_ids: NDArray[np.int32]
    point_ids: NDArray[np.int32]
    covariances: NDArray[np.float64] | None = None
    local_type: str = ""
    noise_rad: float = math.nan
    noise_px: float = math.nan

    @classmethod
    def build(
        cls,
        xyz: NDArray[np.float64],
        image_names: tuple[str, ...],
        image_ids: NDArray[np.integer[Any]],
        keypoint_ids: NDArray[np.integer[Any]],
        point_ids: NDArray[np.integer[Any]],
        covariances: NDArray[np.float64] | None = None,
    ) -> MapIndex:
        """Group observations, given as parallel arrays (O,), by image and keypoint."""
        from megloc_kapture.localization import index_kernels

        counts = np.bincount(image_ids, minlength=len(image_names))
        offsets = np.zeros(len(image_names) + 1, dtype=np.int64)
        np.cumsum(counts, out=offsets[1:])
        keypoints = np.empty(len(image_ids), dtype=np.int32)
        points = np.empty(len(image_ids), dtype=np.int32)
        index_kernels.group_by_image(image_ids, keypoint_ids, point_ids, offsets, keypoints, points)
        return cls(
            xyz=_read_only(np.ascontiguousarray(xyz, dtype=np.float64)),
            row_of_image={name: row for row, name in enumerate(image_names)},
            offsets=_read_only(offsets),
            keypoint_ids=_read_only(keypoints),
            point_ids=_read_only(points),
            covariances=covariances,
        )

    @cached_property
    def seen_once(self) -> NDArray[np.bool_]:
        """Points (N,) that one image observes: lifted through its depth, not triangulated."""
        return np.bincount(self.point_ids, minlength=len(self.xyz)) == 1

    def observed(self, image: str) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Keypoint rows (ascending) and their point rows of one image; empty if it has none."""
        row = self.row_of_image.get(image)
        if row is None:
            return self.keypoint_ids[:0], self.point_ids[:0]
        part = slice(self.offsets[row], self.offsets[row + 1])
        return self.keypoint_ids[part], self.point_ids[part]

    def points_of_keypoints(
        self, image: str, keypoint_ids: NDArray[np.integer]
    ) -> NDArray[np.int64]:
        """Point row of each keypoint of a map image, -1 where it observes none; int64 (K,)."""
        keypoints, points = self.observed(image)
        found = np.full(len(keypoint_ids), -1, dtype=np.int64)
        if len(keypoints) == 0 or len(keypoint_ids) == 0:
            return found
        rows = np.minimum(np.searchsorted(keypoints, keypoint_ids), len(keypoints) - 1)
        hit = keypoints[rows] == keypoint_ids
        found[hit] = points[rows[hit]]
        return found

    def seen_by(self, images: Sequence[str]) -> NDArray[np.float64]:
        """The points that some of the images observe, each once, (K, 3)."""
        seen = np.zeros(len(self.xyz), dtype=np.bool_)
        for image in images:
            seen[self.observed(image)[1]] = True
        return self.xyz[np.flatnonzero(seen)]

    def rows_of(self, images: Sequence[str]) -> NDArray[np.int64]:
        """Row of each image in ``offsets``, -1 where it is not in the map; int64 (n,)."""
        return np.array([self.row_of_image.get(image, -1) for image in images], dtype=np.int64)

    def shared_points(self, images: Sequence[str]) -> NDArray[np.int64]:
        """Number of points that every two of the images both observe, int64 (n, n), symmetric.

        The diagonal has the points that an image observes. The cost grows with these images'
        observations, not with the map; an image that is not in the map shares nothing.
        """
        from megloc_kapture.localization import index_kernels

        rows = self.rows_of(images)
        keys = index_kernels.sightings(self.offsets, self.point_ids, rows)
        keys.sort()
        shared = np.zeros((len(rows), len(rows)), dtype=np.int64)
        index_kernels.count_shared(keys, shared)
        return shared


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    """The array, not to be written to: also the one kind that the compiled loops then meet."""
    view = array.view()
    view.setflags(write=False)
    return view


@dataclass(frozen=True, eq=False)
class Correspondences:
    """2D-3D matches: every keypoint and every point at most once.

    Attributes
    ----------
    keypoint_ids : int64 (N,), rows of the query's keypoints, ascending.
    point_ids : int64 (N,), rows of the map's points.
    support : int64 (N,), number of map images that say so.
    image_rows : int64 (sum of support,), these images, match by match.
    """

    keypoint_ids: NDArray[np.int64]
    point_ids: NDArray[np.int64]
    support: NDArray[np.int64]
    image_rows: NDArray[np.int64]


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
    seen_once : bool (M,), of the points; None: none is.
    """

    keypoint_ids: NDArray[np.int64]
    point_ids: NDArray[np.int64]
    similarities: NDArray[np.float64]
    image_rows: NDArray[np.int64]
    num_images: int
    seen_once: NDArray[np.bool_] | None = None

    def resolve(self, rows: NDArray[np.bool_] | None = None) -> Correspondences:
        """One point per keypoint and one keypoint per point, of the matches with some images.

        The same keypoint can meet several points through different map images, and the reverse.
        A point that several images observe comes before one that was lifted through one's depth;
        then what most images say wins; then the best score; then the smaller ids.
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
        taken = np.flatnonzero(rows[self.image_rows])
        if len(taken) == 0:
            none = np.zeros(0, dtype=np.int64)
            return Correspondences(none, none, none, none)
        # both in one number: equals are the same pair, and their order does not matter
        taken = taken[np.argsort((self.keypoint_ids[taken] << 32) | self.point_ids[taken])]
        keypoints, points = self.keypoint_ids[taken], self.point_ids[taken]
        # every distinct pair once, sorted by keypoint, then point
        new = (np.diff(keypoints, prepend=-1) != 0) | (np.diff(points, prepend=-1) != 0)
        first = np.flatnonzero(new)
        best = np.maximum.reduceat(self.similarities[taken], first)
        support = np.diff(first, append=len(taken))
        keypoints, points = keypoints[first], points[first]
        order = [-best, -support]
        if self.seen_once is not None:
            order.append(self.seen_once[taken][first])
        chosen = index_kernels.choose(
            np.lexsort(order),
            np.cumsum(np.diff(keypoints, prepend=keypoints[0]) != 0),
            np.unique(points, return_inverse=True)[1],
        )
        return Correspondences(
            keypoints[chosen],
            points[chosen],
            support[chosen],
            self.image_rows[taken][np.repeat(chosen, support)],
        )


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
    return ObservedMatches(
        keypoint_ids,
        point_ids,
        similarities,
        image_rows,
        len(matches),
        index.seen_once[point_ids],
    )
