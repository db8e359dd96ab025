"""What Aachen Day-Night's twin shows: photographs of many people, sequences, telephone queries.

Nothing is drawn here. The shots' names are those of the official layout, their poses in the
frame of the synthetic world; :func:`official` gives them in the one the twin publishes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from megloc_kapture.datasets.synthetic.cameras import looking_at
from megloc_kapture.datasets.synthetic.looks import Condition, day_look
from megloc_kapture.datasets.synthetic.movers import place_movers
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions, stream
from megloc_kapture.datasets.synthetic.places import Place, build_place
from megloc_kapture.datasets.synthetic.portable import settled_pose
from megloc_kapture.datasets.synthetic.query_shots import query_shots
from megloc_kapture.datasets.synthetic.shots import Shot, noise_seed
from megloc_kapture.values import Camera, Options

# the published model lies some hundred metres from its origin, with y down
OFFICIAL_FROM_WORLD = settled_pose(
    np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), np.array([738.5, -6.25, -41.75])
)
NUM_UNLISTED = 2  # query images on disk that no list names
_PORTRAIT_SHARE = 1 / 6
_YAWS_DEG = (0.0, 62.0, -62.0)  # photographs taken from about the same spot
_DEVICES = ("nexus4", "milestone", "nexus4", "milestone", "nexus5x")
_WRONG_IMAGE = 1228  # db/1228.jpg has a wrong pose in the published model; ours have none


class AachenTwinOptions(Options):
    """What Aachen's twin contains; the defaults are what ``make eval`` localizes in."""

    seed: int = Field(default=0, ge=0, description="every random choice hangs on it")
    version: Literal["1.0", "1.1"] = Field(
        default="1.1",
        description="1.1 adds sequences, a COLMAP model and more night queries to 1.0",
    )
    num_places: int = Field(default=4, ge=1, description="places, at least 60 m apart")
    stations_per_place: int = Field(
        default=8, ge=3, description="spots in each place where three photographs are taken"
    )
    sequence_images: int = Field(
        default=5, ge=2, description="images of the sequence through each place (v1.1)"
    )
    day_queries: int = Field(default=24, ge=1, description="query images by day, all places")
    night_queries: int = Field(default=16, ge=1, description="query images at night, all places")
    additional_night_queries: int = Field(
        default=8, ge=1, description="more query images at night (v1.1)"
    )
    width: int = Field(default=640, ge=64, description="image width in px; a portrait's height")
    height: int = Field(default=480, ge=48, description="image height in px")
    supersampling: int = Field(default=2, ge=1, le=4, description="samples per px and axis")
    points_per_image: int = Field(
        default=100, ge=1, description="points of the sparse models that are drawn in each image"
    )
    night_exposure: float = Field(
        default=1.0, gt=0, description="light that reaches the sensor at night, relative"
    )
    jpeg_quality: int = Field(default=92, ge=1, le=100, description="quality of JPEG images")
    model_features: bool = Field(
        default=False,
        description="sparse models of SIFT of the images, not of exact points, with their database",
    )

    @field_validator("version", mode="before")
    @classmethod
    def _as_text(cls, version: Any) -> Any:
        # on the command line and in TOML 1.1 is a number
        return str(version) if isinstance(version, float) else version

    def world(self) -> SyntheticWorldOptions:
        """The rendered world this is a photograph album of."""
        return SyntheticWorldOptions(
            seed=self.seed,
            num_places=self.num_places,
            width=self.width,
            height=self.height,
            supersampling=self.supersampling,
            night_exposure=self.night_exposure,
            jpeg_quality=self.jpeg_quality,
        )


@dataclass(frozen=True, eq=False)
class AachenShots:
    """All images of the twin; poses in the world's frame.

    Parameters
    ----------
    database : map images with a camera each, in the order of the NVM.
    sequences : map images of v1.1, those of a sequence with the same ``sensor_id`` and camera.
    day, night, additional_night : queries in the order of the lists.
    unlisted : images below ``query/`` that are in no list.
    """

    database: tuple[Shot, ...]
    sequences: tuple[Shot, ...]
    day: tuple[Shot, ...]
    night: tuple[Shot, ...]
    additional_night: tuple[Shot, ...]
    unlisted: tuple[Shot, ...]

    def mapping(self) -> tuple[Shot, ...]:
        """All map images."""
        return self.database + self.sequences

    def queries(self) -> tuple[Shot, ...]:
        """All queries that are in a list."""
        return self.day + self.night + self.additional_night


