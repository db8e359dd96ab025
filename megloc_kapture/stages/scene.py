"""Siblings on the rig, mask, depth and points of images in a kapture folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from operator import itemgetter
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.images import read_depth_map
from megloc_kapture.io.kapture import KaptureData, KaptureFolder
from megloc_kapture.localization.map_index import MapIndex
from megloc_kapture.plugins import DepthView
from megloc_kapture.stages.local_features import mask_path, read_image_of, read_mask
from megloc_kapture.stages.shared_index import index_map
from megloc_kapture.values import Camera, Pose, RigidTransform

Unit = tuple[tuple[str, RigidTransform], ...]
"""Images that get one pose, sorted by name, with the ``cam_from_rig`` of each."""


def query_units(data: KaptureData, *, rigs: bool) -> list[Unit]:
    """Group query images into units that are localized together, sorted by image.

    With ``rigs`` a unit is the cameras of one rig (the first by name) at one timestamp.
    """
    carried = _carried(data) if rigs else {}
    rigs_of = _rigs_of(carried)
    units: list[Unit] = []
    together: dict[tuple[int, str], list[str]] = {}
    for image in data.image_names():
        timestamp, sensor = data.record_of(image)
        if sensor in rigs_of:
            together.setdefault((timestamp, rigs_of[sensor][0]), []).append(image)
        else:
            units.append(((image, RigidTransform.identity()),))
    for (_, rig), images in together.items():
        if len(images) == 1:
            units.append(((images[0], RigidTransform.identity()),))
        else:
            members = carried[rig]
            units.append(tuple((image, members[data.record_of(image)[1]]) for image in images))
    return sorted(units, key=lambda unit: [image for image, _ in unit])


def poses_through_rig(
    data: KaptureData, localized: Mapping[str, Pose]
) -> dict[str, tuple[str, RigidTransform]]:
    """Derive poses of unlocalized images from the rig sibling with the most inliers."""
    carried = _carried(data)
    rigs_of = _rigs_of(carried)
    at_time: dict[int, list[tuple[str, str]]] = {}
    for (timestamp, sensor), image in data.records_camera.items():
        at_time.setdefault(timestamp, []).append((sensor, image))
    found = {}
    for image in sorted(set(data.records_camera.values()) - set(localized)):
        timestamp, sensor = data.record_of(image)
        poses = [
            (-result.num_inliers, other, sensor_from_other @ result.cam_from_world)
            for other_sensor, other in at_time[timestamp]
            if (result := localized.get(other)) is not None
            and (sensor_from_other := _between(carried, rigs_of, sensor, other_sensor)) is not None
        ]
        if poses:
            _, other, pose = min(poses, key=itemgetter(0, 1))
            found[image] = (other, pose)
    return found


@dataclass(frozen=True)
class DepthRecord:
    """A depth map taken with an image.

    ``path`` is below ``records_data``; ``image_from_depth`` maps depth camera frame to image frame.
    """

    path: str
    camera: Camera
    image_from_depth: RigidTransform


def depth_records(data: KaptureData) -> dict[str, DepthRecord]:
    """Find the depth map of each image: same rig and timestamp, closest depth sensor."""
    carried = _carried(data)
    rigs_of = _rigs_of(carried)
    at_time: dict[int, list[tuple[str, str]]] = {}
    for (timestamp, sensor), path in sorted(data.records_depth.items()):
        at_time.setdefault(timestamp, []).append((sensor, path))
    found = {}
    for (timestamp, camera), image in data.records_camera.items():
        options = [
            (image_from_depth, sensor, path)
            for sensor, path in at_time.get(timestamp, ())
            if (image_from_depth := _between(carried, rigs_of, camera, sensor)) is not None
        ]
        if options:
            image_from_depth, sensor, path = min(
                options, key=lambda option: (np.linalg.norm(option[0].translation), option[1])
            )
            found[image] = DepthRecord(path, data.sensors[sensor].camera(), image_from_depth)
    return found


def read_depth(folder: KaptureFolder, record: DepthRecord) -> NDArray[np.float32]:
    """Read depth (H, W) of a record; 0 means unknown."""
    size = {"width": record.camera.width, "height": record.camera.height}
    return read_depth_map(folder.depth_path(record.path), **size)


_Carried = Mapping[str, Mapping[str, RigidTransform]]


def _carried(data: KaptureData) -> _Carried:
    """Return ``sensor_from_rig`` by sensor for each top-level rig, through nested rigs."""

    def members(rig: str, above: frozenset[str]) -> dict[str, RigidTransform]:
        if rig in above:
            raise DataError(f"rig {rig!r} contains itself")
        found = {}
        for member, member_from_rig in data.rigs[rig].items():
            if member not in data.rigs:
                found[member] = member_from_rig
                continue
            for sensor, sensor_from_member in members(member, above | {rig}).items():
                found[sensor] = sensor_from_member @ member_from_rig
        return found

    on_others = {member for one in data.rigs.values() for member in one}
    return {rig: members(rig, frozenset()) for rig in sorted(data.rigs) if rig not in on_others}


def _rigs_of(carried: _Carried) -> dict[str, list[str]]:
    rigs_of: dict[str, list[str]] = {}
    for rig, members in sorted(carried.items()):
        for sensor in members:
            rigs_of.setdefault(sensor, []).append(rig)
    return rigs_of


def _between(
    carried: _Carried, rigs_of: Mapping[str, list[str]], sensor: str, other: str
) -> RigidTransform | None:
    for rig in rigs_of.get(sensor, ()):
        if other in carried[rig]:
            return carried[rig][sensor] @ carried[rig][other].inverse()
    return None


_NO_POINTS = np.zeros(0, np.int64)


class _Images:
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
        seen = [index.observed(name)[1] for index in self._indices]
        return self.folder.points3d()[:, :3][np.unique(np.concatenate([_NO_POINTS, *seen]))]

    @cached_property
    def _depth_records(self) -> dict[str, DepthRecord]:
        return depth_records(self.folder.read())

    @cached_property
    def _indices(self) -> list[MapIndex]:
        return [index_map(self.folder, name) for name in self.folder.observations()]


@lru_cache(maxsize=4)
def _images_of(folder: KaptureFolder) -> _Images:
    return _Images(folder)


class QueryScene(Protocol):
    """Pixels, mask and depth of query images; see :class:`KaptureScene`."""

    def image(self, name: str) -> NDArray[np.uint8]:
        """RGB pixels (H, W, 3)."""
        ...

    def mask(self, name: str) -> NDArray[np.bool_] | None:
        """Mask (H, W), True = use, or None."""
        ...

    def depth(self, name: str) -> DepthView | None:
        """Depth taken with the image, or None."""
        ...


def depth_of(folder: KaptureFolder, name: str) -> DepthView | None:
    """Return the depth taken with an image, or None."""
    return _images_of(folder).depth(name)


class KaptureScene:
    """:class:`~megloc_kapture.plugins.RankingScene` of a map folder and its queries.

    ``map_camera`` returns the camera of a map image by name, by default the stored one.
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
