"""What a pose ranker may look at, out of kapture folders; read only when asked for."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_store import KaptureFolder
from megloc_kapture.stages.local_features import read_image_of
from megloc_kapture.values import Camera, RigidTransform


class KaptureScene:
    """A :class:`~megloc_kapture.plugins.RankingScene` of a map's folder.

    Parameters
    ----------
    read_query : pixels of a query image by its name.
    """

    def __init__(
        self, mapping: KaptureFolder, read_query: Callable[[str], NDArray[np.uint8]]
    ) -> None:
        self._mapping, self._read_query = mapping, read_query

    def query_image(self, name: str) -> NDArray[np.uint8]:
        """RGB pixels (H, W, 3) of a query image; raises DataError."""
        return self._read_query(name)

    def map_image(self, name: str) -> NDArray[np.uint8]:
        """RGB pixels (H, W, 3) of a map image; raises DataError."""
        return read_image_of(self._mapping.image_path(name), self.map_camera(name))

    def map_camera(self, name: str) -> Camera:
        """Camera of a map image, as stored."""
        return self._mapping.read().camera_of(name)

    def map_pose(self, name: str) -> RigidTransform:
        """``cam_from_world`` of a map image; raises DataError when it has none."""
        pose = self._mapping.read().cam_from_world(name)
        if pose is None:
            raise DataError(f"map image {name} has no pose", path=self._mapping.root)
        return pose


def query_reader(query: KaptureFolder) -> Callable[[str], NDArray[np.uint8]]:
    """Reads the pixels of a query folder's images by name."""
    return lambda name: read_image_of(query.image_path(name), query.read().camera_of(name))
