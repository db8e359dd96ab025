"""Which depth map was taken with which image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from megloc_kapture.io.kapture import KaptureData
from megloc_kapture.values import Camera, RigidTransform


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
    rigs_of: dict[str, list[str]] = {}
    for rig, members in sorted(data.rigs.items()):
        for sensor in members:
            rigs_of.setdefault(sensor, []).append(rig)
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


def _between(
    data: KaptureData, rigs_of: dict[str, list[str]], camera: str, depth: str
) -> RigidTransform | None:
    for rig in rigs_of.get(camera, ()):
        if depth in data.rigs[rig]:
            return data.rigs[rig][camera] @ data.rigs[rig][depth].inverse()
    return None
