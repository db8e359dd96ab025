"""A map's points and observations as arrays: from keypoints of map images to 3D points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class MapIndex:
    """Observations grouped by image.

    Attributes
    ----------
    xyz : float64 (N, 3), the points in the world frame.
    row_of_image : image name -> row of ``offsets``.
    offsets : int64 (I + 1,); image i's observations are rows offsets[i] to offsets[i + 1].
    keypoint_ids : int32 (O,), ascending within an image.
    point_ids : int32 (O,), rows of ``xyz``.
    """

    xyz: NDArray[np.float64]
    row_of_image: dict[str, int]
    offsets: NDArray[np.int64]
    keypoint_ids: NDArray[np.int32]
    point_ids: NDArray[np.int32]

    @classmethod
    def build(
        cls,
        xyz: NDArray[np.float64],
        image_names: tuple[str, ...],
        image_ids: NDArray[np.integer],
        keypoint_ids: NDArray[np.integer],
        point_ids: NDArray[np.integer],
    ) -> MapIndex:
        """Group observations, given as parallel arrays (O,), by image and keypoint."""
        order = np.lexsort((point_ids, keypoint_ids, image_ids))
        counts = np.bincount(image_ids, minlength=len(image_names))
        offsets = np.zeros(len(image_names) + 1, dtype=np.int64)
        np.cumsum(counts, out=offsets[1:])
        return cls(
            xyz=np.ascontiguousarray(xyz, dtype=np.float64),
            row_of_image={name: row for row, name in enumerate(image_names)},
            offsets=offsets,
            keypoint_ids=np.asarray(keypoint_ids)[order].astype(np.int32),
            point_ids=np.asarray(point_ids)[order].astype(np.int32),
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
