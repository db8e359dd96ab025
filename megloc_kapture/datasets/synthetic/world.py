"""The synthetic world: its places, the mapping rig's stops, the queries; nothing is drawn yet.

:func:`build_world` decides everything from the options; :mod:`views` draws one shot at a time,
and writers turn shots into files of whatever layout.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.cameras import (
    BONNET_CAMERA,
    looking_at,
    query_camera,
    rig_cameras,
    rig_geometry,
)
from megloc_kapture.datasets.synthetic.covisibility import CoarseView, coarse_view, overlap, support
from megloc_kapture.datasets.synthetic.looks import Condition, Look, day_look, night_look
from megloc_kapture.datasets.synthetic.movers import NUM_CARS, NUM_PEOPLE, Mover
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions, stream
from megloc_kapture.datasets.synthetic.places import Place, build_place
from megloc_kapture.values import Camera, RigidTransform

RIG_ID = "rig"
RIG_HEIGHT_M = 1.9
_MAX_OVERLAP = 0.85  # no query is a copy of a mapping image
_MIN_SUPPORT = 0.6  # share of a query's view that the map can tell it


@dataclass(frozen=True)
class Shot:
    """One image of the world, before it is drawn.

    Parameters
    ----------
    name : path of the image below ``records_data``.
    role : whether it belongs to the map or asks where it is.
    condition : day or night.
    place : index of the place it shows.
    timestamp, sensor_id : its record; shots of one stop of the rig share the timestamp.
    camera : intrinsics.
    cam_from_world : its pose, metres.
    look : light and sensor.
    movers : people and cars at that moment, in the place's frame.
    bonnet : whether the car's bonnet is in view.
    """

    name: str
    role: Literal["mapping", "query"]
    condition: Condition
    place: int
    timestamp: int
    sensor_id: str
    camera: Camera
    cam_from_world: RigidTransform
    look: Look
    movers: tuple[Mover, ...]
    bonnet: bool


@dataclass(frozen=True, eq=False)
class SyntheticWorld:
    """Everything there is, in one world frame (metres, z up).

    Parameters
    ----------
    options : that the world was built from.
    places : by index.
    rig_cameras : the mapping rig's cameras by sensor id.
    sensor_from_rig : their places on the rig.
    rig_from_world : the rig's poses by timestamp.
    shots : all images, mapping first, in the order of their names within a role.
    """

    options: SyntheticWorldOptions
    places: tuple[Place, ...]
    rig_cameras: dict[str, Camera]
    sensor_from_rig: dict[str, RigidTransform]
    rig_from_world: dict[int, RigidTransform]
    shots: tuple[Shot, ...]

    def mapping_shots(self) -> tuple[Shot, ...]:
        """Images of the map."""
        return tuple(s for s in self.shots if s.role == "mapping")

    def query_shots(self) -> tuple[Shot, ...]:
        """Images to be localized."""
        return tuple(s for s in self.shots if s.role == "query")

    def coarse_views(self) -> dict[str, CoarseView]:
        """Coarse depth of every shot by image name, without moving objects, world frame."""
        views = {}
        for place in self.places:
            surfaces = place.surfaces.moved(place.rotation(), place.world_offset)
            for shot in self.shots:
                if shot.place == place.index:
                    views[shot.name] = coarse_view(surfaces, shot.camera, shot.cam_from_world)
        return views


def place_from_world(place: Place) -> RigidTransform:
    """From the world's frame to the place's own."""
    return RigidTransform.from_matrix(place.rotation(), place.world_offset).inverse()


def build_world(options: SyntheticWorldOptions) -> SyntheticWorld:
    """Lay out the world and choose all its shots; the same options give the same world."""
    places = tuple(build_place(options, index) for index in range(options.num_places))
    cameras = rig_cameras(options)
    sensor_from_rig = rig_geometry()
    sensor_ids = {name: f"rig_{name}" for name in cameras}
    rig_from_world: dict[int, RigidTransform] = {}
    mapping: list[Shot] = []
    for place in places:
        mapping += _mapping_shots(options, place, cameras, sensor_from_rig, rig_from_world)
    queries: list[Shot] = []
    for place in places:
        views = [
            coarse_view(
                place.surfaces, shot.camera, shot.cam_from_world @ place_from_world(place).inverse()
            )
            for shot in mapping
            if shot.place == place.index
        ]
        queries += _query_shots(options, place, views, "day", options.day_queries)
        queries += _query_shots(options, place, views, "night", options.night_queries)
    shots = sorted(mapping, key=lambda s: s.name) + sorted(queries, key=lambda s: s.name)
    return SyntheticWorld(
        options=options,
        places=places,
        rig_cameras={sensor_ids[name]: camera for name, camera in cameras.items()},
        sensor_from_rig={sensor_ids[name]: pose for name, pose in sensor_from_rig.items()},
        rig_from_world=rig_from_world,
        shots=tuple(shots),
    )


def _mapping_shots(
    options: SyntheticWorldOptions,
    place: Place,
    cameras: dict[str, Camera],
    sensor_from_rig: dict[str, RigidTransform],
    rig_from_world: dict[int, RigidTransform],
) -> list[Shot]:
    """All images of the rig's round through a place; its poses are added to ``rig_from_world``."""
    shots = []
    rng = stream(options.seed, "mapping", place.index)
    sun = (float(rng.uniform(-np.pi, np.pi)), float(np.radians(rng.uniform(40, 60))))
    to_world = place_from_world(place)
    for station, (position, heading) in enumerate(_stops(place, options.stations_per_place, rng)):
        timestamp = 1000 * (place.index + 1) + station
        rig_from_place = looking_at(
            position, heading, float(rng.normal(0, 0.015)), float(rng.normal(0, 0.015))
        )
        rig_from_world[timestamp] = rig_from_place @ to_world
        movers = _movers_around(options, place, rng, position, None)
        for name, camera in cameras.items():
            image = f"db/{place.name}/{name}/{station:05d}.{options.image_format}"
            look = day_look(
                rng,
                azimuth=sun[0],
                elevation=sun[1],
                overcast=0.15,
                noise_seed=_noise_seed(options, image),
            )
            shots.append(
                Shot(
                    name=image,
                    role="mapping",
                    condition="day",
                    place=place.index,
                    timestamp=timestamp,
                    sensor_id=f"rig_{name}",
                    camera=camera,
                    cam_from_world=sensor_from_rig[name] @ rig_from_world[timestamp],
                    look=look,
                    movers=movers,
                    bonnet=options.bonnet and name == BONNET_CAMERA,
                )
            )
    return shots


