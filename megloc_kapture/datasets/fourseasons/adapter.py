"""4Seasons and the MLAD challenges: localization of one recording in another.

A challenge's relocalization files lie in the root, in one of its folders, or in
``RelocalizationFiles*`` below either. They select the recordings and the queries, and assign a
nearby keyframe to each query. Poses are in the reference recording's scene (east-north-up), with an
origin near its keyframes.
``ECEF_from_cam = e_from_gpsw * inv(w_from_gpsw) * s_from_as * scale * slam_from_cam``, in the
notation of Transformations.txt (s = w); ``scale`` is in the pose's row or else in that file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from megloc_kapture.datasets.fourseasons import (
    CAMERAS,
    GNSS_POSES,
    POSES,
    PUBLISHED_PAIRS,
    TRANSFORMATIONS,
    Calibration,
    Recording,
    RelocalizationFile,
    Selection,
    read_gnss_poses,
    read_poses,
    read_transformations,
    select,
)
from megloc_kapture.datasets.official import (
    Count,
    DatasetCard,
    Missing,
    OfficialDataset,
    read_ground_truth,
    with_poses,
)
from megloc_kapture.errors import DataError, require
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.dataset_tables import (
    ImageGroup,
    RelocalizationPair,
    SimilarityTransform,
    World,
)
from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.values import Options, RigidTransform

NAME = "4seasons"
RIG = "car"
# thresholds of other long-term benchmarks, used without relocalization files
_GENERAL_THRESHOLDS = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))


class FourSeasonsOptions(Options):
    """The part of 4Seasons to import."""

    reference: tuple[str, ...] = Field(
        default=(),
        description="recordings of the map; default: the sources of the relocalization files, "
        "else the first by name with poses",
    )
    queries: tuple[str, ...] = Field(
        default=(),
        description="recordings of the queries; default: the targets of the relocalization files, "
        "else all others",
    )
    frames: Literal["keyframes", "all"] = Field(
        default="keyframes",
        description="images to import: keyframes with a pose (for queries: those in the "
        "relocalization files, if any), or all images on disk",
    )
    stereo: bool = Field(default=True, description="also import the right camera")
    min_fusion_quality: int = Field(
        default=1,
        ge=0,
        le=2,
        description="lowest fusion quality to use: 2 fused with GNSS, 1 interpolated, 0 neither",
    )


class FourSeasons:
    """Adapter of 4Seasons (group ``megloc_kapture.datasets``)."""

    name = NAME
    Options = FourSeasonsOptions
    card = DatasetCard(
        title="4Seasons",
        published_at="https://www.4seasons-dataset.com",
        size="several GB per recording (undistorted stereo images and reference poses), plus "
        "one calibration.zip",
        folders=("4Seasons",),
        layout="ROOT/calibration/ and ROOT/<recording>/{undistorted_images/,GNSSPoses.txt,"
        "Transformations.txt} of two recordings or more; relocalization files of a "
        "challenge in ROOT or the reference recording's folder",
    )

    def __init__(self, options: FourSeasonsOptions | None = None) -> None:
        self.options = options or FourSeasonsOptions()

    def check(self, root: Path) -> None:
        chosen = select(root, self.options.reference, self.options.queries, Missing(root))
        for recording in (*chosen.references, *chosen.queries):
            recording.calibration(root)

    def read(self, root: Path, *, allow_missing: bool = False) -> OfficialDataset:
        missing, quality = Missing(root), self.options.min_fusion_quality
        chosen = select(root, self.options.reference, self.options.queries, missing)
        used = (*chosen.references, *chosen.queries)
        poses = self._reference_poses(chosen.references, missing)
        frame = LocalFrame.around(poses[chosen.references[0].name])
        local = {name: frame.cams_from_local(keyframes) for name, keyframes in poses.items()}
        calibrations = {recording.name: recording.calibration(root) for recording in used}
        cars = _car_ids(calibrations)
        mapping, query = KaptureData(), KaptureData()
        for recording in chosen.references:
            name, known = recording.name, local[recording.name]
            times: Iterable[int] = sorted(known)
            if self.options.frames == "all":
                times = recording.times_on_disk(CAMERAS[0])
            self._add_images(mapping, recording, calibrations[name], cars[name], times, missing)
            taken = {timestamp for timestamp, _ in mapping.records_camera}
            mapping.trajectories |= {(t, cars[name]): known[t] for t in known if t in taken}
        truth: dict[tuple[int, str], RigidTransform] = {}
        for recording in chosen.queries:
            name = recording.name
            published = None
            if frame.earth_from_scene is not None:
                published = read_keyframe_poses(recording, quality, missing)
            known = {} if published is None else frame.cams_from_local(published)
            times = self._query_times(recording, known, chosen.files, missing)
            self._add_images(query, recording, calibrations[name], cars[name], times, missing)
            truth |= {(time, cars[name]): pose for time, pose in known.items()}
        pairs, priors, true_poses = challenge_tables(
            chosen.files, chosen.recordings, local, mapping, query
        )
        truth |= {(time, cars[name]): pose for (name, time), pose in true_poses.items()}
        lost = sum(len(file.rows) for file in chosen.files) - len(pairs)
        groups = _image_groups(chosen, mapping, query)
        truth_folder, truth_groups = read_ground_truth(root, query, frame.world())
        for image in groups.keys() & truth_groups.keys():
            condition = truth_groups[image].condition or groups[image].condition
            groups[image] = groups[image].model_copy(update={"condition": condition})
        query_gt = _known_poses(query, truth, truth_folder)
        rules: dict[str, Any] = {
            "conditions": tuple(recording.name for recording in chosen.queries)
        }
        if not chosen.files:  # no challenge: write absolute poses
            rules |= {"thresholds": _GENERAL_THRESHOLDS, "pose_file": "ltvl"}
        return OfficialDataset(
            mapping=mapping,
            query=query,
            query_gt=query_gt,
            links={recording.name: recording.folder for recording in used},
            protocol=protocol_of(NAME).model_copy(update=rules),
            groups=groups,
            priors=priors,
            relocalization=pairs,
            world=frame.world(),
            summary=_summary(chosen, poses, mapping, query, query_gt),
            remarks=_remarks(poses, frame, lost, quality),
            missing=missing,
        )

    def _reference_poses(
        self, references: Sequence[Recording], missing: Missing
    ) -> dict[str, KeyframePoses]:
        poses_of, quality = {}, self.options.min_fusion_quality
        for recording in references:
            # poses.txt cannot be used for several recordings: each file has a separate frame
            keyframes = read_keyframe_poses(
                recording, quality, missing, on_earth=len(references) > 1
            )
            if keyframes is None:
                raise DataError(
                    f"no poses for the map: {GNSS_POSES} and {TRANSFORMATIONS} are needed"
                    + (f", or {POSES}" if len(references) == 1 else ""),
                    path=recording.folder,
                )
            poses_of[recording.name] = keyframes
        return poses_of

    def _add_images(
        self,
        data: KaptureData,
        recording: Recording,
        calibration: Calibration,
        car: str,
        times: Iterable[int],
        missing: Missing,
    ) -> None:
        """Add a recording's rig, and its images at these times (ns)."""
        names = CAMERAS if self.options.stereo else CAMERAS[:1]
        sensor_of = {name: name + car.removeprefix(RIG) for name in names}
        members = data.rigs.setdefault(car, {})
        for name, sensor in sensor_of.items():
            camera, members[sensor] = calibration[name]  # the car's frame is that of cam0
            data.sensors[sensor] = Sensor.from_camera(camera, name=name)
        for timestamp in times:
            for name, sensor in sensor_of.items():
                if missing.require(recording.image_file(timestamp, name)):
                    image = recording.image(timestamp, name)
                    data.records_camera[timestamp, sensor] = image

    def _query_times(
        self,
        recording: Recording,
        poses: Mapping[int, RigidTransform],
        files: Sequence[RelocalizationFile],
        missing: Missing,
    ) -> list[int]:
        requested = {query for f in files if f.target == recording.name for _, query in f.rows}
        times = requested or set(poses)
        if self.options.frames == "all" or not times:
            times = requested | set(recording.times_on_disk(CAMERAS[0]))
        if not times:
            missing.require(recording.image_file(0, CAMERAS[0]).parent)
        return sorted(times)