def build_aachen_shots(options: AachenTwinOptions) -> AachenShots:
    """Choose all images of the twin; the same options give the same images."""
    world = options.world()
    places = [build_place(world, index) for index in range(options.num_places)]
    numbers = _database_numbers(options)
    added = options.version == "1.1"
    database: list[Shot] = []
    sequences: list[Shot] = []
    day: list[Shot] = []
    night: list[Shot] = []
    num_night = options.night_queries + options.additional_night_queries * added
    for place in places:
        album = _photographs(options, world, place, numbers[len(database) :])
        database += album
        if added:
            sequences += _sequence(options, world, place)
        day += query_shots(world, place, album, "day", options.day_queries + NUM_UNLISTED)
        night += query_shots(world, place, album, "night", num_night)
    day, night = _as_telephones(day, "day", options), _as_telephones(night, "night", options)
    last_day, last_night = options.day_queries, options.night_queries
    return AachenShots(
        database=_shuffled(database, options, "nvm"),
        sequences=tuple(sequences),
        day=_shuffled(day[:last_day], options, "day"),
        night=_shuffled(night[:last_night], options, "night"),
        additional_night=_shuffled(night[last_night:], options, "additional"),
        unlisted=tuple(day[last_day:]),
    )


def official(shots: Sequence[Shot]) -> list[Shot]:
    """The shots with their poses in the twin's official frame."""
    world_from_official = OFFICIAL_FROM_WORLD.inverse()
    return [
        replace(shot, cam_from_world=shot.cam_from_world @ world_from_official) for shot in shots
    ]


def _database_numbers(options: AachenTwinOptions) -> NDArray[np.int64]:
    """Numbers of the database images, in no order and with gaps."""
    count = options.num_places * options.stations_per_place * len(_YAWS_DEG)
    drawn = stream(options.seed, "aachen", "numbers").permutation(2 * count + 50) + 1
    return drawn[drawn != _WRONG_IMAGE][:count]


