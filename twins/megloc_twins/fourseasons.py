"""The rendered world in 4Seasons' layout: three recordings of one route, with true poses.

The map is recorded on a summer day. Queries are recorded in winter, with published poses, and at
dusk, with poses that are withheld as in a challenge. Relocalization files list the query keyframes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial, reduce
from operator import xor
from pathlib import Path

import numpy as np
from pydantic import Field

from megloc_kapture.geometry.poses import earth_from_enu, geodetic
from megloc_kapture.io.images import write_image
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Camera, RigidTransform
from megloc_twins.fourseasons_drive import (
    CAM1_FROM_CAM0,
    Drive,
    Moment,
    drive_moments,
    stereo_camera,
    winter_place,
)
from megloc_twins.frames import Frame, write_truth
from megloc_twins.options import SyntheticDataset, TwinOptions, stream, write_lines
from megloc_twins.portable import settled, settled_pose
from megloc_twins.render import RenderedFrame, render_frames
from megloc_twins.squares import build_place

REFERENCE = "recording_2020-06-18_10-12-33"
WINTER = "recording_2021-01-15_13-04-17"
DUSK = "recording_2021-03-22_18-41-05"

_EXPOSURE_MS = {REFERENCE: 0.2457180023, WINTER: 1.9, DUSK: 10.0}
_GREY = np.array([299, 587, 114])  # weights of R, G and B, thousandths

_TAGS = "translation vector, rotation quaternion"


def _settled_earth_from_enu(
    latitude_deg: float, longitude_deg: float, height_m: float
) -> RigidTransform:
    exact = earth_from_enu(latitude_deg, longitude_deg, height_m)
    # rounded to micrometres: ECEF coordinates have less than nanometre precision in float64
    return settled_pose(exact.rotation_matrix(), np.round(exact.translation, 6))


# the world's origin is near Munich, its axes are east, north and up
EARTH_FROM_WORLD = _settled_earth_from_enu(48.1861, 11.6197, 540.0)


class FourSeasonsTwinOptions(TwinOptions):
    """Contents of 4Seasons' twin."""

    num_places: int = Field(default=4, ge=1, description="places on the route")
    map_keyframes: int = Field(
        default=12, ge=3, description="keyframes of the map recording in each place"
    )
    winter_keyframes: int = Field(
        default=6, ge=1, description="keyframes of the winter recording in each place"
    )
    dusk_keyframes: int = Field(
        default=4, ge=1, description="keyframes of the dusk recording in each place"
    )
    width: int = Field(default=800, ge=64, description="image width in px")
    height: int = Field(default=400, ge=48, description="image height in px")

    def drives(self) -> tuple[Drive, Drive, Drive]:
        """Return the recordings, the map's first."""
        return (
            Drive(REFERENCE, "summer", self.map_keyframes, "mapping", 0.1, 2),
            Drive(WINTER, "winter", self.winter_keyframes, "query", 0.6, 8),
            Drive(DUSK, "dusk", self.dusk_keyframes, "query", 0.9, 12),
        )


class FourSeasonsTwin(SyntheticDataset[FourSeasonsTwinOptions]):
    """4Seasons in its published layout, with true poses.

    ``calibration/``, three recordings, relocalization files as in 2021, and the true poses (ECEF)
    in ``ground_truth/``.
    """

    Options = FourSeasonsTwinOptions
    version = 3

    def write(self, root: Path, work: Work = HERE) -> dict[str, int]:
        options, drives = self.options, self.options.drives()
        driven = {drive.name: drive_moments(options.world(), drive) for drive in drives}
        keyframes = {name: [m for m in moments if m.keyframe] for name, moments in driven.items()}
        _write_calibration(root / "calibration", stereo_camera(options.width, options.height))
        for drive in drives:
            _write_recording(root, options, drive, driven[drive.name], work)
            if drive.role == "query":
                write_lines(
                    root / f"relocalizationFile_{REFERENCE}_to_{drive.name}.txt",
                    _relocalization_lines(keyframes[REFERENCE], keyframes[drive.name]),
                )
        asked = [*keyframes[WINTER], *keyframes[DUSK]]
        write_truth(root, _on_earth(keyframes[REFERENCE]), _on_earth(asked))
        return {
            "places": options.num_places,
            "mapping images": 2 * len(keyframes[REFERENCE]),
            "query images": 2 * len(asked),
        }


