"""4Seasons' images as kapture, their sparse depth, and the pairs of the MLAD challenges."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.fourseasons_files import (
    Keyframe,
    StereoCalibration,
    read_keyframe,
)
from megloc_kapture.datasets.fourseasons.recordings import CAMERAS, Recording, RelocalizationFile
from megloc_kapture.datasets.kapture_folders import MAPPING
from megloc_kapture.datasets.official import Missing
from megloc_kapture.errors import DataError
from megloc_kapture.io.dataset_tables import RelocalizationPair
from megloc_kapture.io.images import write_depth_map
from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.values import Camera, RigidTransform

RIG, DEPTH = "car", "depth"
DEPTH_FOLDER = "keyframe_depth"


@dataclass(frozen=True)
class DepthJob:
    """A depth map that is still to be made of a keyframe's point cloud.

    Parameters
    ----------
    keyframe : its file.
    timestamp : nanoseconds.
    scale : metres per unit of the recording's SLAM world.
    camera : of the depth map.
    name : of the depth map below ``records_data``.
    """

    keyframe: Path
    timestamp: int
    scale: float
    camera: Camera
    name: str


@dataclass
class ImageRecords:
    """Collects the images of one part, map or queries.

    Parameters
    ----------
    suffixes : the end of the ids of each calibration's car and sensors, shared by both parts. The
        first car keeps the plain names, a car of another calibration is named after the first
        recording that has it.
    missing : takes the files that should be there.
    stereo : whether the right camera is taken too.
    """

    suffixes: dict[StereoCalibration, str]
    missing: Missing
    stereo: bool
    data: KaptureData = field(default_factory=KaptureData)
    depth_jobs: list[DepthJob] = field(default_factory=list)

    def add(
        self, recording: Recording, calibration: StereoCalibration, times: Iterable[int]
    ) -> str:
        """Record a recording's images at these times (ns), as far as they are there.

        Returns
        -------
        The id of the car, which poses belong to.

        Raises
        ------
        DataError : another recording has an image of the same time.
        """
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

    def add_depth(
        self, recording: Recording, calibration: StereoCalibration, scales: Mapping[int, float]
    ) -> None:
        """Record the keyframes' point clouds as depth maps, for the recorded times of ``scales``.

        Parameters
        ----------
        scales : metres per unit of the SLAM world by timestamp (ns).

        Raises
        ------
        DataError : the recording's folder has the name that the depth maps' folder needs.
        """
        if recording.name == DEPTH_FOLDER:
            raise DataError(
                "a recording of this name takes the folder of the depth maps", path=recording.folder
            )
        suffix = self.suffixes[calibration]
        sensor, camera = DEPTH + suffix, calibration.cam0
        self.data.sensors[sensor] = Sensor.from_camera(camera, name=DEPTH, sensor_type="depth")
        self.data.rigs[RIG + suffix][sensor] = RigidTransform.identity()
        for timestamp, scale in scales.items():
            file = recording.keyframe_file(timestamp)
            if (timestamp, CAMERAS[0] + suffix) not in self.data.records_camera:
                continue
            if self.missing.require(file):
                name = f"{DEPTH_FOLDER}/{recording.name}/{timestamp}.depth"
                self.data.records_depth[timestamp, sensor] = name
                self.depth_jobs.append(DepthJob(file, timestamp, scale, camera, name))


def write_depth_maps(jobs: Iterable[DepthJob], output: Path) -> None:
    """Write the depth maps below an import's ``mapping/``.

    Raises
    ------
    DataError : a keyframe's file is broken, or of another time or image size.
    OutputError : a depth map cannot be written.
    """
    for job in jobs:
        keyframe = read_keyframe(job.keyframe)
        size = (keyframe.camera.width, keyframe.camera.height)
        if keyframe.timestamp != job.timestamp or size != (job.camera.width, job.camera.height):
            raise DataError(
                f"timestamp {keyframe.timestamp} and size {size[0]}x{size[1]} are not those of its "
                f"name and the calibration, {job.camera.width}x{job.camera.height}",
                path=job.keyframe,
            )
        file = output / MAPPING / "sensors" / "records_data" / job.name
        write_depth_map(file, depth_map(keyframe, job.scale))


def depth_map(keyframe: Keyframe, scale: float) -> NDArray[np.float32]:
    """Depth along the optical axis, float32 (H, W), metres; 0 where the cloud has no point.

    Parameters
    ----------
    scale : metres per unit of the keyframe's depths. Of several points in a pixel the nearest
        counts; points outside the image or without a positive inverse depth do not.
    """
    width, height = keyframe.camera.width, keyframe.camera.height
    columns, rows, inverse = keyframe.points.T
    with np.errstate(divide="ignore", over="ignore"):
        depth = (scale / inverse).astype(np.float32)
    good = (inverse > 0) & np.isfinite(depth) & (depth > 0)
    good &= (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    nearest = np.full((height, width), np.inf, np.float32)
    at = rows[good].astype(np.int64), columns[good].astype(np.int64)
    np.minimum.at(nearest, at, depth[good])
    return np.where(np.isfinite(nearest), nearest, np.float32(0))


# a query may be matched with the map images of so many keyframes before and after its reference
NEIGHBOURS = 20


@dataclass
class ChallengeTables:
    """The relocalization files in terms of imported images.

    Attributes
    ----------
    pairs : in the files' order.
    priors : query image -> map images around its reference keyframes.
    truth : (recording, timestamp) of a query -> ``cam0_from_local``, where a file has it.
    lost : pairs whose reference has no pose or image, or whose query has no image.
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
    """Pairs, priors and true poses of relocalization files.

    Parameters
    ----------
    cams_from_local : of the reference recordings' keyframes: recording -> timestamp -> pose of the
        left camera.
    mapping, query : what was imported; a pair counts only where both of its images were.
    """
    tables = ChallengeTables()
    map_images, query_images = set(mapping.image_names()), set(query.image_names())
    around: dict[tuple[str, int], set[str]] = {}
    for file in files:
        source, target = recordings[file.source], recordings[file.target]
        poses = cams_from_local[source.name]
        # only what is in the map can be a neighbour
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
