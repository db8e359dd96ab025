"""A car with a stereo camera drives through the places, in three seasons."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.values import Camera, RigidTransform
from megloc_twins.frames import Frame, looking_at, noise_seed
from megloc_twins.lighting import Lighting, day_lighting, night_lighting
from megloc_twins.moving_objects import place_moving_objects
from megloc_twins.options import SyntheticWorldOptions, stream
from megloc_twins.squares import Place, build_place

CAMERAS = ("cam0", "cam1")

# of the published recordings: pixels of an image 800 wide and 400 high, metres
_FOCAL_PX, _CENTRE_PX = 501.4757919305817, (421.7953735163109, 167.65799492501083)
_PUBLISHED_SIZE = (800, 400)
CAM1_FROM_CAM0 = RigidTransform((1.0, 0.0, 0.0, 0.0), (-0.3004961618953472, 0.0, 0.0))

_CAMERA_HEIGHT_M = 1.6
_LOOK_AHEAD_M = 2.0  # the car turns into a corner before it
_STEP_M = 0.17  # between frames that follow one another
_FRAME_NS = 33_333_337
FRAMES_PER_KEYFRAME = 3  # the keyframe, and those that follow it
_MARGIN_M = 0.35

Season = Literal["summer", "winter", "dusk"]

_SUN = {"summer": (45.0, 60.0), "winter": (20.0, 30.0), "dusk": (0.0, 5.0)}  # elevation, degrees
_DUSK_SKY = (0.014, 0.03)
_DUSK_EXPOSURE = 0.65


@dataclass(frozen=True)
class Moment:
    """The car at one moment.

    Parameters
    ----------
    timestamp : nanoseconds.
    cam0_from_world : of its left camera.
    place : index of the place it is in.
    keyframe : whether the odometry made it a keyframe.
    frames : what its cameras took; none where the images were not kept.
    """

    timestamp: int
    cam0_from_world: RigidTransform
    place: int
    keyframe: bool
    frames: tuple[Frame, ...]


@dataclass(frozen=True)
class Drive:
    """A recording as it is driven: where, when, and how it looks.

    Parameters
    ----------
    name : of the recording.
    season : light, and what lies on the ground.
    start_ns : time of its first frame.
    keyframes_per_place : at equal distances along a place's path.
    role : of its images.
    lateral_m, turn_deg : deviations from the path and its direction, up to these.
    extra_every : every so many keyframes the images of the frame that follows are kept too.
    """

    name: str
    season: Season
    start_ns: int
    keyframes_per_place: int
    role: Literal["mapping", "query"]
    lateral_m: float
    turn_deg: float
    extra_every: int = 8


def stereo_camera(width: int, height: int) -> Camera:
    """Either camera of the car, PINHOLE."""
    sx, sy = width / _PUBLISHED_SIZE[0], height / _PUBLISHED_SIZE[1]
    params = (_FOCAL_PX * sx, _FOCAL_PX * sx, _CENTRE_PX[0] * sx, _CENTRE_PX[1] * sy)
    return Camera("PINHOLE", width, height, params)


def image_name(recording: str, timestamp: int, camera: str) -> str:
    """Name of an image below the dataset's root."""
    return f"{recording}/undistorted_images/{camera}/{timestamp}.png"


def drive_moments(options: SyntheticWorldOptions, drive: Drive) -> list[Moment]:
    """The frames of a drive through all places, in order of time."""
    rng = stream(options.seed, "drive", drive.name)
    moments = []
    clock = drive.start_ns
    for index in range(options.num_places):
        place = build_place(options, index)
        sun = float(rng.uniform(-np.pi, np.pi)), float(np.radians(rng.uniform(*_SUN[drive.season])))
        path = _Path(place.plan.path)
        phase = rng.uniform(0.25, 0.75) if drive.role == "query" else 0.5
        for stop in range(drive.keyframes_per_place):
            along = (stop + phase) / drive.keyframes_per_place * path.length
            lateral = _free_offset(place, path, along, drive.lateral_m, rng)
            turn = float(np.radians(rng.uniform(-drive.turn_deg, drive.turn_deg)))
            pitch, roll = (float(a) for a in rng.normal(0, 0.012, 2))
            for step in range(FRAMES_PER_KEYFRAME):
                keyframe = step == 0
                clock += _FRAME_NS + int(rng.integers(-40_000, 40_000))
                # the published times have been floats of seconds
                timestamp = int(clock / 1e9 * 1e9)
                spot, heading = path.at(along + step * _STEP_M)
                left = np.array([-np.sin(heading), np.cos(heading)])
                position = np.array([*spot + lateral * left, _CAMERA_HEIGHT_M])
                cam_from_place = looking_at(position, heading + turn, pitch, roll)
                cam0_from_world = cam_from_place @ place.place_from_world
                frames: tuple[Frame, ...] = ()
                if keyframe or (step == 1 and stop % drive.extra_every == 1):
                    frames = _frames(
                        options, drive, place, timestamp, cam0_from_world, position, sun, rng
                    )
                moments.append(Moment(timestamp, cam0_from_world, index, keyframe, frames))
        clock += 20_000_000_000  # the way to the next place was not recorded
    return moments


