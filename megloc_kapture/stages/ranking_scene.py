"""What pose rankers and refiners may look at, out of kapture folders; read only when asked for."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property, lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.plugins import DepthView
from megloc_kapture.stages.local_features import mask_path, read_image_of, read_mask
from megloc_kapture.stages.rigs import DepthRecord, depth_records, read_depth
from megloc_kapture.stages.work import Digest
from megloc_kapture.values import Camera, RigidTransform


class _Images:
    """Pixels, masks, depth and points of the images of one folder; what is looked up stays."""

    def __init__(self, folder: KaptureFolder) -> None:
        self.folder = folder

    def camera(self, name: str) -> Camera:
        return self.folder.read().camera_of(name)

    def image(self, name: str) -> NDArray[np.uint8]:
        return read_image_of(self.folder.image_path(name), self.camera(name))

    def mask(self, name: str) -> NDArray[np.bool_] | None:
        camera = self.camera(name)
        return read_mask(mask_path(self.folder, name), (camera.height, camera.width))

    def depth(self, name: str) -> DepthView | None:
        record = self._depth_records.get(name)
        if record is None:
            return None
        depth_m = read_depth(self.folder, record)
        return DepthView(record.camera, depth_m, record.image_from_depth)

    def points(self, name: str) -> NDArray[np.float64]:
        ids = [
            point_ids[starts[row] : starts[row + 1]]
            for rows, starts, point_ids in self._observed
            if (row := rows.get(name)) is not None
        ]
        xyz = self.folder.points3d()[:, :3]
        return xyz[np.unique(np.concatenate([np.zeros(0, np.int64), *ids]))]

    @cached_property
    def _depth_records(self) -> dict[str, DepthRecord]:
        return depth_records(self.folder.read())

    @cached_property
    def _observed(self) -> list[tuple[dict[str, int], NDArray[np.int64], NDArray[np.int64]]]:
        """Of each keypoints type: image to its row, where each row's points begin, the points."""
        found = []
        for _, observed in sorted(self.folder.observations().items()):
            order = np.argsort(observed.image_ids, kind="stable")
            rows = {name: row for row, name in enumerate(observed.image_names)}
            starts = np.searchsorted(observed.image_ids[order], np.arange(len(rows) + 1))
            found.append((rows, starts, observed.point_ids[order]))
        return found


@lru_cache(maxsize=4)
def _images_of(folder: KaptureFolder) -> _Images:
    """The same for every query of a run: a folder is opened once per process."""
    return _Images(folder)


class QueryScene(Protocol):
    """Pixels, mask and depth of query images by their names; see :class:`KaptureScene`."""

    def image(self, name: str) -> NDArray[np.uint8]:
        """RGB pixels (H, W, 3); raises DataError."""
        ...

    def mask(self, name: str) -> NDArray[np.bool_] | None:
        """Mask (H, W), True = use; None without one."""
        ...

    def depth(self, name: str) -> DepthView | None:
        """Depth that was taken with the image; None without; raises DataError."""
        ...


def depth_of(folder: KaptureFolder, name: str) -> DepthView | None:
    """Depth that was taken with an image of a folder; None without; raises DataError."""
    return _images_of(folder).depth(name)


class KaptureScene:
    """A :class:`~megloc_kapture.plugins.RankingScene` of a map's folder and its queries; raises
    DataError where a file cannot be read, or a map image has no pose.

    Parameters
    ----------
    query : the folder of the queries, or what else knows them; None: nothing does.
    map_camera : camera of a map image by its name; as stored unless given.
    """

    def __init__(
        self,
        mapping: KaptureFolder,
        query: KaptureFolder | QueryScene | None = None,
        *,
        map_camera: Callable[[str], Camera] | None = None,
    ) -> None:
        self._map = _images_of(mapping)
        known = _images_of(query) if isinstance(query, KaptureFolder) else query
        self._query: QueryScene | None = known
        self._map_camera = map_camera or self._map.camera

    def query_image(self, name: str) -> NDArray[np.uint8]:
        if self._query is None:
            raise DataError(f"the pixels of query {name} are not known")
        return self._query.image(name)

    def query_mask(self, name: str) -> NDArray[np.bool_] | None:
        return None if self._query is None else self._query.mask(name)

    def query_depth(self, name: str) -> DepthView | None:
        return None if self._query is None else self._query.depth(name)

    def map_image(self, name: str) -> NDArray[np.uint8]:
        return self._map.image(name)

    def map_mask(self, name: str) -> NDArray[np.bool_] | None:
        return self._map.mask(name)

    def map_depth(self, name: str) -> DepthView | None:
        return self._map.depth(name)

    def map_points(self, name: str) -> NDArray[np.float64]:
        return self._map.points(name)

    def map_camera(self, name: str) -> Camera:
        return self._map_camera(name)

    def map_pose(self, name: str) -> RigidTransform:
        pose = self._map.folder.read().cam_from_world(name)
        if pose is None:
            raise DataError(f"map image {name} has no pose", path=self._map.folder.root)
        return pose


def image_inputs(folder: KaptureFolder) -> Callable[[str, Digest], list[str | None]]:
    """What a ranker may look at: an image's file, its mask and its depth."""
    names, records = set(folder.read().image_names()), depth_records(folder.read())

    @cache
    def of_image(image: str, digest: Digest) -> list[str | None]:
        if image not in names:
            return []
        files = [folder.image_path(image), mask_path(folder, image)]
        if image in records:
            files.append(folder.depth_path(records[image].path))
        return [digest(file) if file.is_file() else None for file in files]

    return of_image
