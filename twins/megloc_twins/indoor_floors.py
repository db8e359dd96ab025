"""Floors of an office building: a corridor with a room on each side of every piece of it.

All floors are built alike, of rooms and pieces of corridor that are alike themselves; each has a
coordinate frame of its own, and the coordinates of one mean something else on the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.values import Camera, RigidTransform
from megloc_twins.frames import looking_at, reduced
from megloc_twins.indoor_rooms import (
    CORRIDOR_M,
    GLASS,
    MODULE_M,
    ROOM_KINDS,
    ROOM_M,
    WALL_THICKNESS_M,
    Parts,
    Recipes,
    build_end,
    build_module,
    build_room,
)
from megloc_twins.lighting import Lighting
from megloc_twins.moving_objects import (
    NUM_PEOPLE,
    FloorPlan,
    MovingObject,
    Obstacle,
    moving_object_recipes,
)
from megloc_twins.options import SyntheticWorldOptions, stream
from megloc_twins.portable import exp, product, settled_pose
from megloc_twins.rasterization import NO_SURFACE, depth_map, sample_grid, visible_surfaces
from megloc_twins.squares import Place
from megloc_twins.surfaces import Surfaces
from megloc_twins.viewpoints import CoarseView, coarse_view, visible

Floats = NDArray[np.float64]

_SCAN_SHIFT_M = 0.35  # how far from the middle of a zone its scanner stands, at most
_SCAN_HEIGHT_M = 1.5
_SCAN_TILT = 0.01  # radians; a tripod stands nearly upright

_REDUCTION = 20  # of a glance, px per px
_ATTEMPTS = 400
_WALL_DISTANCE_M = 0.7
_NEAREST_M, _MEDIAN_M = 0.7, 1.6  # of what a query sees: 10th percentile, median
# share of a query's view that the scans of its floor have seen from about there; how much more
# that must be than what scans of other rooms of the kind have seen of theirs, which is alike
_MIN_SEEN, _MIN_MARGIN = 0.6, 0.2
# 90 degrees wide, 106 high
_QUARTER = Camera("SIMPLE_PINHOLE", 240, 320, (120.0, 120.0, 160.0))
_MAX_ANGLE_DEG, _MAX_DISTANCE_RATIO = 35.0, 2.0
Bools = NDArray[np.bool_]
YAWS_DEG = tuple(range(0, 360, 30))
PITCHES_DEG = (-30, 0, 30)


@dataclass(frozen=True, eq=False)
class Zone:
    """A room or a piece of corridor of a floor.

    Parameters
    ----------
    name : unique on its floor.
    kind : a room's kind, or ``corridor``.
    plan : where one can stand, in the place's frame.
    place_from_zone : those of a kind are alike in their own frames.
    scan_from_place : the scanner in its middle.
    """

    name: str
    kind: str
    plan: FloorPlan
    place_from_zone: RigidTransform
    scan_from_place: RigidTransform


@dataclass(frozen=True, eq=False)
class Floor:
    """A floor, drawn as a place.

    Parameters
    ----------
    place : what there is to see; its world is the floor's official frame.
    zones : rooms first, then pieces of corridor.
    own : bool (N,), the surfaces that no other room or piece of corridor has.
    glass : bool (N,), the surfaces that give a laser nothing back.
    """

    place: Place
    zones: tuple[Zone, ...]
    own: NDArray[np.bool_]
    glass: NDArray[np.bool_]


@dataclass(frozen=True)
class FloorBuilder:
    """Lays out floors of a number of modules, for :func:`render.render_frames`."""

    modules: int

    def floor(self, seed: int, index: int) -> Floor:
        """Floor ``index`` of a building; the same object each time."""
        return _floor(seed, index, self.modules)

    def floors(self, seed: int, count: int) -> list[Floor]:
        """The first floors of a building."""
        return [self.floor(seed, index) for index in range(count)]

    def __call__(self, options: SyntheticWorldOptions, index: int) -> Place:
        return self.floor(options.seed, index).place


@dataclass
class _Collected:
    """The parts of a floor, moved to where they stand in the place's frame."""

    surfaces: Surfaces
    own: NDArray[np.bool_]
    lamps: list[Floats]

    def add(self, parts: Parts, pose: RigidTransform) -> None:
        """``pose`` is place_from_part."""
        surfaces, own = parts.surfaces()
        moved = surfaces.moved(pose.rotation_matrix(), np.array(pose.translation))
        self.surfaces = self.surfaces.joined(moved)
        self.own = np.concatenate([self.own, own])
        self.lamps += [pose.apply(lamp[None])[0] for lamp in parts.lamps]


