"""Images of kapture folders: rig siblings, mask, depth, points, and the index of map points."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import require
from megloc_kapture.geometry.cameras import focal_px
from megloc_kapture.io.files import TEMPORARY, atomic_write, write_bytes
from megloc_kapture.io.images import read_depth_map
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Observations
from megloc_kapture.io.kapture.points import read_point_covariances
from megloc_kapture.localization.map_index import MapIndex
from megloc_kapture.mapping.map_check import ObservedKeypoints
from megloc_kapture.plugins import DepthView
from megloc_kapture.stages.local_features import mask_path, read_mask, read_stored_image
from megloc_kapture.values import Camera, Pose, RigidTransform

_SAMPLED_IMAGES = 32


def check_points(folder: KaptureFolder, purpose: str) -> None:
    """Raise DataError if a folder has no map points for a purpose, such as ``localize in``."""
    folder.read()  # raises a different error if this is not a kapture folder
    require(
        folder.has_points(),
        f"no map to {purpose}: reconstruction/points3d.txt or observations.txt is missing; "
        "`megloc triangulate` makes one from images with poses",
        path=folder.root,
    )


def index_map(folder: KaptureFolder, local_type: str) -> MapIndex:
    """Read points, uncertainties and observations of one keypoints type.

    A type with keypoints but no triangulated point gives an empty index.
    """
    observations = folder.observations().get(local_type)
    if observations is None:
        require(
            local_type in folder.types("keypoints"),
            f"the map has no observations of type {local_type!r}",
            path=folder.root,
        )
        nothing = np.zeros(0, np.int32)
        observations = Observations((), nothing.astype(np.int64), nothing, nothing)
    points = folder.points3d()
    index = MapIndex.build(
        points[:, :3],
        observations.image_names,
        observations.image_ids,
        observations.keypoint_ids,
        observations.point_ids,
        read_point_covariances(folder.root, len(points)),
    )
    return replace(index, local_type=local_type)


def observed_keypoints(
    folder: KaptureFolder, index: MapIndex, images: Iterable[str]
) -> list[ObservedKeypoints]:
    """Read stored keypoints of posed images.

    Points with a single observation (lifted from depth) reproject exactly onto it, so they are left
    out unless the map has no others.
    """
    data, keypoints = folder.read(), folder.keypoints(index.local_type)
    poses = data.poses()
    lifted = index.seen_once
    informative = lifted if lifted[index.point_ids].all() else ~lifted
    observed = []
    for image in images:
        rows, points = index.observed(image)
        chosen = informative[points]
        pixels = keypoints.read(image)[:, :2]
        camera, pose = data.camera_of(image), poses[image]
        observed.append(
            ObservedKeypoints(image, camera, pose, pixels, rows[chosen], points[chosen])
        )
    return observed


def with_noise(folder: KaptureFolder, index: MapIndex) -> MapIndex:
    """Add the median reprojection error of a sample of map images, as an angle and in pixels.

    Points with a single observation are left out, because they reproject exactly onto it; if the
    map has no others, or stores no keypoints, the index is returned unchanged.
    """
    if index.seen_once[index.point_ids].all() or index.local_type not in folder.types("keypoints"):
        return index
    keypoints, poses = folder.keypoints(index.local_type), folder.read().poses()
    images = [image for image in index.row_of_image if image in keypoints and image in poses]
    sample = images[:: max(1, len(images) // _SAMPLED_IMAGES)]
    errors_rad, errors_px = [np.zeros(0)], [np.zeros(0)]
    for image in observed_keypoints(folder, index, sample):
        errors_px.append(image.errors_px(index.xyz))
        errors_rad.append(errors_px[-1] / focal_px(image.camera))
    noise_rad, noise_px = _finite_median(errors_rad), _finite_median(errors_px)
    return replace(index, noise_rad=noise_rad, noise_px=noise_px)


def _finite_median(parts: Sequence[NDArray[np.float64]]) -> float:
    values = np.concatenate(parts)
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else math.nan


def open_index(folder: Path) -> MapIndex:
    values = json.loads((folder / "index.json").read_bytes())
    for file in folder.glob("*.npy"):
        # compiled loops need plain arrays
        values[file.stem] = np.asarray(np.load(file, mmap_mode="r"))
    return MapIndex(**values)


@contextmanager
def shared_index(
    indices: Mapping[str, MapIndex], scratch: Path | None = None
) -> Iterator[dict[str, Path]]:
    """Write indices, by keypoints type, to temporary folders that other processes can open.

    Arrays are npy files, which processes can share, other fields are in a JSON file. Opened indices
    stay valid after the folders are removed.
    """
    with TemporaryDirectory(prefix=TEMPORARY, dir=scratch) as place:
        folders = {name: Path(place) / str(at) for at, name in enumerate(indices)}
        for name, folder in folders.items():
            values = {each.name: getattr(indices[name], each.name) for each in fields(MapIndex)}
            for array in [key for key, value in values.items() if isinstance(value, np.ndarray)]:
                write_array(folder / f"{array}.npy", values.pop(array))
            write_bytes(folder / "index.json", json.dumps(values).encode())
        yield folders


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array as npy, atomically and reproducibly."""
    with atomic_write(path) as file:
        np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)


