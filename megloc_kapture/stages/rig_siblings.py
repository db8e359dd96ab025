"""The pose of an image through the rig, from another camera of the same moment."""

from __future__ import annotations

from collections.abc import Mapping

from megloc_kapture.io.kapture import KaptureData
from megloc_kapture.values import Pose, RigidTransform


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
    at_time: dict[int, list[tuple[str, str]]] = {}
    for (timestamp, sensor), image in data.records_camera.items():
        at_time.setdefault(timestamp, []).append((sensor, image))
    found = {}
    for image in sorted(set(data.records_camera.values()) - set(localized)):
        timestamp, sensor = data.record_of(image)
        best: tuple[int, str, RigidTransform] | None = None
        for other_sensor, other in at_time[timestamp]:
            result = localized.get(other)
            sensor_from_other = _between(data, sensor, other_sensor)
            if result is None or sensor_from_other is None:
                continue
            key = (-result.num_inliers, other)
            if best is None or key < best[:2]:
                best = (*key, sensor_from_other @ result.cam_from_world)
        if best is not None:
            found[image] = (best[1], best[2])
    return found


def _between(data: KaptureData, sensor: str, other: str) -> RigidTransform | None:
    """``sensor_from_other`` where one rig carries both."""
    for _, members in sorted(data.rigs.items()):
        if sensor in members and other in members:
            return members[sensor] @ members[other].inverse()
    return None