@lru_cache(maxsize=4)
def _floor(seed: int, index: int, modules: int) -> Floor:
    recipes = Recipes(seed, list(moving_object_recipes(seed)))
    nothing = Parts().surfaces()
    collected = _Collected(nothing[0], nothing[1], [])
    rooms, corridor = [], []
    for module in range(modules):
        name = f"module{module}"
        at = _placed(MODULE_M * (module - 0.5 * modules), 0.0, turned=False)
        parts = build_module(recipes, f"floor{index}/{name}")
        collected.add(parts, at)
        half = CORRIDOR_M / 2
        corridor.append(
            _zone(seed, index, (name, "corridor"), parts, at, (0, -half), (MODULE_M, half))
        )
        for turned, kind in zip((False, True), ROOM_KINDS, strict=True):
            name = f"{kind}{module}"
            pose = at @ _beside_corridor(turned)
            parts = build_room(recipes, kind, f"floor{index}/{name}")
            collected.add(parts, pose)
            rooms.append(_zone(seed, index, (name, kind), parts, pose, (0, 0), ROOM_M))
    for turned in (False, True):
        pose = _placed((-0.5 if turned else 0.5) * MODULE_M * modules, 0.0, turned=turned)
        collected.add(build_end(recipes, f"floor{index}/end{turned:d}"), pose)
    zones = tuple(sorted(rooms, key=lambda zone: (zone.kind, zone.name)) + corridor)
    painters = np.array([recipe.painter for recipe in recipes.items])
    place = Place(
        index=index,
        recipes=tuple(recipes.items),
        surfaces=collected.surfaces,
        lamps=np.array(collected.lamps),
        plan=zones[-1].plan,
        place_from_world=_official_frame(seed, index).inverse(),
    )
    glass = painters[collected.surfaces.texture] == GLASS
    return Floor(place, zones, collected.own, glass)


def _beside_corridor(turned: bool) -> RigidTransform:
    """module_from_room: on the left of who walks along x, or turned and on the right."""
    x, y = 0.5 * (MODULE_M - ROOM_M[0]), 0.5 * CORRIDOR_M + WALL_THICKNESS_M
    return _placed(MODULE_M - x, -y, turned=True) if turned else _placed(x, y, turned=False)


def _placed(x: float, y: float, *, turned: bool) -> RigidTransform:
    sign = -1.0 if turned else 1.0
    return settled_pose(np.diag([sign, sign, 1.0]), np.array([x, y, 0.0]))


def _official_frame(seed: int, index: int) -> RigidTransform:
    """world_from_place: every floor has its own, and their coordinates overlap."""
    rng = stream(seed, "indoor", "frame", index)
    translation = np.array([*rng.uniform(-6, 6, 2), rng.uniform(-0.5, 0.5)])
    return settled_pose(_about_z(rng.uniform(-np.pi, np.pi)), translation)


def _zone(
    seed: int,
    index: int,
    names: tuple[str, str],
    parts: Parts,
    place_from_part: RigidTransform,
    low: tuple[float, float],
    high: tuple[float, float],
) -> Zone:
    """The zone of a part that reaches from ``low`` to ``high`` in its own frame."""
    corners = np.array([(low[0], low[1]), (high[0], low[1]), high, (low[0], high[1])], np.float64)
    outline = place_from_part.apply(np.column_stack([corners, np.zeros(4)]))[:, :2]
    obstacles = []
    for obstacle in parts.obstacles:
        at = place_from_part.apply(np.array([[obstacle.x, obstacle.y, 0.0]]))[0]
        obstacles.append(Obstacle(float(at[0]), float(at[1]), obstacle.radius))
    middle = outline.mean(axis=0)
    plan = FloorPlan(outline, outline, tuple(obstacles))
    rng = stream(seed, "indoor", "scan", index, names[0])
    spot = np.array([*(middle + rng.uniform(-_SCAN_SHIFT_M, _SCAN_SHIFT_M, 2)), _SCAN_HEIGHT_M])
    spot[2] += rng.normal(0, 0.03)
    turn = _about_z(rng.uniform(-np.pi, np.pi))
    lean_x, lean_y = (
        RigidTransform(_small_turn(axis, rng.normal(0, _SCAN_TILT)), (0, 0, 0)) for axis in (1, 2)
    )
    rotation = product((lean_x @ lean_y).rotation_matrix(), turn)
    return Zone(*names, plan, place_from_part, settled_pose(rotation, spot).inverse())


def _small_turn(axis: int, angle: float) -> tuple[float, float, float, float]:
    """Quaternion of a turn about x (1) or y (2)."""
    quat = [float(np.cos(angle / 2)), 0.0, 0.0, 0.0]
    quat[axis] = float(np.sin(angle / 2))
    return quat[0], quat[1], quat[2], quat[3]


