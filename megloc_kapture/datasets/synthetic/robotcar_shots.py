"""What RobotCar Seasons' twin shows: a car with three cameras, the same streets in all weathers.

Nothing is drawn here. The shots' names are those of the official layout, their poses in the
frame of the synthetic world; :func:`official` gives them in the one the twin publishes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.datasets.synthetic.cameras import looking_at
from megloc_kapture.datasets.synthetic.covisibility import (
    CoarseView,
    coarse_view,
    overlap,
    support,
)
from megloc_kapture.datasets.synthetic.movers import place_movers
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions, stream
from megloc_kapture.datasets.synthetic.places import Place, build_place
from megloc_kapture.datasets.synthetic.portable import product, settled_pose
from megloc_kapture.datasets.synthetic.road_looks import road_look
from megloc_kapture.datasets.synthetic.shots import Shot, noise_seed
from megloc_kapture.values import Camera, Options, RigidTransform

REFERENCE_CONDITION = "overcast-reference"
DAY_CONDITIONS = ("dawn", "overcast-winter", "rain", "sun")
NIGHT_CONDITIONS = ("night", "night-rain")
CAMERAS = ("left", "rear", "right")
SCORED_CAMERA = "rear"  # it sees the car's boot too

# the published world is metric with z up; this one lies elsewhere than the rendered one
OFFICIAL_FROM_WORLD = settled_pose(
    np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    np.array([-412.25, 1381.5, 62.75]),
)
CAMERA_HEIGHT_M = 1.6
# microseconds, of the first image of each traversal
_STARTS_US = {
    "overcast-reference": 1417176458999821,
    "dawn": 1418721355075498,
    "overcast-winter": 1423840721124367,
    "rain": 1416908241836249,
    "sun": 1425990211450168,
    "night": 1418235223450115,
    "night-rain": 1418840689734892,
}
_PLACE_US, _STOP_US = 60_000_000, 1_062_501
# where the cameras look, degrees to the right of the driver and up, and where they are on the
# car, metres to the right, down and ahead of its origin
_ON_CAR = {
    "left": (-84.0, 3.0, (-0.35, 0.02, -0.1)),
    "rear": (179.2, -4.0, (0.06, 0.15, -1.1)),
    "right": (86.0, 2.0, (0.34, 0.03, -0.1)),
}
_CENTRES = {"left": (0.4884, 0.4995), "rear": (0.4963, 0.4865), "right": (0.4907, 0.4788)}
_FOCAL = 0.6  # of the width

_MAX_OVERLAP = 0.85  # no query is a copy of a map image
_MIN_SUPPORT = 0.6  # share of a query's view that the map can tell it
_MIN_SHARE = 0.1  # of a view that another has to see to support it
_ATTEMPTS = 50
_STEPS = 997  # of the path, that a query may be at


class RobotCarTwinOptions(Options):
    """What RobotCar Seasons' twin contains; the defaults are what ``make eval`` localizes in."""

    seed: int = Field(default=0, ge=0, description="every random choice hangs on it")
    num_locations: int = Field(default=3, ge=1, description="locations, at least 60 m apart")
    stops_per_location: int = Field(
        default=12, ge=3, description="moments of the reference traversal in each location"
    )
    moments_per_condition: int = Field(
        default=8, ge=2, description="moments of each other traversal, all locations"
    )
    size_px: int = Field(default=512, ge=64, description="width and height of an image")
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

    def world(self) -> SyntheticWorldOptions:
        """The rendered world the car drives through."""
        return SyntheticWorldOptions(
            seed=self.seed,
            num_places=self.num_locations,
            width=self.size_px,
            height=self.size_px,
            supersampling=self.supersampling,
            night_exposure=self.night_exposure,
            jpeg_quality=self.jpeg_quality,
        )


@dataclass(frozen=True, eq=False)
class Moment:
    """One moment of a traversal: what its three cameras take, in the order of CAMERAS."""

    condition: str
    place: int
    timestamp: int
    car_from_world: RigidTransform
    shots: tuple[Shot, ...]


