"""The rendered world in 4Seasons' layout: three recordings of one route, with their truth.

The map is driven on a summer's day; queries ask for their place in winter, whose poses are
published, and at dusk, whose poses a challenge withholds. Relocalization files name the keyframes
that are asked for.
"""

from __future__ import annotations

from concurrent.futures import Executor
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.datasets.official import GROUND_TRUTH
from megloc_kapture.datasets.synthetic.fourseasons_drive import (
    CAM1_FROM_CAM0,
    CAMERAS,
    Drive,
    Frame,
    drive_frames,
    painting_options,
    season_builder,
    stereo_camera,
)
from megloc_kapture.datasets.synthetic.fourseasons_twin_files import (
    EARTH_FROM_WORLD,
    SlamFrames,
    calibration_texts,
    cloud_of,
    gnss_poses_text,
    keyframe_text,
    nmea_text,
    relocalization_text,
    result_text,
    start_of,
    times_text,
    transformations_text,
)
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions, stream
from megloc_kapture.datasets.synthetic.shots import Shot
from megloc_kapture.datasets.synthetic.studio import draw_shots
from megloc_kapture.datasets.synthetic.tracks import exact_tracks
from megloc_kapture.datasets.synthetic.views import View
from megloc_kapture.io.files import write_bytes
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.stages.work import Track, untracked
from megloc_kapture.values import Options, RigidTransform

# raise when the same options draw other pixels or other files than before
FOURSEASONS_TWIN_VERSION = 2

REFERENCE = "recording_2020-06-18_10-12-33"
WINTER = "recording_2021-01-15_13-04-17"
DUSK = "recording_2021-03-22_18-41-05"

_EXPOSURE_MS = {REFERENCE: 0.2457180023, WINTER: 1.9, DUSK: 10.0}
_GREY = np.array([299, 587, 114])  # thousandths

Drawn = tuple[NDArray[np.uint8], NDArray[np.float32]] | None


class FourSeasonsTwinOptions(Options):
    """What the twin of 4Seasons contains."""

    seed: int = Field(default=0, ge=0, description="every random choice hangs on it")
    num_places: int = Field(default=4, ge=1, description="places on the route")
    map_keyframes: int = Field(
        default=12, ge=3, description="keyframes of the map's recording in each place"
    )
    winter_keyframes: int = Field(
        default=6, ge=1, description="keyframes of the winter's recording in each place"
    )
    dusk_keyframes: int = Field(
        default=4, ge=1, description="keyframes of the recording at dusk in each place"
    )
    width: int = Field(default=800, ge=64, description="image width in px")
    height: int = Field(default=400, ge=48, description="image height in px")
    supersampling: int = Field(default=2, ge=1, le=4, description="samples per px and axis")
    cloud_points: int = Field(
        default=150, ge=0, description="pixels tried for each keyframe's point cloud"
    )

    def world(self) -> SyntheticWorldOptions:
        """The options of the world that is driven through."""
        return SyntheticWorldOptions(
            seed=self.seed,
            num_places=self.num_places,
            width=self.width,
            height=self.height,
            supersampling=self.supersampling,
        )

    def drives(self) -> tuple[Drive, Drive, Drive]:
        """The recordings, the map's first."""
        return (
            Drive(REFERENCE, "summer", start_of(REFERENCE), self.map_keyframes, "mapping", 0.1, 2),
            Drive(WINTER, "winter", start_of(WINTER), self.winter_keyframes, "query", 0.6, 8),
            Drive(DUSK, "dusk", start_of(DUSK), self.dusk_keyframes, "query", 0.9, 12),
        )