@dataclass(frozen=True)
class SeasonBuilder:
    """Lays out places as they look in a season, for :func:`render.render_frames`.

    In winter the ground has other leaves, patches and markings, on wet asphalt.
    """

    season: Season

    def __call__(self, options: SyntheticWorldOptions, index: int) -> Place:
        place = build_place(options, index)
        if self.season != "winter":
            return place
        recipes = list(place.recipes)
        for number, recipe in enumerate(recipes):
            if recipe.painter == "ground":
                seed = int(stream(options.seed, "winter", index).integers(2**31))
                params = dict(recipe.params) | {"material": "asphalt"}
                recipes[number] = replace(recipe, seed=seed, params=tuple(sorted(params.items())))
        return replace(place, recipes=tuple(recipes))

    def sky_seed(self, options: SyntheticWorldOptions) -> int:
        """Seed of clouds and of the dirt on the bonnet: another each season.

        With the same dirt in map and queries the bonnet would be the best match of all.
        """
        return options.seed + (get_args(Season).index(self.season) << 32)


def _lighting(
    season: Season, rng: np.random.Generator, sun: tuple[float, float], seed: int
) -> Lighting:
    if season == "dusk":
        night = night_lighting(rng, exposure=_DUSK_EXPOSURE, noise_seed=seed)
        # lamps are on, and the sky still gives a little light
        light = float(rng.uniform(*_DUSK_SKY))
        sky = (0.85 * light, 0.95 * light, 1.25 * light)
        return replace(night, sky=sky, sky_colour=sky)
    overcast = 0.15 if season == "summer" else float(rng.choice([0.3, 0.7, 1.0]))
    return day_lighting(rng, azimuth=sun[0], elevation=sun[1], overcast=overcast, noise_seed=seed)


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
    moving_objects = place_moving_objects(
        place.plan, rng, options.moving_objects, position, yaw=None
    )
    lighting = _lighting(drive.season, rng, sun, 0)
    camera = stereo_camera(options.width, options.height)
    poses = (cam0_from_world, CAM1_FROM_CAM0 @ cam0_from_world)
    names = [image_name(drive.name, timestamp, name) for name in CAMERAS]
    return tuple(
        Frame(
            name=image,
            role=drive.role,
            condition=drive.name,
            place=place.index,
            timestamp=timestamp,
            sensor_id=name,
            camera=camera,
            cam_from_world=pose,
            lighting=replace(lighting, noise_seed=noise_seed(options, image)),
            moving_objects=moving_objects,
            bonnet=options.bonnet,
        )
        for name, image, pose in zip(CAMERAS, names, poses, strict=True)
    )


def _free_offset(
    place: Place, path: _Path, along: float, most: float, rng: np.random.Generator
) -> float:
    """A deviation to the left of the path, metres, that leads into nothing."""
    for _ in range(50):
        offset = float(rng.uniform(-most, most))
        if all(place.plan.is_free(x, y, _MARGIN_M) for x, y in _track(path, along, offset)):
            return offset
    return 0.0


def _track(path: _Path, along: float, offset: float) -> Iterable[tuple[float, float]]:
    for step in range(FRAMES_PER_KEYFRAME):
        spot, heading = path.at(along + step * _STEP_M)
        x, y = spot + offset * np.array([-np.sin(heading), np.cos(heading)])
        yield float(x), float(y)


class _Path:
    """A closed path on the ground by distance along it, metres."""

    def __init__(self, corners: NDArray[np.float64]) -> None:
        self._corners = corners
        self._legs = np.roll(corners, -1, axis=0) - corners
        self._ends = np.cumsum(np.hypot(*self._legs.T))

    @property
    def length(self) -> float:
        return float(self._ends[-1])

    def at(self, along: float) -> tuple[NDArray[np.float64], float]:
        """Position (2,) and direction (radians) of a car there, which looks ahead."""
        ahead = self._spot(along + _LOOK_AHEAD_M) - self._spot(along - 0.5)
        return self._spot(along), float(np.arctan2(ahead[1], ahead[0]))

    def _spot(self, along: float) -> NDArray[np.float64]:
        along = along % self.length
        leg = int(np.searchsorted(self._ends, along))
        part = 1 - (self._ends[leg] - along) / np.hypot(*self._legs[leg])
        return np.asarray(self._corners[leg] + part * self._legs[leg])