def _car_ids(calibrations: Mapping[str, Calibration]) -> dict[str, str]:
    """Return the rig of each recording; recordings with the same calibration share one."""
    cars: dict[str, str] = {}
    for recording, calibration in calibrations.items():
        same = next((car for other, car in cars.items() if calibrations[other] == calibration), "")
        cars[recording] = same or (f"{RIG}_{recording}" if cars else RIG)
    return cars


def _known_poses(
    query: KaptureData,
    published: Mapping[tuple[int, str], RigidTransform],
    truth_folder: KaptureData | None,
) -> KaptureData | None:
    """Return the queries with their published poses, else with those in ``ground_truth/``."""
    times = {timestamp for timestamp, _ in query.records_camera}
    poses = {key: pose for key, pose in published.items() if key[0] in times}
    if truth_folder is not None:
        known, others = with_poses(query, poses), truth_folder.trajectories
        poses |= {k: pose for k, pose in others.items() if known.device_from_world(*k) is None}
    return with_poses(query, poses) if poses else None


def _image_groups(
    chosen: Selection, mapping: KaptureData, query: KaptureData
) -> dict[str, ImageGroup]:
    """Return image groups; the condition of a query is its recording.

    Only left images are scored; if a recording has relocalization files, only those listed there.
    """
    groups = {
        image: ImageGroup(location=image.partition("/")[0]) for image in mapping.image_names()
    }
    requested = {
        chosen.recordings[file.target].image(query_time, CAMERAS[0])
        for file in chosen.files
        for _, query_time in file.rows
    }
    requested_recordings = {file.target for file in chosen.files}
    for (timestamp, _), image in query.records_camera.items():
        name = image.partition("/")[0]
        left = image == chosen.recordings[name].image(timestamp, CAMERAS[0])
        scored = left and (name not in requested_recordings or image in requested)
        groups[image] = ImageGroup(condition=name, scored=scored)
    return groups


