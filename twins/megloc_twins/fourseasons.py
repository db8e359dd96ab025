"""The rendered world in 4Seasons' layout: three recordings of one route, with true poses.

The map is recorded on a summer day. Queries are recorded in winter, with published poses, and at
dusk, with poses that are withheld as in a challenge. Relocalization files list the query keyframes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from numpy.random import Generator
from pydantic import Field

from megloc_kapture.geometry.poses import earth_from_enu, geodetic
from megloc_kapture.io.images import write_image
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Camera, RigidTransform
from megloc_twins.frames import Frame, day_lighting, dusk_lighting, in_frame, write_truth
from megloc_twins.moving_objects import FloorPlan, place_moving_objects
from megloc_twins.options import (
    SyntheticDataset,
    SyntheticWorldOptions,
    TwinOptions,
    seed_of,
    stream,
    write_lines,
)
from megloc_twins.portable import Float64, looking_at, settled, settled_pose
from megloc_twins.render import RenderedFrame, render_frames
from megloc_twins.squares import Place, build_place

REFERENCE = "recording_2020-06-18_10-12-33"
WINTER = "recording_2021-01-15_13-04-17"
DUSK = "recording_2021-03-22_18-41-05"

# calibration of the published recordings: pixels for images of 800x400, and metres
_FOCAL_PX, _CENTRE_PX = 501.4757919305817, (421.7953735163109, 167.65799492501083)
_PUBLISHED_SIZE = (800, 400)
CAM1_FROM_CAM0 = RigidTransform((1.0, 0.0, 0.0, 0.0), (-0.3004961618953472, 0.0, 0.0))
_CAM_FROM_IMU = RigidTransform(
    (-0.002350, -0.007202, 0.708623, -0.705546), (0.175412, 0.003689, -0.058106)
)

_CAMERA_HEIGHT_M = 1.6
_LOOK_AHEAD_M = 2.0  # the car begins to turn before a corner
_STEP_M = 0.17  # between consecutive frames
_FRAME_NS = 33_333_337
_FRAMES_PER_KEYFRAME = 3  # the keyframe and the frames after it
_EXTRA_EVERY = 8  # after every 8th keyframe, the next frame also has images
_MARGIN_M = 0.35

_SUN = {REFERENCE: (45.0, 60.0), WINTER: (20.0, 30.0), DUSK: (0.0, 5.0)}  # elevation, degrees
# largest lateral deviation from the path, metres, and from its direction, degrees
_DEVIATION = {REFERENCE: (0.1, 2.0), WINTER: (0.6, 8.0), DUSK: (0.9, 12.0)}

_EXPOSURE_MS = {REFERENCE: 0.2457180023, WINTER: 1.9, DUSK: 10.0}
_GREY = np.array([299, 587, 114])  # weights of R, G and B, thousandths


def _settled_earth_from_enu(lat_deg: float, lon_deg: float, height_m: float) -> RigidTransform:
    exact = earth_from_enu(lat_deg, lon_deg, height_m)
    # rounded to micrometres: ECEF coordinates have less than nanometre precision in float64
    return settled_pose(exact.rotation_matrix(), np.round(exact.translation, 6))


# the world's origin is near Munich, its axes are east, north and up
EARTH_FROM_WORLD = _settled_earth_from_enu(48.1861, 11.6197, 540.0)


@dataclass(frozen=True)
class Moment:
    timestamp: int  # nanoseconds
    cam0_from_world: RigidTransform
    keyframe: bool  # of the odometry
    frames: tuple[Frame, ...]  # of both cameras; most moments have none


def stereo_camera(width: int, height: int) -> Camera:
    sx, sy = width / _PUBLISHED_SIZE[0], height / _PUBLISHED_SIZE[1]
    params = (_FOCAL_PX * sx, _FOCAL_PX * sx, _CENTRE_PX[0] * sx, _CENTRE_PX[1] * sy)
    return Camera("PINHOLE", width, height, params)


class FourSeasonsTwinOptions(TwinOptions):
    """Contents of 4Seasons' twin."""

    num_places: int = Field(default=4, ge=1, description="places on the route")
    map_keyframes: int = Field(default=12, ge=3, description="map keyframes per place")
    winter_keyframes: int = Field(default=6, ge=1, description="winter keyframes per place")
    dusk_keyframes: int = Field(default=4, ge=1, description="dusk keyframes per place")
    width: int = Field(default=800, ge=64, description="image width in px")
    height: int = Field(default=400, ge=48, description="image height in px")


