"""Drives of a car with a stereo camera through the places, in three seasons."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.values import Camera, RigidTransform
from megloc_twins.frames import (
    Frame,
    Lighting,
    Role,
    day_lighting,
    looking_at,
    night_lighting,
    noise_seed,
)
from megloc_twins.moving_objects import FloorPlan, place_moving_objects
from megloc_twins.options import SyntheticWorldOptions, seed_of, stream
from megloc_twins.squares import Place, build_place

# calibration of the published recordings: pixels for images of 800x400, and metres
_FOCAL_PX, _CENTRE_PX = 501.4757919305817, (421.7953735163109, 167.65799492501083)
_PUBLISHED_SIZE = (800, 400)
CAM1_FROM_CAM0 = RigidTransform((1.0, 0.0, 0.0, 0.0), (-0.3004961618953472, 0.0, 0.0))

_CAMERA_HEIGHT_M = 1.6
_LOOK_AHEAD_M = 2.0  # the car begins to turn before a corner
_STEP_M = 0.17  # between consecutive frames
_FRAME_NS = 33_333_337
_FRAMES_PER_KEYFRAME = 3  # the keyframe and the frames after it
_EXTRA_EVERY = 8  # after every 8th keyframe, the next frame also has images
_MARGIN_M = 0.35

Season = Literal["summer", "winter", "dusk"]

_SUN = {"summer": (45.0, 60.0), "winter": (20.0, 30.0), "dusk": (0.0, 5.0)}  # elevation, degrees
_DUSK_SKY = (0.014, 0.03)
_DUSK_EXPOSURE = 0.65


@dataclass(frozen=True)
class Moment:
    """The car at a ``timestamp`` in nanoseconds, which may be a keyframe of the odometry.

    ``frames`` are the images of both cameras; empty if the recording has none of this moment.
    """

    timestamp: int
    cam0_from_world: RigidTransform
    keyframe: bool
    frames: tuple[Frame, ...]


@dataclass(frozen=True)
class Drive:
    """A recording: route, time and appearance."""

    name: str  # contains the time
    season: Season  # determines light and ground
    keyframes_per_place: int  # at equal distances along a place's path
    role: Role  # of its images
    lateral_m: float  # largest lateral deviation from the path
    turn_deg: float  # largest deviation from the path's direction

    @property
    def start_ns(self) -> int:
        """Return the time of the first frame."""
        moment = datetime.strptime(self.name, "recording_%Y-%m-%d_%H-%M-%S").replace(tzinfo=UTC)
        return int(moment.timestamp()) * 10**9

    def sky_seed(self, seed: int) -> int:
        """Return the seed of clouds and of dirt on the bonnet, which differs by season.

        If map and queries had the same dirt, the bonnet would yield the best matches.
        """
        return seed + (get_args(Season).index(self.season) << 32)


def stereo_camera(width: int, height: int) -> Camera:
    """Return the intrinsics of either camera, PINHOLE."""
    sx, sy = width / _PUBLISHED_SIZE[0], height / _PUBLISHED_SIZE[1]
    params = (_FOCAL_PX * sx, _FOCAL_PX * sx, _CENTRE_PX[0] * sx, _CENTRE_PX[1] * sy)
    return Camera("PINHOLE", width, height, params)


def drive_moments(options: SyntheticWorldOptions, drive: Drive) -> list[Moment]:
    """Return the moments of a drive through all places, in order of time."""
    rng = stream(options.seed, "drive", drive.name)
    moments = []
    clock = drive.start_ns
    for index in range(options.num_places):
        place = build_place(options, index)
        sun = float(rng.uniform(-np.pi, np.pi)), float(np.radians(rng.uniform(*_SUN[drive.season])))
        phase = rng.uniform(0.25, 0.75) if drive.role == "query" else 0.5
        for stop in range(drive.keyframes_per_place):
            along = (stop + phase) / drive.keyframes_per_place * place.plan.path_length_m
            lateral = _free_offset(place.plan, along, drive.lateral_m, rng)
            turn = float(np.radians(rng.uniform(-drive.turn_deg, drive.turn_deg)))
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
                    frames = _frames(options, drive, place, timestamp, pose, position, sun, rng)
                moments.append(Moment(timestamp, pose, step == 0, frames))
        clock += 20_000_000_000  # the drive to the next place is not recorded
    return moments


def winter_place(options: SyntheticWorldOptions, index: int) -> Place:
    """Return a place in winter: other leaves, patches and markings, on wet asphalt."""
    place = build_place(options, index)
    seed = seed_of(options.seed, "winter", index)
    recipes = []
    for recipe in place.recipes:
        if recipe.painter == "ground":
            params = dict(recipe.params) | {"material": "asphalt"}
            recipe = replace(recipe, seed=seed, params=tuple(params.items()))
        recipes.append(recipe)
    return replace(place, recipes=tuple(recipes))


def _lighting(season: Season, rng: np.random.Generator, sun: tuple[float, float]) -> Lighting:
    if season == "dusk":
        night = night_lighting(rng, exposure=_DUSK_EXPOSURE)
        # the lamps are on, and the sky is still slightly bright
        light = float(rng.uniform(*_DUSK_SKY))
        sky = (0.85 * light, 0.95 * light, 1.25 * light)
        return replace(night, sky=sky, sky_colour=sky)
    overcast = 0.15 if season == "summer" else float(rng.choice([0.3, 0.7, 1.0]))
    return day_lighting(rng, sun, overcast=overcast)


def _frames(
    options: SyntheticWorldOptions,
    drive: Drive,
    place: Place,
    timestamp: int,
    cam0_from_world: RigidTransform,
    position: NDArray[np.float64],
    sun: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[Frame, ...]:
    moving_objects = place_moving_objects(place.plan, rng, options.moving_objects, position)
    lighting = _lighting(drive.season, rng, sun)
    poses = {"cam0": cam0_from_world, "cam1": CAM1_FROM_CAM0 @ cam0_from_world}
    frames = []
    for sensor_id, pose in poses.items():
        name = f"{drive.name}/undistorted_images/{sensor_id}/{timestamp}.png"
        frames.append(
            Frame(
                name=name,
                role=drive.role,
                condition=drive.name,
                place=place.index,
                timestamp=timestamp,
                sensor_id=sensor_id,
                camera=stereo_camera(options.width, options.height),
                cam_from_world=pose,
                lighting=lighting,
                noise_seed=noise_seed(options.seed, name),
                moving_objects=moving_objects,
                bonnet=True,
            )
        )
    return tuple(frames)


def _free_offset(plan: FloorPlan, along: float, most: float, rng: np.random.Generator) -> float:
    """Draw a deviation to the left of the path, metres, that avoids all obstacles."""
    for _ in range(50):
        offset = float(rng.uniform(-most, most))
        steps = range(_FRAMES_PER_KEYFRAME)
        track = [_beside(plan, along + step * _STEP_M, offset)[0].tolist() for step in steps]
        if all(plan.is_free(x, y, _MARGIN_M) for x, y in track):
            return offset
    return 0.0


def _beside(plan: FloorPlan, along: float, offset: float) -> tuple[NDArray[np.float64], float]:
    """Return position (2,) and direction (radians) of a car at a distance along the path,
    ``offset`` metres to its left."""
    (ahead, behind, spot), _ = plan.on_path([along + _LOOK_AHEAD_M, along - 0.5, along])
    heading = float(np.arctan2(*(ahead - behind)[::-1]))
    return spot + offset * np.array([-np.sin(heading), np.cos(heading)]), heading