def _summary(
    chosen: Selection,
    poses: Mapping[str, KeyframePoses],
    mapping: KaptureData,
    query: KaptureData,
    query_gt: KaptureData | None,
) -> list[Count]:
    counts = [Count("recordings", len(chosen.recordings))]
    images = [image.partition("/")[0] for data in (mapping, query) for image in data.image_names()]
    for part, recordings in (("map", chosen.references), ("query", chosen.queries)):
        for recording in recordings:
            counts.append(Count(f"{recording.name}: {part} images", images.count(recording.name)))
            if recording.name in poses:
                keyframes = poses[recording.name]
                rows = len(keyframes.scene_from_cam) + keyframes.num_dropped
                counts.append(Count("  keyframes with a pose", len(keyframes.scene_from_cam), rows))
    for file in chosen.files:
        published = PUBLISHED_PAIRS.get((file.source, file.target))
        counts.append(Count(f"pairs in {file.path.name}", len(file.rows), published))
    counts.append(Count("images with a pose in the map", len(mapping.poses())))
    counts.append(Count("queries", len(query.records_camera)))
    known = 0 if query_gt is None else len(query_gt.poses())
    counts.append(Count("queries with a known pose", known))
    return counts


def _remarks(
    poses: Mapping[str, KeyframePoses],
    frame: LocalFrame,
    lost: int,
    min_fusion_quality: int,
) -> list[str]:
    remarks = []
    for name, keyframes in poses.items():
        if keyframes.num_dropped:
            remarks.append(
                f"{name}: {keyframes.num_dropped} keyframes are left out: their fusion quality "
                f"is below {min_fusion_quality} (min_fusion_quality)."
            )
    if frame.earth_from_scene is None:
        remarks.append(
            f"The map's poses are those of {POSES}, whose frame no other recording shares: "
            "only the query poses in relocalization files are known."
        )
    if lost:
        remarks.append(
            f"{lost} pairs of relocalization files are left out: their reference has no "
            "pose or image, or their query has no image. A challenge expects every pair."
        )
    return remarks


# -------------------------------------------------------------------------------- challenges


# a query may be matched with the images of this many keyframes before and after its reference
NEIGHBOURS = 20
ImageKey = tuple[str, int]  # recording and timestamp of a query