class FourSeasonsTwin(SyntheticDataset[FourSeasonsTwinOptions]):
    """4Seasons in its published layout, with true poses.

    ``calibration/``, three recordings, relocalization files as in 2021, and the true poses (ECEF)
    in ``ground_truth/``.
    """

    Options = FourSeasonsTwinOptions
    version = 4

    def write(self, root: Path, work: Work = HERE) -> dict[str, int]:
        options, world = self.options, self.options.world()
        driven = {
            REFERENCE: list(drive_moments(world, REFERENCE, options.map_keyframes)),
            WINTER: list(drive_moments(world, WINTER, options.winter_keyframes)),
            DUSK: list(drive_moments(world, DUSK, options.dusk_keyframes)),
        }
        keyframes = {name: [m for m in moments if m.keyframe] for name, moments in driven.items()}
        _write_calibration(root / "calibration", stereo_camera(options.width, options.height))
        for recording, moments in driven.items():
            _write_recording(root / recording, world, moments, work)
            if recording != REFERENCE:
                path = root / f"relocalizationFile_{REFERENCE}_to_{recording}.txt"
                _write_relocalization(path, keyframes[REFERENCE], keyframes[recording])
        truth = (
            in_frame([frame for moment in moments for frame in moment.frames], EARTH_FROM_WORLD)
            for moments in (keyframes[REFERENCE], keyframes[WINTER] + keyframes[DUSK])
        )
        return {"places": options.num_places} | write_truth(root, *truth)


def drive_moments(options: SyntheticWorldOptions, recording: str, stops: int) -> Iterator[Moment]:
    """Yield the moments of a drive through all places, in order of time."""
    rng = stream(options.seed, "drive", recording)
    most_m, most_deg = _DEVIATION[recording]
    start = datetime.strptime(recording, "recording_%Y-%m-%d_%H-%M-%S").replace(tzinfo=UTC)
    clock = int(start.timestamp()) * 10**9
    for index in range(options.num_places):
        place = build_place(options, index)
        sun = float(rng.uniform(-np.pi, np.pi)), float(np.radians(rng.uniform(*_SUN[recording])))
        phase = 0.5 if recording == REFERENCE else rng.uniform(0.25, 0.75)
        for stop in range(stops):
            along = (stop + phase) / stops * place.plan.path_length_m
            lateral = _free_offset(place.plan, along, most_m, rng)
            turn = float(np.radians(rng.uniform(-most_deg, most_deg)))
            pitch, roll = (float(a) for a in rng.normal(0, 0.012, 2))
            for step in range(_FRAMES_PER_KEYFRAME):
                clock += _FRAME_NS + int(rng.integers(-40_000, 40_000))
                # published timestamps were rounded by a conversion to float seconds
                timestamp = int(clock / 1e9 * 1e9)
                spot, heading = _beside(place.plan, along + step * _STEP_M, lateral)
                position = np.array([*spot, _CAMERA_HEIGHT_M])
                cam_from_place = looking_at(position, heading + turn, pitch, roll)
                pose = cam_from_place @ place.place_from_world
                frames: tuple[Frame, ...] = ()
                if step == 0 or (step == 1 and stop % _EXTRA_EVERY == 1):
                    images = _frames(options, recording, place, timestamp, pose, position, sun, rng)
                    frames = tuple(images)
                yield Moment(timestamp, pose, step == 0, frames)
        clock += 20_000_000_000  # the drive to the next place is not recorded


def winter_place(options: SyntheticWorldOptions, index: int) -> Place:
    """Return a place in winter: different leaves, patches and markings, on asphalt."""
    place = build_place(options, index)
    seed = seed_of(options.seed, "winter", index)
    recipes = []
    for recipe in place.recipes:
        if recipe.painter == "ground":
            params = dict(recipe.params) | {"material": "asphalt"}
            recipe = replace(recipe, seed=seed, params=tuple(params.items()))
        recipes.append(recipe)
    return replace(place, recipes=tuple(recipes))