def _write_recording(
    root: Path, options: FourSeasonsTwinOptions, drive: Drive, moments: list[Moment], work: Work
) -> None:
    folder, exposure_ms = root / drive.name, _EXPOSURE_MS[drive.name]
    published = drive.name != DUSK  # poses of test recordings are withheld
    keyframes = [moment for moment in moments if moment.keyframe]
    render_frames(
        options.world(),
        [frame for moment in moments for frame in moment.frames],
        partial(_write_grey, root),
        build=winter_place if drive.season == "winter" else build_place,
        sky_seed=drive.sky_seed(options.seed),
        work=work,
    )
    times = (moment.timestamp for moment in moments)  # most have no images
    rows = [f"{time} {time / 1e9:.10f} {exposure_ms:.10f}" for time in times]
    write_lines(folder / "times.txt", rows)
    if not published:
        return
    slam = SlamFrames.drawn(options.seed, drive.name)
    write_lines(folder / "GNSSPoses.txt", _gnss_lines(slam, keyframes))
    blank_lines = drive.name == REFERENCE
    write_lines(folder / "Transformations.txt", _transformation_lines(slam, blank_lines))
    write_lines(folder / "septentrio.nmea", _nmea_lines(keyframes))


def _write_grey(root: Path, frame: Frame, view: RenderedFrame) -> None:
    grey = ((view.image @ _GREY + 500) // 1000).astype(np.uint8)
    write_image(root / frame.name, grey)


def _on_earth(moments: Iterable[Moment]) -> Iterator[Frame]:
    """Yield the moments' frames with each camera's pose in ECEF."""
    world_from_earth = EARTH_FROM_WORLD.inverse()
    cams_from_cam0 = (RigidTransform.identity(), CAM1_FROM_CAM0)
    for moment in moments:
        for frame, cam_from_cam0 in zip(moment.frames, cams_from_cam0, strict=True):
            pose = cam_from_cam0 @ moment.cam0_from_world @ world_from_earth
            yield replace(frame, cam_from_world=pose)


@dataclass(frozen=True)
class SlamFrames:
    """Transforms between a recording's coordinate frames, as in its files.

    Parameters
    ----------
    s_from_as, w_from_gpsw, e_from_gpsw : named as in ``Transformations.txt``.
    scale : metres per unit of the SLAM world.
    """

    s_from_as: RigidTransform
    w_from_gpsw: RigidTransform
    e_from_gpsw: RigidTransform
    scale: float

    @classmethod
    def drawn(cls, seed: int, recording: str) -> SlamFrames:
        """Draw the coordinate frames of a recording."""
        rng = stream(seed, "frames", recording)
        # the scenes of different recordings have origins some hundred metres apart
        east, north, up = rng.uniform(-300, 300, 2).tolist() + [float(rng.uniform(-5, 5))]
        origin = RigidTransform((1.0, 0.0, 0.0, 0.0), (east, north, up))
        place = geodetic(np.array((EARTH_FROM_WORLD @ origin).translation))
        return cls(
            s_from_as=_as_written(_random_transform(rng, 0.03, 3.2e-2, 0.0)),
            w_from_gpsw=_as_written(_random_transform(rng, np.pi, 2e-2, 0.4)),
            e_from_gpsw=_as_written(_settled_earth_from_enu(*place)),
            scale=round(float(rng.uniform(0.96, 0.97)), 6),
        )

    def slam_from_cam(self, cam_from_world: RigidTransform) -> RigidTransform:
        """Return a pose in the convention of ``GNSSPoses.txt``, translation in units of the SLAM
        world."""
        s_from_world = self.w_from_gpsw @ self.e_from_gpsw.inverse() @ EARTH_FROM_WORLD
        metric = self.s_from_as.inverse() @ s_from_world @ cam_from_world.inverse()
        x, y, z = (value / self.scale for value in metric.translation)
        return RigidTransform(metric.quat_wxyz, (x, y, z))


def _transformation_lines(slam: SlamFrames, blank_lines: bool) -> list[str]:
    cam_from_imu = RigidTransform(
        (-0.002350, -0.007202, 0.708623, -0.705546), (0.175412, 0.003689, -0.058106)
    )
    lines = []
    for name, transform in (
        ("transform_S_AS", slam.s_from_as),
        ("TS_cam_imu", cam_from_imu),
        ("transform_w_gpsw", slam.w_from_gpsw),
        ("transform_gps_imu", RigidTransform.identity()),
        ("transform_e_gpsw", slam.e_from_gpsw),
    ):
        lines += [f"# {name}: {_TAGS}", _pose_fields(transform, ",", 6), *[""] * blank_lines]
    return [*lines, "# GNSS scale", f"{slam.scale:.6f}"]


def _gnss_lines(slam: SlamFrames, keyframes: Iterable[Moment]) -> list[str]:
    """Format poses below a header, which has a column more than the rows, as published."""
    lines = [
        "# timestamp_ns, tran_x, tran_y, tran_z, quat_x, quat_y, quat_z, quat_w, scale, "
        "fusion_quality, v3"
    ]
    for moment in keyframes:
        pose = _pose_fields(slam.slam_from_cam(moment.cam0_from_world), ",", 12)
        lines.append(f"{moment.timestamp},{pose},{slam.scale:.6f},2")
    return lines


def _nmea_lines(keyframes: Sequence[Moment]) -> list[str]:
    """Format a GNSS fix per keyframe, after a truncated line."""
    lines = [",D*1C"]
    for moment in keyframes:
        clock = datetime.fromtimestamp(moment.timestamp // 10**9, UTC)
        hundredths = moment.timestamp // 10**7 % 100
        position = (EARTH_FROM_WORLD @ moment.cam0_from_world.inverse()).translation
        latitude, longitude, height = geodetic(np.array(position))
        time = f"{clock:%H%M%S}.{hundredths:02d}"
        place = f"{_degrees_minutes(latitude, 2)},N,{_degrees_minutes(longitude, 3)},E"
        for content in (
            f"GPRMC,{time},A,{place},7.0,251.7,{clock:%d%m%y},3.5,W,D",
            f"GPGGA,{time},{place},4,09,1.1,{height:.4f},M,0.0000,M,0.6,3119",
        ):
            checksum = reduce(xor, content.encode())
            lines.append(f"${content}*{checksum:02X}")
    return lines


def _write_calibration(folder: Path, camera: Camera) -> None:
    """Write the calibration files of undistorted images."""
    params = " ".join(map(repr, camera.params))
    size = f"{camera.width} {camera.height}"
    for number in (0, 1):
        lines = [f"Pinhole {params} 0.0 0.0 0.0 0.0", size, "crop", size]
        write_lines(folder / f"undistorted_calib_{number}.txt", lines)
    rows = [" ".join(map(repr, row)) for row in CAM1_FROM_CAM0.matrix().tolist()]
    write_lines(folder / "undistorted_calib_stereo.txt", rows)


def _relocalization_lines(reference: Sequence[Moment], queries: Sequence[Moment]) -> list[str]:
    """Format the challenge's pairs: the nearest map keyframe, then the query."""
    centers = np.array([moment.cam0_from_world.center() for moment in reference])
    lines = []
    for moment in queries:
        distances = np.linalg.norm(centers - moment.cam0_from_world.center(), axis=1)
        lines.append(f"{reference[int(distances.argmin())].timestamp} {moment.timestamp}")
    return lines


def _random_transform(
    rng: np.random.Generator, yaw: float, tilt: float, reach_m: float
) -> RigidTransform:
    """Draw a translation, and a rotation by up to ``yaw`` about z and ``tilt`` about x and y,
    radians."""
    ax, ay, az = (float(a) / 2 for a in rng.uniform(-1, 1, 3) * (tilt, tilt, yaw))
    cos_x, cos_y, cos_z = settled(np.cos((ax, ay, az))).tolist()
    sin_x, sin_y, sin_z = settled(np.sin((ax, ay, az))).tolist()
    still = (0.0, 0.0, 0.0)
    about_z = RigidTransform((cos_z, 0.0, 0.0, sin_z), still)
    about_y = RigidTransform((cos_y, 0.0, sin_y, 0.0), still)
    about_x = RigidTransform((cos_x, sin_x, 0.0, 0.0), still)
    x, y, z = (float(v) for v in rng.uniform(-1, 1, 3) * reach_m)
    shift = RigidTransform((1.0, 0.0, 0.0, 0.0), (x, y, z))
    return shift @ about_z @ about_y @ about_x


def _as_written(transform: RigidTransform) -> RigidTransform:
    """Round a transform to six decimals."""
    quat = np.round(transform.quat_wxyz, 6)
    w, x, y, z = (quat / np.sqrt((quat * quat).sum())).tolist()
    tx, ty, tz = np.round(transform.translation, 6).tolist()
    return RigidTransform((w, x, y, z), (tx, ty, tz))


def _pose_fields(pose: RigidTransform, separator: str, decimals: int) -> str:
    """Format translation, then rotation x y z w."""
    w, x, y, z = pose.quat_wxyz
    return separator.join(f"{value:.{decimals}f}" for value in (*pose.translation, x, y, z, w))


def _degrees_minutes(angle_deg: float, digits: int) -> str:
    degrees = int(angle_deg)
    return f"{degrees:0{digits}d}{(angle_deg - degrees) * 60:010.7f}"
