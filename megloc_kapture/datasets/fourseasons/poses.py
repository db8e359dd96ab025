"""4Seasons' keyframe poses in one metric frame.

Every recording has a SLAM world and a scene (an east-north-up frame) of its own; only the earth is
common to all. The poses of all recordings are brought into the scene of the reference recording,
less an origin amid its keyframes: metric, level, and small numbers.

``ECEF_from_cam = e_from_gpsw * inv(w_from_gpsw) * s_from_as * scale * slam_from_cam``, with the
scale of the pose's own row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from megloc_kapture.datasets.formats.fourseasons_files import (
    read_gnss_poses,
    read_poses,
    read_transformations,
)
from megloc_kapture.datasets.fourseasons.recordings import (
    CAMERAS,
    GNSS_POSES,
    POSES,
    TRANSFORMATIONS,
    Recording,
)
from megloc_kapture.datasets.official import Missing
from megloc_kapture.errors import DataError
from megloc_kapture.geometry.poses import earth_from_enu, geodetic
from megloc_kapture.io.dataset_tables import SimilarityTransform, World
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import RigidTransform

# from the centre of the earth, of roads
_LEAST_RADIUS_M, _GREATEST_RADIUS_M = 6.3e6, 6.4e6


@dataclass(frozen=True)
class KeyframePoses:
    """The poses of one recording's keyframes.

    Parameters
    ----------
    scene_from_cam : of the undistorted left camera by timestamp (ns), metres, sorted.
    earth_from_scene : to ECEF; None where it is not published.
    scales : metres per unit of the recording's SLAM world by timestamp, where known.
    dropped : timestamps of keyframes whose fusion with GNSS is too poor.
    """

    scene_from_cam: Mapping[int, RigidTransform]
    earth_from_scene: RigidTransform | None
    scales: Mapping[int, float]
    dropped: Sequence[int] = ()


@dataclass(frozen=True)
class LocalFrame:
    """The frame of the map: a recording's scene, moved to an origin near its keyframes.

    Parameters
    ----------
    earth_from_scene : of the reference recording; None where it is not on earth.
    origin : in the scene, metres.
    """

    earth_from_scene: RigidTransform | None
    origin: tuple[float, float, float]

    @classmethod
    def around(cls, poses: KeyframePoses) -> LocalFrame:
        """The frame of a reference recording; the origin is a whole number of metres."""
        centers = np.array([pose.translation for pose in poses.scene_from_cam.values()])
        x, y, z = np.round(centers.mean(axis=0)).tolist()
        return cls(poses.earth_from_scene, (x, y, z))

    def cams_from_local(self, poses: KeyframePoses) -> dict[int, RigidTransform]:
        """``cam_from_local`` of a recording's keyframes by timestamp.

        Raises
        ------
        ValueError : one of the recordings is on earth and the other is not.
        """
        if (poses.earth_from_scene is None) != (self.earth_from_scene is None):
            raise ValueError("no way leads from one recording's scene to the other's")
        x, y, z = self.origin
        local_from_scene = RigidTransform((1.0, 0.0, 0.0, 0.0), (-x, -y, -z))
        if self.earth_from_scene is not None and poses.earth_from_scene is not None:
            between = self.earth_from_scene.inverse() @ poses.earth_from_scene
            local_from_scene = local_from_scene @ between
        return {
            timestamp: (local_from_scene @ pose).inverse()
            for timestamp, pose in poses.scene_from_cam.items()
        }

    def world(self) -> World:
        """The way back: to ECEF, or to the frame of ``poses.txt``."""
        scene = self.earth_from_scene or RigidTransform.identity()
        official_from_local = scene @ RigidTransform((1.0, 0.0, 0.0, 0.0), self.origin)
        return World(
            official_from_local=SimilarityTransform(
                quat_wxyz=official_from_local.quat_wxyz,
                translation=official_from_local.translation,
            )
        )


def read_keyframe_poses(
    recording: Recording, *, min_fusion_quality: int, on_earth: bool, missing: Missing
) -> KeyframePoses | None:
    """The published poses of a recording's keyframes, or None where there are none.

    Parameters
    ----------
    min_fusion_quality : rows of less are dropped.
    on_earth : takes ``GNSSPoses.txt`` only; else ``poses.txt`` where it is there.
    missing : takes a ``Transformations.txt`` that should be there.

    Raises
    ------
    DataError : a broken file, a row without scale where nothing else tells it, or no row that is
        good enough.
    """
    if recording.kapture is not None:
        return _kapture_poses(recording.kapture)
    plain = recording.folder / POSES
    if not on_earth and plain.is_file():
        poses = read_poses(plain)
        return KeyframePoses(dict(sorted(poses.items())), None, _scales_beside(recording))
    if not (recording.folder / GNSS_POSES).is_file():
        return None
    if not missing.require(recording.folder / TRANSFORMATIONS):
        return None
    return _gnss_poses(recording, min_fusion_quality)


def _gnss_poses(recording: Recording, min_fusion_quality: int) -> KeyframePoses:
    path = recording.folder / GNSS_POSES
    transformations = read_transformations(recording.folder / TRANSFORMATIONS)
    scene_from_slam = transformations.w_from_gpsw.inverse() @ transformations.s_from_as
    poses: dict[int, RigidTransform] = {}
    scales: dict[int, float] = {}
    dropped = []
    for timestamp, row in sorted(read_gnss_poses(path).items()):
        if row.fusion_quality is not None and row.fusion_quality < min_fusion_quality:
            dropped.append(timestamp)
            continue
        scale = transformations.gnss_scale if row.scale is None else row.scale
        if scale is None:
            raise DataError(
                "the pose has no scale, and Transformations.txt has none either",
                path=path,
                line=row.line,
            )
        x, y, z = (scale * value for value in row.slam_from_cam.translation)
        metric = RigidTransform(row.slam_from_cam.quat_wxyz, (x, y, z))
        poses[timestamp] = scene_from_slam @ metric
        scales[timestamp] = scale
    if not poses:
        raise DataError(
            f"none of its {len(dropped)} poses has a fusion quality of {min_fusion_quality} or "
            "better; lower min_fusion_quality takes them",
            path=path,
        )
    return KeyframePoses(poses, transformations.e_from_gpsw, scales, dropped)


def _kapture_poses(folder: KaptureFolder) -> KeyframePoses | None:
    """The poses that kapture's importer writes, on earth and of the car, whose frame is cam0's.

    It keeps all keyframes, whatever their fusion. The scene is made anew, east, north and up
    amid them.
    """
    data = folder.read()
    poses: dict[int, RigidTransform] = {}
    for timestamp in sorted({timestamp for timestamp, _ in data.trajectories}):
        cam_from_earth = data.device_from_world(timestamp, CAMERAS[0])
        if cam_from_earth is not None:
            poses[timestamp] = cam_from_earth.inverse()
    if not poses:
        return None
    middle = np.median([pose.translation for pose in poses.values()], axis=0)
    if not _LEAST_RADIUS_M < float(np.linalg.norm(middle)) < _GREATEST_RADIUS_M:
        raise DataError(
            "the poses are not on earth; kapture's importer writes ECEF where it finds "
            f"{TRANSFORMATIONS}",
            path=folder.root / "sensors" / "trajectories.txt",
        )
    earth_from_scene = earth_from_enu(*geodetic(middle))
    scene_from_earth = earth_from_scene.inverse()
    scene = {timestamp: scene_from_earth @ pose for timestamp, pose in poses.items()}
    return KeyframePoses(scene, earth_from_scene, {})


def _scales_beside(recording: Recording) -> dict[int, float]:
    """Scales of a recording's SLAM world where its ``GNSSPoses.txt`` is there too."""
    path = recording.folder / GNSS_POSES
    if not path.is_file():
        return {}
    rows = read_gnss_poses(path)
    return {timestamp: row.scale for timestamp, row in rows.items() if row.scale is not None}