def _noise_seed(options: SyntheticWorldOptions, image: str) -> int:
    return int(stream(options.seed, "noise", image).integers(2**31))


def _stops(
    place: Place, count: int, rng: np.random.Generator
) -> list[tuple[NDArray[np.float64], float]]:
    """Positions (3,) and headings (radians) at equal distances along the place's closed path."""
    path = place.path
    along = np.roll(path, -1, axis=0) - path
    lengths = np.hypot(*along.T)
    ends = np.cumsum(lengths)
    stops = []
    for distance in (np.arange(count) + 0.5) / count * ends[-1]:
        leg = int(np.searchsorted(ends, distance))
        part = (distance - ends[leg] + lengths[leg]) / lengths[leg]
        spot = path[leg] + part * along[leg] + rng.normal(0, 0.15, 2)
        # corners are turned smoothly: the heading is that of the chord around the stop
        heading = np.arctan2(*(along[leg][::-1])) + rng.normal(0, 0.12)
        stops.append((np.array([*spot, RIG_HEIGHT_M + rng.normal(0, 0.03)]), float(heading)))
    return stops


def _movers_around(
    options: SyntheticWorldOptions,
    place: Place,
    rng: np.random.Generator,
    position: NDArray[np.float64],
    yaw: float | None,
) -> tuple[Mover, ...]:
    """People and cars near a position, in front of it where ``yaw`` is given."""
    movers: list[Mover] = []
    for _ in range(60):
        if len(movers) >= options.moving_objects:
            break
        kind: Literal["person", "car"] = "car" if rng.random() < 0.3 else "person"
        distance = rng.uniform(4.5, 8.0) if kind == "car" else rng.uniform(2.5, 7.0)
        angle = rng.uniform(-np.pi, np.pi) if yaw is None else yaw + rng.uniform(-0.5, 0.5)
        x = float(position[0] + distance * np.cos(angle))
        y = float(position[1] + distance * np.sin(angle))
        variant = int(rng.integers(NUM_CARS if kind == "car" else NUM_PEOPLE))
        mover = Mover(kind, variant, (x, y), float(rng.uniform(-np.pi, np.pi)))
        apart = all(
            np.hypot(x - m.position[0], y - m.position[1]) > mover.radius_m + m.radius_m
            for m in movers
        )
        if apart and place.is_free(x, y, 0.6 * mover.radius_m):
            movers.append(mover)
    return tuple(movers)