@dataclass(frozen=True, eq=False)
class RobotCarMoments:
    """All moments of the twin; poses in the world's frame.

    Parameters
    ----------
    reference : of the map, by location, then time.
    queries : by condition, then time.
    """

    reference: tuple[Moment, ...]
    queries: tuple[Moment, ...]

    def mapping_shots(self) -> list[Shot]:
        """The reference images."""
        return [shot for moment in self.reference for shot in moment.shots]

    def query_shots(self) -> list[Shot]:
        """The queries."""
        return [shot for moment in self.queries for shot in moment.shots]


def build_robotcar_moments(options: RobotCarTwinOptions) -> RobotCarMoments:
    """Choose all images of the twin; the same options give the same images."""
    world = options.world()
    reference: list[Moment] = []
    queries: list[Moment] = []
    for index in range(options.num_locations):
        place = build_place(world, index)
        here = _reference_moments(options, world, place)
        views = [
            coarse_view(place.surfaces, shot.camera, _cam_from_place(shot, place))
            for moment in here
            for shot in moment.shots
        ]
        for condition in (*DAY_CONDITIONS, *NIGHT_CONDITIONS):
            queries += _query_moments(options, world, place, views, condition)
        reference += here
    return RobotCarMoments(
        tuple(reference),
        tuple(sorted(queries, key=lambda moment: (moment.condition, moment.timestamp))),
    )


def official(shots: Sequence[Shot]) -> list[Shot]:
    """The shots with their poses in the twin's official frame."""
    world_from_official = OFFICIAL_FROM_WORLD.inverse()
    return [
        replace(shot, cam_from_world=shot.cam_from_world @ world_from_official) for shot in shots
    ]


def car_cameras(size_px: int) -> dict[str, Camera]:
    """The cameras by name, PINHOLE with the six decimals of the published files."""
    focal = round(_FOCAL * size_px, 6)
    return {
        name: Camera(
            "PINHOLE",
            size_px,
            size_px,
            (focal, focal, round(cx * size_px, 6), round(cy * size_px, 6)),
        )
        for name, (cx, cy) in _CENTRES.items()
    }


def cam_from_car() -> dict[str, RigidTransform]:
    """Where the cameras are; the car's frame has x to the right, y down and z ahead, metres."""
    result = {}
    for name, (right_deg, up_deg, position) in _ON_CAR.items():
        right, up = np.radians(right_deg), np.radians(up_deg)
        about_y = np.array(
            [[np.cos(right), 0, -np.sin(right)], [0, 1, 0], [np.sin(right), 0, np.cos(right)]]
        )
        about_x = np.array([[1, 0, 0], [0, np.cos(up), np.sin(up)], [0, -np.sin(up), np.cos(up)]])
        rotation = product(about_x, about_y)
        result[name] = settled_pose(rotation, -product(rotation, np.array(position)))
    return result


def _reference_moments(
    options: RobotCarTwinOptions, world: SyntheticWorldOptions, place: Place
) -> list[Moment]:
    rng = stream(options.seed, "robotcar", REFERENCE_CONDITION, place.index)
    azimuth = float(rng.uniform(-np.pi, np.pi))
    moments = []
    for number, (spot, heading) in enumerate(place.plan.stops(options.stops_per_location)):
        pose = _car_from_place(spot + rng.normal(0, 0.15, 2), heading + rng.normal(0, 0.1), rng)
        moments.append(
            _moment(options, world, place, REFERENCE_CONDITION, number, pose, azimuth, rng)
        )
    return moments


def _query_moments(
    options: RobotCarTwinOptions,
    world: SyntheticWorldOptions,
    place: Place,
    map_views: list[CoarseView],
    condition: str,
) -> list[Moment]:
    """This location's share of a traversal's moments."""
    azimuth = float(stream(options.seed, "robotcar", condition, place.index).uniform(-np.pi, np.pi))
    moments = []
    for number in range(place.index, options.moments_per_condition, options.num_locations):
        rng = stream(options.seed, "robotcar", condition, place.index, number)
        pose = _query_pose(options, place, map_views, rng)
        moments.append(_moment(options, world, place, condition, number, pose, azimuth, rng))
    return moments