def _frames(
    options: SyntheticWorldOptions,
    recording: str,
    place: Place,
    timestamp: int,
    cam0_from_world: RigidTransform,
    position: Float64,
    sun: tuple[float, float],
    rng: Generator,
) -> Iterator[Frame]:
    moving_objects = place_moving_objects(place.plan, rng, options.moving_objects, position)
    if recording == DUSK:
        lighting = dusk_lighting(rng)
    else:
        overcast = 0.15 if recording == REFERENCE else float(rng.choice([0.3, 0.7, 1.0]))
        lighting = day_lighting(rng, sun, overcast=overcast)
    poses = {"cam0": cam0_from_world, "cam1": CAM1_FROM_CAM0 @ cam0_from_world}
    for sensor_id, pose in poses.items():
        name = f"{recording}/undistorted_images/{sensor_id}/{timestamp}.png"
        yield Frame(
            name=name,
            condition=recording,
            place=place.index,
            timestamp=timestamp,
            sensor_id=sensor_id,
            camera=stereo_camera(options.width, options.height),
            cam_from_world=pose,
            lighting=lighting,
            noise_seed=options.noise_seed(name),
            moving_objects=moving_objects,
            bonnet=True,
        )


def _free_offset(plan: FloorPlan, along: float, most: float, rng: Generator) -> float:
    """Draw a deviation to the left of the path, metres, that avoids all obstacles."""
    for _ in range(50):
        offset = float(rng.uniform(-most, most))
        steps = range(_FRAMES_PER_KEYFRAME)
        track = [_beside(plan, along + step * _STEP_M, offset)[0].tolist() for step in steps]
        if all(plan.is_free(x, y, _MARGIN_M) for x, y in track):
            return offset
    return 0.0


def _beside(plan: FloorPlan, along: float, offset: float) -> tuple[Float64, float]:
    """Return position (2,) and direction (radians) of a car ``offset`` metres left of the path."""
    (ahead, behind, spot), _ = plan.on_path([along + _LOOK_AHEAD_M, along - 0.5, along])
    heading = float(np.arctan2(*(ahead - behind)[::-1]))
    return spot + offset * np.array([-np.sin(heading), np.cos(heading)]), heading


def _write_recording(
    folder: Path, options: SyntheticWorldOptions, moments: list[Moment], work: Work
) -> None:
    recording, exposure_ms = folder.name, _EXPOSURE_MS[folder.name]
    frames = [frame for moment in moments for frame in moment.frames]
    finish = partial(_write_grey, folder.parent)
    build = winter_place if recording == WINTER else build_place
    # with the same dirt as in the map, the bonnet would yield the queries' best matches
    seed = options.seed + (list(_SUN).index(recording) << 32)
    render_frames(options, frames, finish, build=build, sky_seed=seed, work=work)
    times = (moment.timestamp for moment in moments)  # most have no images
    rows = [f"{time} {time / 1e9:.10f} {exposure_ms:.10f}" for time in times]
    write_lines(folder / "times.txt", rows)
    if recording != DUSK:  # poses of test recordings are withheld
        _write_slam_world(folder, options.seed, [m for m in moments if m.keyframe])


