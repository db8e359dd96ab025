"""4Seasons as kapture: images, challenge pairs, keyframe poses.

Poses are in the reference recording's scene (east-north-up), with an origin near its keyframes.
``ECEF_from_cam = e_from_gpsw * inv(w_from_gpsw) * s_from_as * scale * slam_from_cam``, with the
scale of the pose's row.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from megloc_kapture.datasets.fourseasons import (
    CAMERAS,
    GNSS_POSES,
    POSES,
    TRANSFORMATIONS,
    Recording,
    RelocalizationFile,
    StereoCalibration,
    read_gnss_poses,
    read_poses,
    read_transformations,
)
from megloc_kapture.datasets.official import Missing
from megloc_kapture.errors import DataError, require
from megloc_kapture.io.dataset_tables import RelocalizationPair, SimilarityTransform, World
from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.values import RigidTransform

RIG = "car"


@dataclass
class ImageRecords:
    """Images of the map or of the queries; ``suffixes`` of ids are shared by both."""

    suffixes: dict[StereoCalibration, str]
    missing: Missing
    stereo: bool
    data: KaptureData = field(default_factory=KaptureData)

    def add(
        self, recording: Recording, calibration: StereoCalibration, times: Iterable[int]
    ) -> str:
        """Add a recording's images at these times (ns); return the id of the car."""
        fresh = f"_{recording.name}" if self.suffixes else ""
        suffix = self.suffixes.setdefault(calibration, fresh)
        car = RIG + suffix
        cameras = (calibration.cam0, calibration.cam1)[: 2 if self.stereo else 1]
        cams_from_car = (RigidTransform.identity(), calibration.cam1_from_cam0)
        members = self.data.rigs.setdefault(car, {})
        for name, camera, cam_from_car in zip(CAMERAS, cameras, cams_from_car, strict=False):
            self.data.sensors[name + suffix] = Sensor.from_camera(camera, name=name)
            members[name + suffix] = cam_from_car
        for timestamp in times:
            for name, _ in zip(CAMERAS, cameras, strict=False):
                record, image = (timestamp, name + suffix), recording.image(timestamp, name)
                if record in self.data.records_camera:
                    raise DataError(
                        f"{self.data.records_camera[record]} has the same time",
                        path=recording.image_file(timestamp, name),
                    )
                if self.missing.require(recording.image_file(timestamp, name)):
                    self.data.records_camera[record] = image
        return car


# a query may be matched with map images of this many keyframes before and after its reference
NEIGHBOURS = 20


@dataclass
class ChallengeTables:
    """The relocalization files in terms of imported images.

    ``priors`` maps queries to permitted map images, ``truth`` maps (recording, timestamp) to
    ``cam0_from_local``; ``lost`` counts pairs without pose or images.
    """

    pairs: list[RelocalizationPair] = field(default_factory=list)
    priors: dict[str, tuple[str, ...]] = field(default_factory=dict)
    truth: dict[tuple[str, int], RigidTransform] = field(default_factory=dict)
    lost: int = 0


def challenge_tables(
    files: Sequence[RelocalizationFile],
    recordings: Mapping[str, Recording],
    cams_from_local: Mapping[str, Mapping[int, RigidTransform]],
    mapping: KaptureData,
    query: KaptureData,
) -> ChallengeTables:
    """Return the pairs, priors and true poses; ``cams_from_local`` is for left cameras."""
    tables = ChallengeTables()
    map_images, query_images = set(mapping.image_names()), set(query.image_names())
    around: dict[tuple[str, int], set[str]] = {}
    for file in files:
        source, target = recordings[file.source], recordings[file.target]
        poses = cams_from_local[source.name]
        times = [t for t in sorted(poses) if source.image(t, CAMERAS[0]) in map_images]
        indices = {timestamp: index for index, timestamp in enumerate(times)}
        for row in file.rows:
            image = target.image(row.query, CAMERAS[0])
            if row.reference not in indices or image not in query_images:
                tables.lost += 1
                continue
            reference = source.image(row.reference, CAMERAS[0])
            tables.pairs.append(RelocalizationPair(file.path.name, reference, image))
            index = indices[row.reference]
            near = times[max(0, index - NEIGHBOURS) : index + NEIGHBOURS + 1]
            names = {source.image(t, camera) for t in near for camera in CAMERAS}
            around.setdefault((target.name, row.query), set()).update(names & map_images)
            if row.query_from_reference is not None:
                pose = row.query_from_reference @ poses[row.reference]
                tables.truth.setdefault((target.name, row.query), pose)
    for (name, timestamp), permitted in around.items():
        for camera in CAMERAS:
            image = recordings[name].image(timestamp, camera)
            if image in query_images:
                tables.priors[image] = tuple(sorted(permitted))
    return tables


# ----------------------------------------------------------------------------------- poses


@dataclass(frozen=True)
class KeyframePoses:
    """The poses of one recording's keyframes, by timestamp (ns).

    ``scene_from_cam`` is for the undistorted left camera, in metres; ``earth_from_scene`` goes to
    ECEF; ``dropped`` keyframes have poor GNSS fusion.
    """

    scene_from_cam: Mapping[int, RigidTransform]
    earth_from_scene: RigidTransform | None
    dropped: Sequence[int] = ()


@dataclass(frozen=True)
class LocalFrame:
    """The frame of the map: a recording's scene, moved to ``origin`` (metres)."""

    earth_from_scene: RigidTransform | None
    origin: tuple[float, float, float]

    @classmethod
    def around(cls, poses: KeyframePoses) -> LocalFrame:
        """Choose an origin in whole metres near the keyframes of a reference recording."""
        centers = np.array([pose.translation for pose in poses.scene_from_cam.values()])
        x, y, z = np.round(centers.mean(axis=0)).tolist()
        return cls(poses.earth_from_scene, (x, y, z))

    def cams_from_local(self, poses: KeyframePoses) -> dict[int, RigidTransform]:
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
        """Return the transform back to ECEF, or to the frame of ``poses.txt``."""
        scene = self.earth_from_scene or RigidTransform.identity()
        official_from_local = scene @ RigidTransform((1.0, 0.0, 0.0, 0.0), self.origin)
        return World(
            official_from_local=SimilarityTransform(
                quat_wxyz=official_from_local.quat_wxyz, translation=official_from_local.translation
            )
        )


def read_keyframe_poses(
    recording: Recording, *, min_fusion_quality: int, on_earth: bool, missing: Missing
) -> KeyframePoses | None:
    """Return the published keyframe poses, or None; ``on_earth`` excludes ``poses.txt``."""
    plain = recording.folder / POSES
    if not on_earth and plain.is_file():
        poses = read_poses(plain)
        return KeyframePoses(dict(sorted(poses.items())), None)
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
    dropped = []
    for timestamp, row in sorted(read_gnss_poses(path).items()):
        if row.fusion_quality is not None and row.fusion_quality < min_fusion_quality:
            dropped.append(timestamp)
            continue
        scale = transformations.gnss_scale if row.scale is None else row.scale
        if scale is None:
            raise DataError(
                "neither the pose nor Transformations.txt has a scale",
                path=path,
            )
        x, y, z = (scale * value for value in row.slam_from_cam.translation)
        metric = RigidTransform(row.slam_from_cam.quat_wxyz, (x, y, z))
        poses[timestamp] = scene_from_slam @ metric
    require(
        poses,
        f"none of its {len(dropped)} poses has a fusion quality of {min_fusion_quality} or "
        "better; lower min_fusion_quality takes them",
        path=path,
    )
    return KeyframePoses(poses, transformations.e_from_gpsw, dropped)