def challenge_tables(
    files: Sequence[RelocalizationFile],
    recordings: Mapping[str, Recording],
    cams_from_local: Mapping[str, Mapping[int, RigidTransform]],
    mapping: KaptureData,
    query: KaptureData,
) -> tuple[list[RelocalizationPair], dict[str, tuple[str, ...]], dict[ImageKey, RigidTransform]]:
    """Convert the relocalization files to tables of imported images.

    ``cams_from_local`` holds poses of the left cameras by recording and timestamp. Return the
    pairs, the permitted map images of each query, and the known ``cam0_from_local`` of queries.
    Pairs without a reference pose or without images are left out.
    """
    pairs: list[RelocalizationPair] = []
    truth: dict[ImageKey, RigidTransform] = {}
    map_images, query_images = set(mapping.image_names()), set(query.image_names())
    around: dict[ImageKey, set[str]] = {}
    for file in files:
        source, target = recordings[file.source], recordings[file.target]
        poses = cams_from_local[source.name]
        times = [t for t in sorted(poses) if source.image(t, CAMERAS[0]) in map_images]
        indices = {timestamp: index for index, timestamp in enumerate(times)}
        for (reference_time, query_time), query_from_reference in file.rows.items():
            image = target.image(query_time, CAMERAS[0])
            if reference_time not in indices or image not in query_images:
                continue
            reference = source.image(reference_time, CAMERAS[0])
            pairs.append(RelocalizationPair(file.path.name, reference, image))
            index = indices[reference_time]
            near = times[max(0, index - NEIGHBOURS) : index + NEIGHBOURS + 1]
            names = {source.image(t, camera) for t in near for camera in CAMERAS}
            around.setdefault((target.name, query_time), set()).update(names & map_images)
            if query_from_reference is not None:
                pose = query_from_reference @ poses[reference_time]
                truth.setdefault((target.name, query_time), pose)
    priors = {
        image: tuple(sorted(permitted))
        for (name, timestamp), permitted in around.items()
        for camera in CAMERAS
        if (image := recordings[name].image(timestamp, camera)) in query_images
    }
    return pairs, priors, truth


# ----------------------------------------------------------------------------------- poses


@dataclass(frozen=True)
class KeyframePoses:
    """The poses of one recording's keyframes, by timestamp (ns).

    ``scene_from_cam`` is the pose of the undistorted left camera, in metres. ``earth_from_scene``
    transforms to ECEF. The fusion quality of ``num_dropped`` keyframes is too low.
    """

    scene_from_cam: Mapping[int, RigidTransform]
    earth_from_scene: RigidTransform | None
    num_dropped: int = 0


@dataclass(frozen=True)
class LocalFrame:
    """The frame of the map: a recording's scene, moved so that ``origin`` (metres) becomes zero."""

    earth_from_scene: RigidTransform | None
    origin: tuple[float, float, float]

    @classmethod
    def around(cls, poses: KeyframePoses) -> LocalFrame:
        """Choose an origin in whole metres near the keyframes of a reference recording."""
        centers = np.array([pose.translation for pose in poses.scene_from_cam.values()])
        x, y, z = np.round(centers.mean(axis=0)).tolist()
        return cls(poses.earth_from_scene, (x, y, z))

    def cams_from_local(self, poses: KeyframePoses) -> dict[int, RigidTransform]:
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
        """Return the transform to the official frame: ECEF, or the frame of ``poses.txt``."""
        scene = self.earth_from_scene or RigidTransform.identity()
        official_from_local = scene @ RigidTransform((1.0, 0.0, 0.0, 0.0), self.origin)
        return World(
            official_from_local=SimilarityTransform(
                quat_wxyz=official_from_local.quat_wxyz, translation=official_from_local.translation
            )
        )


def read_keyframe_poses(
    recording: Recording, min_fusion_quality: int, missing: Missing, *, on_earth: bool = True
) -> KeyframePoses | None:
    """Return the published keyframe poses or None; ``on_earth`` excludes those of ``poses.txt``."""
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
    scene_from_slam, earth_from_scene, common_scale = read_transformations(
        recording.folder / TRANSFORMATIONS
    )
    poses: dict[int, RigidTransform] = {}
    rows = read_gnss_poses(path)
    for timestamp, (slam_from_cam, scale, quality) in sorted(rows.items()):
        if quality is not None and quality < min_fusion_quality:
            continue
        scale = common_scale if scale is None else scale
        if scale is None:
            raise DataError("neither the pose nor Transformations.txt has a scale", path=path)
        x, y, z = (scale * value for value in slam_from_cam.translation)
        metric = RigidTransform(slam_from_cam.quat_wxyz, (x, y, z))
        poses[timestamp] = scene_from_slam @ metric
    require(
        poses,
        f"none of its {len(rows)} poses has a fusion quality of {min_fusion_quality} or "
        "better; a lower min_fusion_quality accepts them",
        path=path,
    )
    return KeyframePoses(poses, earth_from_scene, len(rows) - len(poses))
