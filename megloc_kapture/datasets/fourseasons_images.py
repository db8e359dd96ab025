"""4Seasons' images as kapture: one car with two cameras, and its keyframes' sparse depth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.fourseasons_recordings import CAMERAS, Recording
from megloc_kapture.datasets.grammars.fourseasons_calibration import StereoCalibration
from megloc_kapture.datasets.grammars.fourseasons_keyframes import Keyframe, read_keyframe
from megloc_kapture.datasets.kapture_folders import MAPPING
from megloc_kapture.datasets.official import Missing
from megloc_kapture.errors import DataError
from megloc_kapture.io.depth_maps import write_depth_map
from megloc_kapture.io.kapture_store import KaptureData, Sensor
from megloc_kapture.values import Camera, RigidTransform

RIG, DEPTH = "car", "depth"
DEPTH_FOLDER = "keyframe_depth"


@dataclass
class CarNames:
    """Ids of the car and its sensors, the same for map and queries.

    A calibration has one car; the first keeps the plain names, a car of another calibration is
    named after the first recording that has it.
    """

    _suffixes: dict[StereoCalibration, str] = field(default_factory=dict)

    def suffix(self, calibration: StereoCalibration, recording: Recording) -> str:
        """What the ids of this calibration's car and sensors end with."""
        fresh = f"_{recording.name}" if self._suffixes else ""
        return self._suffixes.setdefault(calibration, fresh)


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
    names : of the cars, shared by both parts.
    missing : takes the files that should be there.
    stereo : whether the right camera is taken too.
    """

    names: CarNames
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
        suffix = self.names.suffix(calibration, recording)
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
                "a recording of this name leaves no place for depth maps", path=recording.folder
            )
        suffix = self.names.suffix(calibration, recording)
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
        place = output / MAPPING / "sensors" / "records_data" / job.name
        write_depth_map(place, depth_map(keyframe, job.scale))


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
