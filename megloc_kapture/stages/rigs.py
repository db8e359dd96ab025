"""Images of one moment on one rig: units of queries, poses of siblings, depth maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.images import read_depth_map
from megloc_kapture.io.kapture import KaptureData, KaptureFolder
from megloc_kapture.values import Camera, Pose, RigidTransform

Unit = tuple[tuple[str, RigidTransform], ...]
"""Images that get one pose, sorted by name, with the ``cam_from_rig`` of each."""


def query_units(data: KaptureData, *, rigs: bool) -> list[Unit]:
    """The units of a query folder, sorted by their images; every image is in one.

    ``rigs``: whether cameras of one rig and one timestamp are localized together. A camera on
    several rigs goes with the first by name. Without, every image is by itself.
    """
    rigs_of = _rigs_of(data) if rigs else {}
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
            members = data.rigs[rig]
            units.append(tuple((image, members[data.record_of(image)[1]]) for image in images))
    return sorted(units, key=lambda unit: [image for image, _ in unit])


def poses_through_rig(
    data: KaptureData, localized: Mapping[str, Pose]
) -> dict[str, tuple[str, RigidTransform]]:
    """For images that are not localized: the sibling that is, and the pose it gives them.

    Siblings share the timestamp and a rig; of several, the one with the most inliers counts, then
    the first by name.

    Parameters
    ----------
    data : sensors, rigs (``sensor_from_rig``) and records of the images.
    localized : the images that were localized.
    """
    rigs_of = _rigs_of(data)
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
            and (sensor_from_other := _between(data, rigs_of, sensor, other_sensor)) is not None
        ]
        if poses:
            _, other, pose = min(poses, key=itemgetter(0, 1))
            found[image] = (other, pose)
    return found


@dataclass(frozen=True)
class DepthRecord:
    """A depth map that was taken with an image.

    Parameters
    ----------
    path : below ``records_data``.
    camera : of the depth sensor.
    image_from_depth : from the depth camera's frame to the image's.
    """

    path: str
    camera: Camera
    image_from_depth: RigidTransform


def depth_records(data: KaptureData) -> dict[str, DepthRecord]:
    """Image -> the depth map of its moment, of a depth sensor on one rig with its camera.

    Where several depth sensors share the rig, the one nearest to the camera counts.
    """
    rigs_of = _rigs_of(data)
    at_time: dict[int, list[tuple[str, str]]] = {}
    for (timestamp, sensor), path in sorted(data.records_depth.items()):
        at_time.setdefault(timestamp, []).append((sensor, path))
    found = {}
    for (timestamp, camera), image in data.records_camera.items():
        options = [
            (image_from_depth, sensor, path)
            for sensor, path in at_time.get(timestamp, ())
            if (image_from_depth := _between(data, rigs_of, camera, sensor)) is not None
        ]
        if options:
            image_from_depth, sensor, path = min(
                options, key=lambda option: (np.linalg.norm(option[0].translation), option[1])
            )
            found[image] = DepthRecord(path, data.sensors[sensor].camera(), image_from_depth)
    return found


def read_depth(folder: KaptureFolder, record: DepthRecord) -> NDArray[np.float32]:
    """Depth (H, W) of a record, 0 where nothing is known; raises DataError."""
    size = {"width": record.camera.width, "height": record.camera.height}
    return read_depth_map(folder.depth_path(record.path), **size)


def _rigs_of(data: KaptureData) -> dict[str, list[str]]:
    """The rigs that a sensor is on, sorted by name."""
    rigs_of: dict[str, list[str]] = {}
    for rig, members in sorted(data.rigs.items()):
        for sensor in members:
            rigs_of.setdefault(sensor, []).append(rig)
    return rigs_of


def _between(
    data: KaptureData, rigs_of: Mapping[str, list[str]], sensor: str, other: str
) -> RigidTransform | None:
    """``sensor_from_other`` where one rig carries both."""
    for rig in rigs_of.get(sensor, ()):
        if other in data.rigs[rig]:
            return data.rigs[rig][sensor] @ data.rigs[rig][other].inverse()
    return None