def _about_z(angle: float) -> Floats:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def cam_from_scan(yaw_deg: float, pitch_deg: float) -> RigidTransform:
    """A cutout's pose in its scan (z up): at yaw 0 it looks along -x, then turns to the right."""
    return looking_at(np.zeros(3), np.pi - np.radians(yaw_deg), np.radians(pitch_deg), 0.0)


def cutout_camera(width: int, height: int) -> Camera:
    """A cutout's camera, 60 degrees wide."""
    focal = width / 2 / np.tan(np.radians(30.0))
    return Camera("SIMPLE_PINHOLE", width, height, (float(focal), width / 2, height / 2))


def phone_camera(width: int, height: int) -> Camera:
    """A telephone's camera with a 28 mm lens (on 36 mm of film)."""
    focal = max(width, height) * 28 / 36
    return Camera("SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))


def lamp_lighting(
    rng: np.random.Generator, *, noise: float, noise_seed: int, spread: float = 0.0
) -> Lighting:
    """Light of ceiling lamps; ``spread`` is how much light and colour vary between images."""
    light = float(exp(rng.normal(0, spread)))
    cast = np.exp(rng.normal(0, 0.35 * spread, 3))
    return Lighting(
        condition="day",
        sun_direction=(0.0, 0.0, 1.0),
        sun=(0.0, 0.0, 0.0),
        sky=(0.62 * light, 0.60 * light, 0.57 * light),
        lamps=(1.9, 1.8, 1.6),
        glow=(3.0, 2.9, 2.7),
        sky_colour=(0.0, 0.0, 0.0),
        cloud_shift=0.0,
        exposure=float(exp(rng.normal(0, spread))),
        white_balance=(float(cast[0]), float(cast[1]), float(cast[2])),
        shot_noise=4e-5 * noise,
        read_noise=0.002 * noise,
        blur_px=0.5,
        vignetting=0.1 if spread else 0.0,
        noise_seed=noise_seed,
    )


@dataclass(frozen=True)
class QueryView:
    """A telephone's pose, and the people in front of it; in the place's frame."""

    floor: int
    zone: str
    camera: Camera
    cam_from_place: RigidTransform
    people: tuple[MovingObject, ...]


def query_views(
    floors: Sequence[Floor], seed: int, count: int, size: tuple[int, int]
) -> list[QueryView]:
    """Views of floors, the first floor's first, zone by zone; about every third held upright.

    Of some hundred random poses in the zone the first of which the scans of the floor have seen
    enough, and more than those of other rooms have seen of what looks the same; failing that, the
    one nearest to it.
    """
    scans = [[_ScanViews(floor, zone) for zone in floor.zones] for floor in floors]
    views = []
    for index, floor in enumerate(floors):
        for number in range(count * index // len(floors), count * (index + 1) // len(floors)):
            position = number - count * index // len(floors)
            zone = floor.zones[position % len(floor.zones)]
            rng = stream(seed, "indoor", "query", index, position)
            upright = (position + position // len(floor.zones)) % 3 == 2
            camera = phone_camera(*(size[::-1] if upright else size))
            pose, yaw = _query_pose(floors, (index, zone), camera, scans, rng)
            views.append(QueryView(index, zone.name, camera, pose, _people(zone, pose, yaw, rng)))
    return views


def _query_pose(
    floors: Sequence[Floor],
    where: tuple[int, Zone],
    camera: Camera,
    scans: Sequence[Sequence[_ScanViews]],
    rng: np.random.Generator,
) -> tuple[RigidTransform, float]:
    index, zone = where
    low, high = zone.plan.outline.min(axis=0), zone.plan.outline.max(axis=0)
    copies = list(_copies(floors, index, zone))
    best: tuple[float, RigidTransform, float] | None = None
    for _ in range(_ATTEMPTS):
        x, y = (float(v) for v in rng.uniform(low, high))
        yaw = float(rng.uniform(-np.pi, np.pi))
        pitch, roll = float(rng.normal(-0.05, 0.1)), float(rng.normal(0, 0.05))
        position = np.array([x, y, rng.uniform(1.4, 1.75)])
        if not zone.plan.is_free(x, y, _WALL_DISTANCE_M):
            continue
        pose = looking_at(position, yaw, pitch, roll)
        glance = _glance(floors[index], camera, pose)
        if np.percentile(glance.depth, 10) < _NEAREST_M or np.median(glance.depth) < _MEDIAN_M:
            continue
        seen = float((_have_seen(scans[index], glance.points, position) & ~glance.glass).mean())
        miss = max(0.0, _MIN_SEEN - seen)
        if best is not None and miss >= best[0]:
            continue
        for other, moved in copies:
            again = _have_seen(scans[other], moved.apply(glance.points), moved.apply(position))
            alike = float((again & ~glance.own & ~glance.glass).mean())
            miss = max(miss, _MIN_MARGIN - (seen - alike))
        if best is None or miss < best[0]:
            best = (miss, pose, yaw)
        if miss == 0.0:
            break
    if best is None:  # every zone has room for a query
        raise RuntimeError(f"no free view in {zone.name}")
    return best[1:]


def _copies(
    floors: Sequence[Floor], index: int, zone: Zone
) -> Iterator[tuple[int, RigidTransform]]:
    """Floors and transforms that take the zone to others of its kind; a corridor's also turned."""
    half_turn = RigidTransform((0.0, 0.0, 0.0, 1.0), (MODULE_M, 0.0, 0.0))
    for other_index, floor in enumerate(floors):
        for other in floor.zones:
            if other.kind != zone.kind:
                continue
            if (other_index, other.name) != (index, zone.name):
                yield other_index, other.place_from_zone @ zone.place_from_zone.inverse()
            if zone.kind == "corridor":
                turned = other.place_from_zone @ half_turn @ zone.place_from_zone.inverse()
                yield other_index, turned


@dataclass(frozen=True, eq=False)
class _Glance:
    """A view at a fraction of its resolution: of each point its depth (P,), where it is (P, 3),
    whether it belongs to its room alone, and whether it is glass (P,)."""

    depth: Floats
    points: Floats
    own: Bools
    glass: Bools


def _glance(floor: Floor, camera: Camera, cam_from_place: RigidTransform) -> _Glance:
    grid = sample_grid(reduced(camera, _REDUCTION), 1)
    seen = visible_surfaces(floor.place.surfaces, cam_from_place, grid)
    hit = seen.surface != NO_SURFACE
    z = depth_map(seen).astype(np.float64)
    rays = np.stack(np.broadcast_arrays(grid.x, grid.y, 1.0), axis=-1)
    points = cam_from_place.inverse().apply((rays * z[..., None])[hit])
    surface = seen.surface[hit]
    return _Glance(z[hit], points, floor.own[surface], floor.glass[surface])


class _ScanViews:
    """Coarse views of a scan: all around, as high and low as its cutouts reach."""

    def __init__(self, floor: Floor, zone: Zone) -> None:
        self.center = zone.scan_from_place.center()
        self.views: list[CoarseView] = [
            coarse_view(
                floor.place.surfaces, _QUARTER, cam_from_scan(yaw, 0) @ zone.scan_from_place
            )
            for yaw in (0, 90, 180, 270)
        ]

    def sees(self, points: Floats) -> Bools:
        """Visibility (P,) of points (P, 3)."""
        seen = np.zeros(len(points), bool)
        for view in self.views:
            seen |= visible(points, view)
        return seen


def _have_seen(scans: Sequence[_ScanViews], points: Floats, position: Floats) -> Bools:
    """Points (P, 3) that a scan has seen about as one sees them from ``position`` (3,)."""
    found = np.zeros(len(points), bool)
    here = points - position
    distance = np.linalg.norm(here, axis=1)
    for scan in scans:
        there = points - scan.center
        other = np.linalg.norm(there, axis=1)
        cosine = (here * there).sum(axis=1) / (distance * other)
        alike = cosine > np.cos(np.radians(_MAX_ANGLE_DEG))
        alike &= np.abs(np.log(distance / other)) < np.log(_MAX_DISTANCE_RATIO)
        alike &= ~found
        if alike.any():
            found[alike] = scan.sees(points[alike])
    return found


def _people(
    zone: Zone, pose: RigidTransform, yaw: float, rng: np.random.Generator
) -> tuple[MovingObject, ...]:
    """Up to two people in front of every second telephone."""
    people: list[MovingObject] = []
    wanted = int(rng.integers(0, 4)) - 1
    x0, y0, _ = pose.center()
    for _ in range(20):
        if len(people) >= wanted:
            break
        distance, angle = rng.uniform(1.8, 3.5), yaw + rng.uniform(-0.5, 0.5)
        x, y = float(x0 + distance * np.cos(angle)), float(y0 + distance * np.sin(angle))
        if zone.plan.is_free(x, y, 0.3):
            turn = float(rng.uniform(-np.pi, np.pi))
            people.append(MovingObject("person", int(rng.integers(NUM_PEOPLE)), (x, y), turn))
    return tuple(people)
