"""kapture folders: the names that several other modules use."""

from megloc_kapture.io.kapture.features import FeatureConfig, FeatureReader, FeatureWriter
from megloc_kapture.io.kapture.folder import KaptureFolder
from megloc_kapture.io.kapture.format import writable_name
from megloc_kapture.io.kapture.matches import (
    ImagePair,
    MatchesReader,
    MatchesWriter,
    read_pairs,
    write_pairs,
)
from megloc_kapture.io.kapture.points import (
    Observations,
    read_point_covariances,
    write_observations,
    write_point_covariances,
    write_points3d,
)
from megloc_kapture.io.kapture.sensors import KaptureData, Sensor, is_kapture, write_sensors

__all__ = [
    "FeatureConfig",
    "FeatureReader",
    "FeatureWriter",
    "ImagePair",
    "KaptureData",
    "KaptureFolder",
    "MatchesReader",
    "MatchesWriter",
    "Observations",
    "Sensor",
    "is_kapture",
    "read_pairs",
    "read_point_covariances",
    "write_observations",
    "write_pairs",
    "write_point_covariances",
    "write_points3d",
    "write_sensors",
    "writable_name",
]