def write_fourseasons_twin(
    root: Path,
    options: FourSeasonsTwinOptions | None = None,
    executor: Executor | None = None,
    *,
    track: Track = untracked,
) -> dict[str, int]:
    """Draw the twin and write it in 4Seasons' layout; returns what it holds.

    Below ``root``: ``calibration/``, three recordings, relocalization files as in 2021, and the
    true poses (ECEF) in ``ground_truth/``. The bytes depend on the options only.

    Parameters
    ----------
    executor : shares the drawing among processes that see the same file system.
    track : shows progress, image by image.

    Raises
    ------
    OutputError : something cannot be written.
    """
    options = options or FourSeasonsTwinOptions()
    drives = options.drives()
    driven = {drive.name: drive_frames(options.world(), drive) for drive in drives}
    keyframes = {name: [f for f in frames if f.keyframe] for name, frames in driven.items()}
    for name, text in calibration_texts(stereo_camera(options.width, options.height)).items():
        _write_text(root / "calibration" / name, text)
    for drive in drives:
        _write_recording(root, options, drive, driven[drive.name], executor, track)
        if drive.role == "query":
            _write_text(
                root / f"relocalizationFile_{REFERENCE}_to_{drive.name}.txt",
                relocalization_text(keyframes[REFERENCE], keyframes[drive.name]),
            )
    truth = root / GROUND_TRUTH
    write_sensors(truth / "mapping", _true_poses(keyframes[REFERENCE]))
    asked = [frame for name in (WINTER, DUSK) for frame in keyframes[name]]
    write_sensors(truth / "query", _true_poses(asked))
    return {
        "places": options.num_places,
        "mapping images": len(CAMERAS) * len(keyframes[REFERENCE]),
        "query images": len(CAMERAS) * len(asked),
    }


def _write_recording(
    root: Path,
    options: FourSeasonsTwinOptions,
    drive: Drive,
    frames: list[Frame],
    executor: Executor | None,
    track: Track,
) -> None:
    folder, exposure_ms = root / drive.name, _EXPOSURE_MS[drive.name]
    published = drive.name != DUSK  # the poses of a challenge's test recording are withheld
    keyframes = [frame for frame in frames if frame.keyframe]
    # the odometry sees depth by stereo and by motion
    seeing = [shot for frame in keyframes for shot in frame.shots] if published else []
    drawn = draw_shots(
        painting_options(options.world(), drive.season),
        [shot for frame in frames for shot in frame.shots],
        partial(_write_files, root),
        with_depth=[shot.name for shot in seeing],
        build=season_builder(drive.season),
        executor=executor,
        track=track,
    )
    _write_text(folder / "times.txt", times_text(frames, exposure_ms))
    if not published:
        return
    slam = SlamFrames.drawn(options.seed, drive.name, blank_lines=drive.name == REFERENCE)
    _write_text(folder / "GNSSPoses.txt", gnss_poses_text(slam, keyframes))
    _write_text(folder / "Transformations.txt", transformations_text(slam))
    _write_text(folder / "result.txt", result_text(slam, frames))
    _write_text(folder / "septentrio.nmea", nmea_text(keyframes))
    images = {name: result for name, result in drawn.items() if result is not None}
    tracks = exact_tracks(
        seeing,
        {name: depth for name, (_, depth) in images.items()},
        points_per_shot=options.cloud_points,
        rng=stream(options.seed, "cloud", drive.name),
    )
    for index, frame in enumerate(keyframes):
        left = frame.shots[0]
        points = cloud_of(tracks, len(CAMERAS) * index, left.cam_from_world)
        text = keyframe_text(slam, frame, left.camera, points, images[left.name][0], exposure_ms)
        _write_text(folder / "KeyFrameData" / f"KeyFrame_{frame.timestamp}.txt", text)


def _write_files(root: Path, shot: Shot, view: View) -> Drawn:
    """Write the image, grey as the camera's; returned where it has depth, with that."""
    grey = ((view.image @ _GREY + 500) // 1000).astype(np.uint8)
    write_image(root / shot.name, grey)
    return None if view.depth_m is None else (grey, view.depth_m)


def _true_poses(frames: list[Frame]) -> KaptureData:
    """The frames' images with their poses in ECEF, each camera's its own."""
    data = KaptureData()
    world_from_earth = EARTH_FROM_WORLD.inverse()
    cams_from_cam0 = (RigidTransform.identity(), CAM1_FROM_CAM0)
    for frame in frames:
        for shot, cam_from_cam0 in zip(frame.shots, cams_from_cam0, strict=True):
            record = (frame.timestamp, shot.sensor_id)
            data.sensors[shot.sensor_id] = Sensor.from_camera(shot.camera, name=shot.sensor_id)
            data.records_camera[record] = shot.name
            data.trajectories[record] = cam_from_cam0 @ frame.cam0_from_world @ world_from_earth
    return data


def _write_text(path: Path, text: str) -> None:
    write_bytes(path, text.encode())
