"""A corridor of offices that are alike, rendered: map images, and queries from elsewhere in them.

Plain kapture: ``mapping/`` with depth, ``query/`` and ``query_gt/``, for ``megloc eval kapture``.
The offices are those of the InLoc twin, :mod:`megloc_twins.indoor_rooms`:
posters, a rug and a cupboard are a room's own, all else, dirt included, every room has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from megloc_twins.frames import Frame, lamp_lighting, looking_at, noise_seed, reduced
from megloc_twins.indoor_rooms import (
    CORRIDOR_M,
    MODULE_M,
    ROOM_M,
    WALL_THICKNESS_M,
    Recipes,
    build_module,
    build_room,
)
from megloc_twins.inloc import phone_camera
from megloc_twins.moving_objects import FloorPlan, moving_object_recipes
from megloc_twins.options import JPEG_QUALITY, SyntheticWorldOptions, stream
from megloc_twins.rasterization import (
    NO_SURFACE,
    depth_map,
    sample_grid,
    visible_surfaces,
)
from megloc_twins.render import RenderedFrame, render_frames
from megloc_twins.squares import Place
from numpy.typing import NDArray

from megloc_kapture.io.images import write_depth_map, write_image
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.values import RigidTransform

ROOMS = 10
QUERIES_PER_ROOM = 5
ROOM_DISTANCE_M = MODULE_M  # between the middles of neighbours

_KIND = "office"
# where the map's photographer stops in a room, metres in its frame, and looks around
_STOPS_M = ((1.4, 1.2), (3.0, 1.3), (3.1, 2.8), (4.5, 2.6))
_DIRECTIONS = 4
_STOP_NOISE_M, _DIRECTION_NOISE_DEG = 0.05, 3.0
# frames of each view: who records does not stay equally long in every room
_FRAMES = (1, 2, 3, 4)
_FRAME_NOISE_M, _FRAME_NOISE_DEG = 0.05, 2.0
_MIN_OWN = 0.1  # share of a query's view that only its room has
_MIN_WALL_M = 0.5  # of a query
_NEAREST_M, _MEDIAN_M = 0.6, 1.5  # of what a query sees: 10th percentile, median
_GLANCE = 10  # px per px
_ATTEMPTS = 400
_CAMERA = phone_camera(320, 240)


@dataclass(frozen=True, eq=False)
class Room:
    """A room with the corridor before it, drawn as a place.

    Attributes
    ----------
    own : bool (N,), the place's surfaces that no other room has.
    own_share : of the area (0..1) of the room's surfaces, that of its own.
    """

    place: Place
    own: NDArray[np.bool_]
    own_share: float


@dataclass(frozen=True)
class Seen:
    """Means over a scene of the share (0..1) of what is seen, or there, that only one room has."""

    of_surface: float
    of_map_views: float
    of_query_views: float


@lru_cache(maxsize=ROOMS)
def build(seed: int, index: int) -> Room:
    """Room ``index`` along the corridor, in a frame of its own, and the room across."""
    recipes = Recipes(seed, list(moving_object_recipes(seed)))
    room = build_room(recipes, _KIND, f"room{index}")
    any_room = build_room(recipes, _KIND, "any")
    surfaces, alike = room.surfaces()[0], any_room.surfaces()[0]
    area = np.linalg.norm(np.cross(surfaces.edge_u, surfaces.edge_v), axis=1)
    own = surfaces.texture != alike.texture
    share = float(area[own].sum() / area.sum())
    lamps = list(room.lamps)
    x, y = 0.5 * (MODULE_M - ROOM_M[0]), 0.5 * CORRIDOR_M + WALL_THICKNESS_M
    for parts, (at_x, at_y), sign in (
        (build_module(recipes, "corridor"), (-x, -y), 1.0),
        (any_room, (MODULE_M - 2 * x, -2 * y), -1.0),
    ):
        turn, shift = np.diag([sign, sign, 1.0]), np.array([at_x, at_y, 0.0])
        surfaces = surfaces.joined(parts.surfaces()[0].moved(turn, shift))
        lamps += [turn @ lamp + shift for lamp in parts.lamps]
    corners = np.array([(0, 0), (ROOM_M[0], 0), ROOM_M, (0, ROOM_M[1])], np.float64)
    place = Place(
        index=index,
        recipes=tuple(recipes.items),
        surfaces=surfaces,
        lamps=np.array(lamps),
        plan=FloorPlan(corners, corners, tuple(room.obstacles)),
        place_from_world=RigidTransform((1.0, 0.0, 0.0, 0.0), (-MODULE_M * index, 0.0, 0.0)),
    )
    return Room(place, np.pad(own, (0, len(surfaces) - len(own))), share)


def _build_place(options: SyntheticWorldOptions, index: int) -> Place:
    return build(options.seed, index).place


def write_corridor(root: Path, seed: int) -> Seen:
    """Draw the corridor of a seed and write it below ``root``."""
    mapping, map_views = _mapping(seed)
    queries, query_views = _queries(seed)
    render_frames(
        _world(seed),
        [*mapping, *queries],
        partial(_write_view, root),
        with_depth=[shot.name for shot in mapping],
        build=_build_place,
    )
    write_sensors(root / "mapping", _with_depth(_records(mapping, poses=True)))
    write_sensors(root / "query", _records(queries, poses=False))
    write_sensors(root / "query_gt", _records(queries, poses=True))
    surface = np.mean([build(seed, index).own_share for index in range(ROOMS)])
    return Seen(float(surface), float(np.mean(map_views)), float(np.mean(query_views)))


def _world(seed: int) -> SyntheticWorldOptions:
    return SyntheticWorldOptions(seed=seed, num_places=ROOMS, supersampling=1)


def _mapping(seed: int) -> tuple[list[Frame], list[float]]:
    """Shots of all rooms, and the share of each view that only its room has."""
    shots: list[Frame] = []
    own: list[float] = []
    frames = stream(seed, "corridor", "frames").permutation(np.resize(_FRAMES, ROOMS)).tolist()
    for index in range(ROOMS):
        room = build(seed, index)
        for stop, where in enumerate(_STOPS_M):
            rng = stream(seed, "corridor", "stop", index, stop)
            spot = np.array([*where, 1.5]) + rng.normal(0, _STOP_NOISE_M, 3)
            for number in range(_DIRECTIONS):
                # every second stop looks between the directions of the first
                yaw = 2 * np.pi * (number + 0.5 * (stop % 2)) / _DIRECTIONS
                yaw += np.radians(rng.normal(0, _DIRECTION_NOISE_DEG))
                for frame in range(frames[index]):
                    pose = looking_at(
                        spot + rng.normal(0, _FRAME_NOISE_M, 3),
                        yaw + np.radians(rng.normal(0, _FRAME_NOISE_DEG)),
                        rng.normal(-0.05, 0.05),
                        rng.normal(0, 0.02),
                    )
                    name = f"room{index}/stop{stop}_{number}_{frame}.jpg"
                    shots.append(_shot(seed, room, name, "mapping", len(shots), pose, rng))
                    own.append(_glance(room, pose)[1])
    return shots, own


def _queries(seed: int) -> tuple[list[Frame], list[float]]:
    """Shots from anywhere in the rooms, looking anywhere; the share of each that is the room's."""
    shots: list[Frame] = []
    own: list[float] = []
    for index in range(ROOMS):
        room = build(seed, index)
        for number in range(QUERIES_PER_ROOM):
            rng = stream(seed, "corridor", "query", index, number)
            pose, share = _query_pose(room, rng)
            name = f"query/room{index}_{number}.jpg"
            shots.append(_shot(seed, room, name, "query", len(shots), pose, rng))
            own.append(share)
    return shots, own