Unit = tuple[tuple[str, RigidTransform], ...]
"""Images localized jointly, sorted by name, with the ``cam_from_rig`` of each."""


def query_units(data: KaptureData, *, rigs: bool) -> list[Unit]:
    """Group query images into units that are localized together, sorted by image.

    With ``rigs`` a unit is the images of one rig at one timestamp; a camera on several rigs belongs
    to the first by name.
    """
    mounts, same = _mounts(data) if rigs else {}, RigidTransform.identity()
    together: dict[str | tuple[int, str], list[tuple[str, RigidTransform]]] = {}
    for image in data.image_names():
        timestamp, sensor = data.record_of(image)
        if sensor in mounts:
            rig, cam_from_rig = next(iter(mounts[sensor].items()))
            together.setdefault((timestamp, rig), []).append((image, cam_from_rig))
        else:
            together[image] = [(image, same)]
    units = [tuple(unit) if len(unit) > 1 else ((unit[0][0], same),) for unit in together.values()]
    return sorted(units, key=lambda unit: [image for image, _ in unit])


def poses_through_rig(
    data: KaptureData, localized: Mapping[str, Pose]
) -> dict[str, tuple[str, RigidTransform]]:
    """Derive poses of unlocalized images from the rig sibling with the most inliers."""
    siblings = _siblings_on_rig(data, data.records_camera)
    guesses = {}
    for image in sorted(set(data.records_camera.values()) - set(localized)):
        poses = [
            (-pose.num_inliers, other, sensor_from_other @ pose.cam_from_world)
            for _, other, sensor_from_other in siblings(*data.record_of(image))
            if (pose := localized.get(other)) is not None
        ]
        if poses:
            _, other, cam_from_world = min(poses, key=itemgetter(0, 1))
            guesses[image] = (other, cam_from_world)
    return guesses


@dataclass(frozen=True)
class DepthRecord:
    """A depth map taken with an image.

    ``path`` is below ``records_data``; ``image_from_depth`` is as in ``DepthView``.
    """

    path: str
    camera: Camera
    image_from_depth: RigidTransform


def depth_records(data: KaptureData) -> dict[str, DepthRecord]:
    """Find the depth map of each image: same rig and timestamp, closest depth sensor."""
    siblings = _siblings_on_rig(data, data.records_depth)
    depth_of = {}
    for record, image in data.records_camera.items():
        options = [
            (float(np.linalg.norm(image_from_depth.translation)), sensor, path, image_from_depth)
            for sensor, path, image_from_depth in siblings(*record)
        ]
        if options:
            _, sensor, path, image_from_depth = min(options, key=itemgetter(0, 1))
            depth_of[image] = DepthRecord(path, data.sensors[sensor].camera(), image_from_depth)
    return depth_of


def _siblings_on_rig(
    data: KaptureData, records: Mapping[tuple[int, str], str]
) -> Callable[[int, str], Iterator[tuple[str, str, RigidTransform]]]:
    """Return a function of timestamp and sensor that yields the records on the same rig.

    It yields the other sensor, the path and ``sensor_from_other``.
    """
    mounts = _mounts(data)
    at_time: dict[int, list[tuple[str, str]]] = {}
    for (timestamp, sensor), path in records.items():
        at_time.setdefault(timestamp, []).append((sensor, path))

    def siblings(timestamp: int, sensor: str) -> Iterator[tuple[str, str, RigidTransform]]:
        of_sensor = mounts.get(sensor, {})
        for other, path in at_time.get(timestamp, ()):
            of_other = mounts.get(other, {})
            rig = next((rig for rig in of_sensor if rig in of_other), None)
            if rig is not None:
                yield other, path, of_sensor[rig] @ of_other[rig].inverse()

    return siblings


