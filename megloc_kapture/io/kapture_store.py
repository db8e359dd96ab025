"""The front of the kapture store: everything that other rooms use of it, under one name.

The format is parsed and written by the ``kapture_*`` modules beside this one, strictly and fast.
kapture itself is needed only by who wants its objects (:func:`to_kapture`); this is the one module
that imports it, and only there: the import takes a second.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from megloc_kapture.io.kapture_data import KaptureData, Sensor
from megloc_kapture.io.kapture_features import (
    FeatureConfig,
    FeatureKind,
    FeatureReader,
    FeatureWriter,
)
from megloc_kapture.io.kapture_folder import KaptureFolder
from megloc_kapture.io.kapture_matches import MatchesReader, MatchesWriter
from megloc_kapture.io.kapture_points import (
    Observations,
    write_observations,
    write_points3d,
)
from megloc_kapture.io.kapture_sensors import write_sensors
from megloc_kapture.io.pairs import ImagePair, read_pairs, write_pairs

if TYPE_CHECKING:
    import kapture

__all__ = [
    "FeatureConfig",
    "FeatureKind",
    "FeatureReader",
    "FeatureWriter",
    "ImagePair",
    "KaptureData",
    "KaptureFolder",
    "MatchesReader",
    "MatchesWriter",
    "Observations",
    "Sensor",
    "read_pairs",
    "to_kapture",
    "write_observations",
    "write_pairs",
    "write_points3d",
    "write_sensors",
]


def to_kapture(source: KaptureData | KaptureFolder | Path | str) -> kapture.Kapture:
    """The sensors, rigs, trajectories and records as kapture's own object, for its tools."""
    import kapture

    if isinstance(source, Path | str):
        source = KaptureFolder(source)
    data = source.read() if isinstance(source, KaptureFolder) else source
    sensors = kapture.Sensors()
    for sensor_id, sensor in sorted(data.sensors.items()):
        sensors[sensor_id] = kapture.create_sensor(
            sensor.sensor_type, list(sensor.params), sensor.name or None
        )
    rigs = kapture.Rigs()
    for rig_id, members in sorted(data.rigs.items()):
        for sensor_id, pose in sorted(members.items()):
            rigs[rig_id, sensor_id] = kapture.PoseTransform(
                list(pose.quat_wxyz), list(pose.translation)
            )
    trajectories = kapture.Trajectories()
    for (timestamp, device_id), pose in sorted(data.trajectories.items()):
        trajectories[int(timestamp), device_id] = kapture.PoseTransform(
            list(pose.quat_wxyz), list(pose.translation)
        )
    records_camera = kapture.RecordsCamera()
    for (timestamp, sensor_id), name in sorted(data.records_camera.items()):
        records_camera[int(timestamp), sensor_id] = name
    records_depth = kapture.RecordsDepth()
    for (timestamp, sensor_id), name in sorted(data.records_depth.items()):
        records_depth[int(timestamp), sensor_id] = name
    return kapture.Kapture(
        sensors=sensors,
        rigs=rigs or None,
        trajectories=trajectories or None,
        records_camera=records_camera or None,
        records_depth=records_depth or None,
    )