def _photographs(
    options: AachenTwinOptions,
    world: SyntheticWorldOptions,
    place: Place,
    numbers: NDArray[np.int64],
) -> list[Shot]:
    """Map images of a place, each with a camera of its own, taken on two sunny days."""
    rng = stream(options.seed, "aachen", "database", place.index)
    suns = [(rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(40, 60))) for _ in range(2)]
    shots: list[Shot] = []
    for station, (spot, heading) in enumerate(place.plan.stops(options.stations_per_place)):
        # of one place, those of a day behind one another: its shadows are cast once
        sun = suns[2 * station // options.stations_per_place]
        for yaw_deg in _YAWS_DEG:
            number = int(numbers[len(shots)])
            name = f"db/{number}.jpg"
            at = np.array([*spot + rng.normal(0, 0.15, 2), rng.uniform(1.5, 1.9)])
            yaw = heading + np.radians(yaw_deg) + float(rng.normal(0, 0.1))
            shots.append(
                _map_shot(
                    world,
                    place,
                    name,
                    sensor_id=f"db_{number}",
                    camera=_photo_camera(options, rng),
                    at=at,
                    yaw=yaw,
                    sun=sun,
                    rng=rng,
                )
            )
    return shots


def _sequence(options: AachenTwinOptions, world: SyntheticWorldOptions, place: Place) -> list[Shot]:
    """A few steps through a place with one camera, looking to the left."""
    rng = stream(options.seed, "aachen", "sequence", place.index)
    sun = (float(rng.uniform(-np.pi, np.pi)), float(np.radians(rng.uniform(40, 60))))
    width, height = options.width, options.height
    if place.index == 0:
        folder, file = "sequences/gopro3_undistorted", "gopro_{:05d}.png"
        camera = Camera("PINHOLE", width, height, (0.7 * width,) * 2 + (width / 2, height / 2))
    else:
        folder = f"sequences/nexus4_sequences/sequence_{place.index}"
        file = "frame_{:06d}.jpg"
        camera = _photo_camera(options, rng, portraits=False)
    # steps of half the distance between the spots of the photographs
    steps = place.plan.stops(max(2 * options.stations_per_place, options.sequence_images))
    return [
        _map_shot(
            world,
            place,
            f"{folder}/{file.format(30 * step + 1)}",
            sensor_id=folder,
            camera=camera,
            at=np.array([*spot, 1.6 + rng.normal(0, 0.02)]),
            yaw=heading + np.pi / 2 + float(rng.normal(0, 0.05)),
            sun=sun,
            rng=rng,
        )
        for step, (spot, heading) in enumerate(steps[: options.sequence_images])
    ]


def _map_shot(
    world: SyntheticWorldOptions,
    place: Place,
    name: str,
    *,
    sensor_id: str,
    camera: Camera,
    at: NDArray[np.float64],
    yaw: float,
    sun: tuple[float, float],
    rng: np.random.Generator,
) -> Shot:
    """A map image taken by hand from ``at`` (place's frame, metres) with the sun at ``sun``."""
    azimuth, elevation = sun
    pitch, roll = (float(a) for a in rng.normal(0.02, 0.03, 2))
    return Shot(
        name=name,
        role="mapping",
        condition="day",
        place=place.index,
        timestamp=0,  # nothing was taken at the same time
        sensor_id=sensor_id,
        camera=camera,
        cam_from_world=looking_at(at, yaw, pitch, roll) @ place.place_from_world,
        look=day_look(
            rng,
            azimuth=azimuth,
            elevation=elevation,
            overcast=0.15,
            noise_seed=noise_seed(world, name),
        ),
        movers=place_movers(place.plan, rng, world.moving_objects, at, yaw=None),
        bonnet=False,
    )


def _photo_camera(
    options: AachenTwinOptions, rng: np.random.Generator, *, portraits: bool = True
) -> Camera:
    """SIMPLE_RADIAL with its principal point in the middle; some are portraits."""
    width, height = options.width, options.height
    focal, k = rng.uniform(0.7, 0.9) * width, rng.uniform(-0.1, 0.02)
    if rng.random() < _PORTRAIT_SHARE and portraits:
        width, height = height, width
    return _simple_radial(width, height, focal, k)


def _simple_radial(width: int, height: int, focal: float, k: float) -> Camera:
    """With the six digits that the published lists have."""
    params = (float(f"{focal:.6g}"), width / 2, height / 2, float(f"{k:.6g}"))
    return Camera("SIMPLE_RADIAL", width, height, params)


def _as_telephones(
    shots: Sequence[Shot], condition: Condition, options: AachenTwinOptions
) -> list[Shot]:
    """Queries sorted by their number, with names of telephones and cameras as in the lists."""
    renamed = []
    for number, shot in enumerate(sorted(shots, key=lambda shot: shot.timestamp)):
        focal, _, _, k = shot.camera.params
        camera = _simple_radial(shot.camera.width, shot.camera.height, focal, k)
        night = condition == "night"
        name = _night_name(number, options) if night else _day_name(number)
        renamed.append(replace(shot, name=name, camera=camera))
    return renamed


def _day_name(number: int) -> str:
    device = _DEVICES[number % len(_DEVICES)]
    hour, minute, second = _clock(number)
    if device == "milestone":
        file = f"2011-12-17_{hour:02d}-{minute:02d}-{second:02d}_{257 + number}.jpg"
    else:
        date = {"nexus4": "20140520", "nexus5x": "20160914"}[device]
        file = f"IMG_{date}_{hour:02d}{minute:02d}{second:02d}.jpg"
    return f"query/day/{device}/{file}"


def _night_name(number: int, options: AachenTwinOptions) -> str:
    folder, date = "nexus5x", "20161227"
    if number >= options.night_queries:
        folder, date = "nexus5x_additional_night", "20180115"
    hour, minute, second = _clock(number)
    return f"query/night/{folder}/IMG_{date}_{hour + 4:02d}{minute:02d}{second:02d}.jpg"


def _clock(number: int) -> tuple[int, int, int]:
    """When the query of a number was taken: each at another time."""
    second = 37 * number
    return 14 + second // 3600, second // 60 % 60, second % 60


def _shuffled(shots: Sequence[Shot], options: AachenTwinOptions, label: str) -> tuple[Shot, ...]:
    """In no order, as in the published files."""
    order = stream(options.seed, "aachen", "order", label).permutation(len(shots))
    return tuple(shots[index] for index in order)