def _mounts(data: KaptureData) -> dict[str, dict[str, RigidTransform]]:
    """Return ``sensor_from_rig`` by sensor and top-level rig, sorted, through nested rigs."""
    mounts: dict[str, dict[str, RigidTransform]] = {}

    def mount(devices: Mapping[str, RigidTransform], rig: str) -> None:
        for device, device_from_rig in devices.items():
            if device in data.rigs:
                mount({d: p @ device_from_rig for d, p in data.rigs[device].items()}, rig)
            else:
                mounts.setdefault(device, {})[rig] = device_from_rig

    on_others = {member for members in data.rigs.values() for member in members}
    for rig in sorted(data.rigs.keys() - on_others):
        mount(data.rigs[rig], rig)
    return mounts


@lru_cache(maxsize=4)
def _depth_records_of(folder: KaptureFolder) -> dict[str, DepthRecord]:
    return depth_records(folder.read())


@lru_cache(maxsize=4)
def indices_of(folder: KaptureFolder) -> list[MapIndex]:
    return [index_map(folder, local_type) for local_type in folder.observations()]


def points_seen(folder: KaptureFolder, name: str) -> NDArray[np.int64]:
    """Return the ids (P,) of the map points that an image observes, of all keypoints types."""
    seen = [index.observed(name)[1] for index in indices_of(folder)]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *seen]))


def depth_of(folder: KaptureFolder, name: str) -> DepthView | None:
    """Return the depth taken with an image, or None."""
    record = _depth_records_of(folder).get(name)
    if record is None:
        return None
    path, camera = folder.depth_path(record.path), record.camera
    depth_m = read_depth_map(path, width=camera.width, height=camera.height)
    return DepthView(camera, depth_m, record.image_from_depth)


def depth_and_pose(folder: KaptureFolder, name: str) -> tuple[DepthView, RigidTransform]:
    """Return the depth and the pose of an image that has both."""
    depth, cam_from_world = depth_of(folder, name), folder.read().cam_from_world(name)
    assert depth is not None and cam_from_world is not None
    return depth, cam_from_world


def _mask_of(folder: KaptureFolder, name: str) -> NDArray[np.bool_] | None:
    camera = folder.read().camera_of(name)
    return read_mask(mask_path(folder, name), (camera.height, camera.width))


class KaptureScene:
    """:class:`~megloc_kapture.plugins.RankingScene` of a map folder and its queries.

    ``query`` is a folder, or images by name with ``pixels``, ``mask`` and ``depth``.
    ``map_camera`` returns the camera of a map image by name, by default the stored one.
    """

    def __init__(
        self,
        mapping: KaptureFolder,
        query: KaptureFolder | Mapping[str, Any] | None = None,
        *,
        map_camera: Callable[[str], Camera] | None = None,
    ) -> None:
        self._map = mapping
        self.map_camera = map_camera or mapping.read().camera_of
        if isinstance(query, KaptureFolder):
            self.query_image = lambda name: read_stored_image(query, name)
            self.query_mask = lambda name: _mask_of(query, name)
            self.query_depth = lambda name: depth_of(query, name)
        elif query is not None:
            self.query_image = lambda name: query[name].pixels
            self.query_mask = lambda name: query[name].mask
            self.query_depth = lambda name: query[name].depth

    def map_image(self, name: str) -> NDArray[np.uint8]:
        return read_stored_image(self._map, name)

    def map_mask(self, name: str) -> NDArray[np.bool_] | None:
        return _mask_of(self._map, name)

    def map_depth(self, name: str) -> DepthView | None:
        return depth_of(self._map, name)

    def map_points(self, name: str) -> NDArray[np.float64]:
        return self._map.points3d()[:, :3][points_seen(self._map, name)]

    def map_pose(self, name: str) -> RigidTransform:
        pose = self._map.read().cam_from_world(name)
        assert pose is not None
        return pose