def _query_pose(room: Room, rng: np.random.Generator) -> tuple[RigidTransform, float]:
    for _ in range(_ATTEMPTS):
        x, y = (float(v) for v in rng.uniform((0.0, 0.0), ROOM_M))
        yaw, pitch, roll = rng.uniform(-np.pi, np.pi), rng.normal(-0.05, 0.1), rng.normal(0, 0.05)
        pose = looking_at(np.array([x, y, rng.uniform(1.4, 1.75)]), yaw, pitch, roll)
        if not room.place.plan.is_free(x, y, _MIN_WALL_M):
            continue
        depth, share = _glance(room, pose)
        near, median = np.percentile(depth, (10, 50))
        if near >= _NEAREST_M and median >= _MEDIAN_M and share >= _MIN_OWN:
            return pose, share
    raise RuntimeError(f"no view of {room.place.name} shows enough of its own")


def _glance(room: Room, cam_from_place: RigidTransform) -> tuple[NDArray[np.float32], float]:
    """Depths (P,) of a coarse view, and the share of it that only this room has."""
    grid = sample_grid(reduced(_CAMERA, _GLANCE), 1)
    seen = visible_surfaces(room.place.surfaces, cam_from_place, grid)
    hit = seen.surface != NO_SURFACE
    return depth_map(seen)[hit], float(room.own[seen.surface[hit]].mean())


def _shot(
    seed: int,
    room: Room,
    name: str,
    role: str,
    timestamp: int,
    cam_from_place: RigidTransform,
    rng: np.random.Generator,
) -> Frame:
    query = role == "query"
    look = lamp_lighting(rng, noise=3.0 if query else 1.0, spread=0.15 if query else 0.05)
    return Frame(
        name=name,
        role="query" if query else "mapping",
        condition=_KIND,
        place=room.place.index,
        timestamp=timestamp,
        sensor_id=role,
        camera=_CAMERA,
        cam_from_world=cam_from_place @ room.place.place_from_world,
        lighting=look,
        noise_seed=noise_seed(seed, name),
    )


def _records(shots: Sequence[Frame], *, poses: bool) -> KaptureData:
    data = KaptureData()
    for shot in shots:
        data.sensors[shot.sensor_id] = Sensor.from_camera(shot.camera, name=shot.sensor_id)
        data.records_camera[shot.timestamp, shot.sensor_id] = shot.name
        if poses:
            data.trajectories[shot.timestamp, shot.sensor_id] = shot.cam_from_world
    return data


def _with_depth(data: KaptureData) -> KaptureData:
    """The records, with a depth sensor in each camera's place."""
    for sensor in sorted(data.sensors):
        camera = data.sensors[sensor].camera()
        data.sensors[f"{sensor}_depth"] = Sensor.from_camera(
            camera, name=f"{sensor}_depth", sensor_type="depth"
        )
        still = RigidTransform.identity()
        data.rigs[f"{sensor}_rig"] = {sensor: still, f"{sensor}_depth": still}
    for timestamp, sensor in list(data.trajectories):
        data.trajectories[timestamp, f"{sensor}_rig"] = data.trajectories.pop((timestamp, sensor))
    for (timestamp, sensor), name in data.records_camera.items():
        data.records_depth[timestamp, f"{sensor}_depth"] = _depth_record(name)
    return data


def _depth_record(name: str) -> str:
    return f"depth/{name.removesuffix('.jpg')}.depth"


def _write_view(root: Path, shot: Frame, view: RenderedFrame) -> None:
    folder = root / shot.role / "sensors" / "records_data"
    write_image(folder / shot.name, view.image, jpeg_quality=JPEG_QUALITY)
    if view.depth_m is not None:
        write_depth_map(folder / _depth_record(shot.name), view.depth_m)
