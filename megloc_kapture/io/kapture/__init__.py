"""kapture folders: the interface for other subpackages."""

from megloc_kapture.io.kapture.features import (
    FeatureConfig,
    FeatureKind,
    FeatureReader,
    FeatureWriter,
    KaptureVectors,
    feature_folder,
)
from megloc_kapture.io.kapture.folder import KaptureFolder
from megloc_kapture.io.kapture.format import KaptureData, Sensor, writable_name
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
    write_ply,
    write_point_covariances,
    write_points3d,
)
from megloc_kapture.io.kapture.sensors import unit_quaternion, write_sensors

__all__ = [
    "FeatureConfig",
    "FeatureKind",
    "FeatureReader",
    "FeatureWriter",
    "ImagePair",
    "KaptureData",
    "KaptureFolder",
    "KaptureVectors",
    "MatchesReader",
    "MatchesWriter",
    "Observations",
    "Sensor",
    "feature_folder",
    "read_pairs",
    "read_point_covariances",
    "unit_quaternion",
    "write_observations",
    "write_pairs",
    "write_ply",
    "write_point_covariances",
    "write_points3d",
    "write_sensors",
    "writable_name",
]
