"""Floors of an office building: a corridor with a room on each side of every piece of it.

All floors are built alike, of rooms and pieces of corridor that are alike themselves; each has a
coordinate frame of its own, and the coordinates of one mean something else on the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.floor_plans import FloorPlan, Obstacle
from megloc_kapture.datasets.synthetic.indoor import GLASS, WALL_THICKNESS_M, Parts, Recipes
from megloc_kapture.datasets.synthetic.indoor_rooms import (
    CORRIDOR_M,
    MODULE_M,
    ROOM_KINDS,
    ROOM_M,
    build_end,
    build_module,
    build_room,
)
from megloc_kapture.datasets.synthetic.movers import mover_recipes
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions, stream
from megloc_kapture.datasets.synthetic.places import Place
from megloc_kapture.datasets.synthetic.portable import product, settled_pose
from megloc_kapture.datasets.synthetic.surfaces import Surfaces
from megloc_kapture.values import RigidTransform

Floats = NDArray[np.float64]

_SCAN_SHIFT_M = 0.35  # how far from the middle of a zone its scanner stands, at most
_SCAN_HEIGHT_M = 1.5
_SCAN_TILT = 0.01  # radians; a tripod stands nearly upright


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
    """Lays out floors of a number of modules, for :func:`studio.draw_shots`."""

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
    recipes = Recipes(seed, list(mover_recipes(seed)))
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
