"""A map's points and observations as arrays: from keypoints of map images to 3D points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
    """

    xyz: NDArray[np.float64]
    row_of_image: dict[str, int]
    offsets: NDArray[np.int64]
    keypoint_ids: NDArray[np.int32]
    point_ids: NDArray[np.int32]
    covariances: NDArray[np.float64] | None = None

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
        place = np.minimum(np.searchsorted(keypoints, keypoint_ids), len(keypoints) - 1)
        hit = keypoints[place] == keypoint_ids
        found[hit] = points[place[hit]]
        return found

    def rows_of(self, images: Sequence[str]) -> NDArray[np.int64]:
        """Row of each image in ``offsets``, -1 where it is not in the map; int64 (n,)."""
        return np.array([self.row_of_image.get(image, -1) for image in images], dtype=np.int64)

    def shared_points(self, images: Sequence[str]) -> NDArray[np.int64]:
        """How many points every two of the images both observe, int64 (n, n), symmetric.

        The diagonal has the points that an image observes. The cost grows with these images'
        observations, not with the map; an image that is not in the map shares nothing.
        """
        from megloc_kapture.localization import index_kernels

        shared = index_kernels.shared_points(self.offsets, self.point_ids, self.rows_of(images))
        return np.asarray(shared, dtype=np.int64)


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    """The array, not to be written to: also the one kind that the compiled loops then meet."""
    view = array.view()
    view.setflags(write=False)
    return view