def _moment(
    options: RobotCarTwinOptions,
    world: SyntheticWorldOptions,
    place: Place,
    condition: str,
    number: int,
    car_from_place: RigidTransform,
    azimuth: float,
    rng: np.random.Generator,
) -> Moment:
    jitter = int(rng.integers(0, 1000))
    timestamp = _STARTS_US[condition] + place.index * _PLACE_US + number * _STOP_US + jitter
    car_from_world = car_from_place @ place.place_from_world
    position = car_from_place.center()
    movers = place_movers(place.plan, rng, world.moving_objects, position, yaw=None)
    on_car = cam_from_car()
    shots = []
    for camera, intrinsics in car_cameras(options.size_px).items():
        name = f"{condition}/{camera}/{timestamp}.jpg"
        look = road_look(
            condition,
            rng,
            azimuth=azimuth,
            noise_seed=noise_seed(world, name),
            night_exposure=options.night_exposure,
        )
        shots.append(
            Shot(
                name=name,
                role="mapping" if condition == REFERENCE_CONDITION else "query",
                condition=condition,
                place=place.index,
                timestamp=timestamp,
                sensor_id=camera,
                camera=intrinsics,
                cam_from_world=on_car[camera] @ car_from_world,
                look=look,
                movers=movers,
                bonnet=camera == SCORED_CAMERA,
            )
        )
    return Moment(condition, place.index, timestamp, car_from_world, tuple(shots))


def _query_pose(
    options: RobotCarTwinOptions,
    place: Place,
    map_views: list[CoarseView],
    rng: np.random.Generator,
) -> RigidTransform:
    """``car_from_place`` of a query: on the reference traversal's way, a little beside it.

    Of many random poses the first whose scored view is supported by the map without being a copy
    of one of its images; failing that, the one nearest to it.
    """
    camera, cam_on_car = car_cameras(options.size_px)[SCORED_CAMERA], cam_from_car()[SCORED_CAMERA]
    path = place.plan.stops(_STEPS)
    best: tuple[float, RigidTransform] | None = None
    for _ in range(_ATTEMPTS):
        spot, heading = path[int(rng.integers(_STEPS))]
        aside = np.clip(rng.normal(0, 0.6), -1.2, 1.2)
        spot = spot + aside * np.array([-np.sin(heading), np.cos(heading)])
        yaw = heading + rng.normal(0, 0.12)
        if not place.plan.is_free(float(spot[0]), float(spot[1]), 0.9):
            continue
        pose = _car_from_place(spot, yaw, rng)
        miss = _miss(coarse_view(place.surfaces, camera, cam_on_car @ pose), map_views)
        if best is None or miss < best[0]:
            best = (miss, pose)
        if miss == 0.0:
            break
    if best is None:  # the reference traversal's way is free
        raise RuntimeError(f"no free spot on the way through {place.name}")
    return best[1]


def _miss(view: CoarseView, map_views: list[CoarseView]) -> float:
    """How far a view is from being supported by the map without being a copy; 0 is well."""
    shares = [overlap(view, other) for other in map_views]
    seen = [other for other, share in zip(map_views, shares, strict=True) if share > _MIN_SHARE]
    return max(_MIN_SUPPORT - support(view, seen), max(shares) - _MAX_OVERLAP, 0.0)


def _car_from_place(
    spot: NDArray[np.float64], yaw: float, rng: np.random.Generator
) -> RigidTransform:
    """Of a car at a spot (2,), metres, that drives along ``yaw``, a little tilted."""
    pitch, roll = (float(a) for a in rng.normal(0, 0.012, 2))
    height = CAMERA_HEIGHT_M + float(rng.normal(0, 0.02))
    return looking_at(np.array([*spot, height]), float(yaw), pitch, roll)


def _cam_from_place(shot: Shot, place: Place) -> RigidTransform:
    return shot.cam_from_world @ place.place_from_world.inverse()