def _write_grey(root: Path, frame: Frame, view: RenderedFrame) -> None:
    grey = ((view.image @ _GREY + 500) // 1000).astype(np.uint8)
    write_image(root / frame.name, grey)


def _write_slam_world(folder: Path, seed: int, keyframes: list[Moment]) -> None:
    """Write the keyframes' poses in a recording's SLAM world, and its transform to ECEF.

    Frames are named as in ``Transformations.txt``.
    """
    rng = stream(seed, "frames", folder.name)
    # the scenes of different recordings have origins a few hundred metres apart
    east, north, up = rng.uniform(-300, 300, 2).tolist() + [float(rng.uniform(-5, 5))]
    origin = RigidTransform((1.0, 0.0, 0.0, 0.0), (east, north, up))
    place = geodetic(np.array((EARTH_FROM_WORLD @ origin).translation))
    s_from_as = _as_written(_random_transform(rng, 0.03, 3.2e-2, 0.0))
    w_from_gpsw = _as_written(_random_transform(rng, np.pi, 2e-2, 0.4))
    e_from_gpsw = _as_written(_settled_earth_from_enu(*place))
    scale = round(float(rng.uniform(0.96, 0.97)), 6)  # metres per unit of the SLAM world
    as_from_world = s_from_as.inverse() @ (w_from_gpsw @ e_from_gpsw.inverse() @ EARTH_FROM_WORLD)
    # the header has one more column than the rows, as published
    columns = "tran_x, tran_y, tran_z, quat_x, quat_y, quat_z, quat_w, scale, fusion_quality, v3"
    lines = [f"# timestamp_ns, {columns}"]
    for moment in keyframes:
        metric = as_from_world @ moment.cam0_from_world.inverse()
        x, y, z = (value / scale for value in metric.translation)
        pose = _pose_fields(RigidTransform(metric.quat_wxyz, (x, y, z)), 12)
        lines.append(f"{moment.timestamp},{pose},{scale:.6f},2")
    write_lines(folder / "GNSSPoses.txt", lines)
    lines = []
    for name, transform in (
        ("transform_S_AS", s_from_as),
        ("TS_cam_imu", _CAM_FROM_IMU),
        ("transform_w_gpsw", w_from_gpsw),
        ("transform_gps_imu", RigidTransform.identity()),
        ("transform_e_gpsw", e_from_gpsw),
    ):
        lines += [f"# {name}: translation vector, rotation quaternion", _pose_fields(transform, 6)]
        lines += [""] * (folder.name == REFERENCE)
    write_lines(folder / "Transformations.txt", [*lines, "# GNSS scale", f"{scale:.6f}"])


def _write_calibration(folder: Path, camera: Camera) -> None:
    params = " ".join(map(repr, camera.params))
    size = f"{camera.width} {camera.height}"
    for number in (0, 1):
        lines = [f"Pinhole {params} 0.0 0.0 0.0 0.0", size, "crop", size]
        write_lines(folder / f"undistorted_calib_{number}.txt", lines)
    rows = [" ".join(map(repr, row)) for row in CAM1_FROM_CAM0.matrix().tolist()]
    write_lines(folder / "undistorted_calib_stereo.txt", rows)


def _write_relocalization(path: Path, reference: list[Moment], queries: list[Moment]) -> None:
    """Write the challenge's pairs: the nearest map keyframe, then the query."""
    centers = np.array([moment.cam0_from_world.center() for moment in reference])
    lines = []
    for moment in queries:
        distances = np.linalg.norm(centers - moment.cam0_from_world.center(), axis=1)
        lines.append(f"{reference[int(distances.argmin())].timestamp} {moment.timestamp}")
    write_lines(path, lines)


def _random_transform(rng: Generator, yaw: float, tilt: float, reach_m: float) -> RigidTransform:
    """Draw a translation, and a rotation by at most ``yaw`` about z and ``tilt`` about x and y."""
    half = rng.uniform(-1, 1, 3) * (tilt, tilt, yaw) / 2
    cos, sin = settled(np.cos(half)).tolist(), np.diag(settled(np.sin(half))).tolist()
    about_x, about_y, about_z = (
        RigidTransform((w, x, y, z), (0.0, 0.0, 0.0)) for w, (x, y, z) in zip(cos, sin, strict=True)
    )
    x, y, z = (float(v) for v in rng.uniform(-1, 1, 3) * reach_m)
    shift = RigidTransform((1.0, 0.0, 0.0, 0.0), (x, y, z))
    return shift @ about_z @ about_y @ about_x


def _as_written(transform: RigidTransform) -> RigidTransform:
    quat = np.round(transform.quat_wxyz, 6)
    w, x, y, z = (quat / np.sqrt((quat * quat).sum())).tolist()
    tx, ty, tz = np.round(transform.translation, 6).tolist()
    return RigidTransform((w, x, y, z), (tx, ty, tz))


def _pose_fields(pose: RigidTransform, decimals: int) -> str:
    """Format translation, then rotation x y z w."""
    w, x, y, z = pose.quat_wxyz
    return ",".join(f"{value:.{decimals}f}" for value in (*pose.translation, x, y, z, w))