def _query_shots(
    options: SyntheticWorldOptions,
    place: Place,
    map_views: list[CoarseView],
    condition: Condition,
    total: int,
) -> list[Shot]:
    """This place's share of the ``total`` queries of a condition."""
    shots = []
    for number in range(place.index, total, options.num_places):
        image = f"query/{condition}/{number:05d}.{options.image_format}"
        rng = stream(options.seed, image.rsplit(".", 1)[0])
        camera = query_camera(options, rng)
        position, yaw, cam_from_place = _query_pose(place, camera, map_views, rng)
        noise_seed = _noise_seed(options, image)
        if condition == "day":
            look = day_look(
                rng,
                azimuth=float(rng.uniform(-np.pi, np.pi)),
                elevation=float(np.radians(rng.uniform(35, 60))),
                overcast=float(rng.choice([0.1, 0.5, 1.0])),
                noise_seed=noise_seed,
            )
        else:
            look = night_look(rng, exposure=options.night_exposure, noise_seed=noise_seed)
        shots.append(
            Shot(
                name=image,
                role="query",
                condition=condition,
                place=place.index,
                timestamp=100_000 * (1 if condition == "day" else 2) + number,
                sensor_id=f"{condition}_{number:05d}",
                camera=camera,
                cam_from_world=cam_from_place @ place_from_world(place),
                look=look,
                movers=_movers_around(options, place, rng, position, yaw),
                bonnet=False,
            )
        )
    return shots


def _query_pose(
    place: Place, camera: Camera, map_views: list[CoarseView], rng: np.random.Generator
) -> tuple[NDArray[np.float64], float, RigidTransform]:
    """Position, yaw and ``cam_from_place`` of a query that shares part of its view with the map.

    Of a few hundred random poses the first that keeps its distance from things and is supported
    by the map without being a copy of one of its images; failing that, the one nearest to it.
    """
    low, high = place.outline.min(0), place.outline.max(0)
    best: tuple[float, NDArray[np.float64], float, RigidTransform] | None = None
    for _ in range(300):
        x, y = rng.uniform(low, high)
        yaw = float(rng.uniform(-np.pi, np.pi))
        pitch, roll = float(rng.normal(0.04, 0.06)), float(rng.normal(0, 0.06))
        position = np.array([x, y, rng.uniform(1.45, 1.8)])
        if not place.is_free(x, y, 0.9):
            continue
        pose = looking_at(position, yaw, pitch, roll)
        view = coarse_view(place.surfaces, camera, pose)
        depth = view.depth[view.depth > 0]
        if np.percentile(depth, 10) < 1.2 or np.median(depth) < 3.5:
            continue
        share = max(overlap(view, other) for other in map_views)
        miss = max(share - _MAX_OVERLAP, _MIN_SUPPORT - support(view, map_views), 0.0)
        if best is None or miss < best[0]:
            best = (miss, position, yaw, pose)
        if miss == 0.0:
            break
    if best is None:  # a place without room for a query cannot come from our outlines
        raise RuntimeError(f"no free view in {place.name}")
    return best[1:]
