"""Floors of an office building: two kinds of similar rooms along a corridor.

A room has its door in the wall y = 0 and windows opposite. Rooms of a kind differ only in posters,
a rug, a cupboard and the door sign; everything else, including dirt, is equal on all floors. Each
floor has a separate coordinate frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from megloc_kapture.values import RigidTransform
from megloc_twins.moving_objects import FloorPlan, Obstacle, moving_object_recipes
from megloc_twins.options import SyntheticWorldOptions, seed_of, stream
from megloc_twins.portable import Bools, Float64, product, settled_pose
from megloc_twins.squares import Place, about_z
from megloc_twins.surfaces import PASSAGE, Opening, SurfaceBuilder, Surfaces, Wall
from megloc_twins.textures import TextureRecipe, index_of, texels

Point = tuple[float, float]

ROOM_M = (6.0, 5.0)  # along the corridor and perpendicular to it
MODULE_M = 7.0  # length of a corridor section, which has a room on each side
CORRIDOR_M = 2.4
WALL_THICKNESS_M = 0.15

_HEIGHT_M = 2.8
_DOOR_M = (1.0, 2.1)  # width, height
_DOOR_X = 0.7  # left edge of a room's door
_FLAT_M = {"poster": (0.9, 1.26), "sign": (0.5, 0.17)}  # width, height
_TEXELS_PER_M = 100
_GLASS = "window"  # painter of textures that return no laser beam
_DIRT = 0.8  # of walls, floors and ceilings; equal in rooms of a kind
_INDIRECT = 0.12  # glow of the ceiling by indirect light, relative to that of lamps
_SIZES = {  # width, height in texels
    "window": (156, 192),
    "door": (132, 270),
    "poster": (200, 280),
    "sign": (240, 80),
    "wood": (160, 160),
    "plain": (128, 128),
    "shutter": (200, 260),
    "glow": (8, 8),
}

_SCAN_SHIFT_M = 0.35  # largest distance of a scanner from the middle of its zone
_SCAN_HEIGHT_M = 1.5
_SCAN_TILT = 0.01  # radians; a tripod stands nearly upright


@dataclass
class Recipes:
    """Textures of a floor in the world of ``seed``; surfaces index ``items``."""

    seed: int
    items: list[TextureRecipe] = field(default_factory=list)

    def thing(self, painter: str, *label: str | int) -> int:
        """Return a texture of a kind; equal labels give equal textures."""
        number = seed_of(self.seed, "indoor", painter, *label)
        return index_of(TextureRecipe(painter, *_SIZES[painter], number), self.items)

    def material(self, kind: str, size_m: tuple[float, float], *label: str | int) -> int:
        """Return a texture of a wall, floor or ceiling, equal for equal labels and sizes."""
        number = seed_of(self.seed, "indoor", kind, *label)
        material_seed = seed_of(self.seed, "indoor", label[0])
        params = (("material", kind), ("material_seed", material_seed), ("dirt", _DIRT))
        recipe = TextureRecipe("wall", *texels(size_m, _TEXELS_PER_M), number, params)
        return index_of(recipe, self.items)


@dataclass
class Parts:
    """A room or corridor section under construction, in its local frame (metres, z up)."""

    recipes: Recipes
    low: Point  # opposite corners on the ground
    high: Point
    shared: SurfaceBuilder = field(default_factory=SurfaceBuilder)  # equal in all of its kind
    own: SurfaceBuilder = field(default_factory=SurfaceBuilder)  # individual
    lamps: list[Float64] = field(default_factory=list)
    obstacles: list[Obstacle] = field(default_factory=list)

    def surfaces(self) -> tuple[Surfaces, Bools]:
        """Return all surfaces, and a mask of the individual ones."""
        shared, own = self.shared.build(), self.own.build()
        return shared.joined(own), np.arange(len(shared) + len(own)) >= len(shared)

    def wall(self, start: Point, end: Point, texture: int, trim: int) -> Wall:
        """Return the wall from ``start`` (left, seen from the front) to ``end``."""
        return Wall(self.shared, (start, end), texture, trim, _HEIGHT_M)

    def lamp(self, x: float, y: float) -> None:
        glow, plain = self.recipes.thing("glow", "lamp"), self.recipes.thing("plain", "lamp")
        low = _HEIGHT_M - 0.08
        self.shared.add_box(
            (x, y), (1.2, 0.3, 0.08), 0.0, plain, plain, base=low, bottom=glow, glow=1.0
        )
        self.lamps.append(np.array([x, y, low - 0.1]))

    def floor_and_ceiling(self, kind: str) -> None:
        low, high = self.low, self.high
        size_m = high[0] - low[0], high[1] - low[1]
        along, across = np.array([size_m[0], 0.0, 0.0]), np.array([0.0, size_m[1], 0.0])
        floor = self.recipes.material("asphalt", size_m, kind, "floor")
        ceiling = self.recipes.material("paving", size_m, kind, "ceiling")
        self.shared.add(np.array([low[0], high[1], 0.0]), along, -across, floor)
        self.shared.add(np.array([*low, _HEIGHT_M]), along, across, ceiling, glow=_INDIRECT)

    def poster(
        self, on: Wall, at: Point, *label: str | int, own: bool = True, painter: str = "poster"
    ) -> None:
        """Add a flat object to a wall; ``at`` is its lower left corner."""
        size = _FLAT_M[painter]
        span, height = (at[0], at[0] + size[0]), (at[1], at[1] + size[1])
        texture = self.recipes.thing(painter, *label)
        on = replace(on, builder=self.own if own else self.shared)
        on.block(span, height, 0.03, texture, on.trim)

    def rug(self, at: Point, size: tuple[float, float], *label: str | int) -> None:
        """Add an individual rug on the floor; ``at`` is its centre."""
        corner = np.array([at[0] - 0.5 * size[0], at[1] + 0.5 * size[1], 0.01])
        along, across = np.array([size[0], 0.0, 0.0]), np.array([0.0, size[1], 0.0])
        self.own.add(corner, along, -across, self.recipes.thing("poster", *label))

    def box(self, at: Point, size: tuple[float, float, float], side: int, top: int) -> None:
        """Add furniture that every room of the kind has."""
        self.shared.add_box(at, size, 0.0, side, top)
        self.obstacles.append(Obstacle(*at, 0.5 * max(size[:2])))

    def table(self, at: Point, size: tuple[float, float], wood: int, plain: int) -> None:
        """Add a table top on two solid ends."""
        x, y = at
        for side in (-1, 1):
            spot = (x + side * (0.5 * size[0] - 0.1), y)
            self.shared.add_box(spot, (0.08, size[1] - 0.1, 0.7), 0.0, wood, plain)
            self.obstacles.append(Obstacle(x + side * 0.25 * size[0], y, 0.5 * size[1]))
        self.shared.add_box(at, (*size, 0.05), 0.0, wood, wood, base=0.7, bottom=plain)

    def chair(self, x: float, y: float, cloth: int) -> None:
        """Add a chair that faces the +y direction."""
        self.shared.add_box((x, y), (0.45, 0.45, 0.45), 0.0, cloth, cloth)
        self.shared.add_box((x, y - 0.2), (0.45, 0.06, 0.45), 0.0, cloth, cloth, base=0.45)
        self.obstacles.append(Obstacle(x, y, 0.3))


@dataclass(frozen=True)
class _RoomKind:
    # walls: opposite the door, to its right, of the door and to its left
    materials: tuple[str, str, str, str]
    # left edges, width, lower and upper edge above the floor
    windows: tuple[tuple[float, ...], float, float, float]
    posters: tuple[tuple[Point, ...], ...]  # positions of individual posters on each wall
    cupboard: Point


_KINDS = {
    "office": _RoomKind(
        ("plaster",) * 4,
        ((0.6, 4.0), 1.4, 0.95, 2.25),
        (((2.55, 1.0),), ((0.4, 1.0), (1.7, 0.9)), ((3.05, 1.0),), ((0.5, 0.9), (3.6, 0.9))),
        (4.2, 0.25),
    ),
    "seminar": _RoomKind(
        ("plaster", "brick", "plaster", "stone"),
        ((0.4, 2.45, 4.5), 1.1, 0.9, 2.3),
        (
            ((1.53, 1.0), (3.58, 1.1)),
            ((0.5, 0.9), (3.6, 1.0)),
            ((0.5, 1.0),),
            ((0.3, 1.0), (3.8, 0.9)),
        ),
        (3.0, 0.25),
    ),
}
ROOM_KINDS = tuple(_KINDS)
_ORDER = (0, 3, 1, 2)  # of the walls, for numbering their posters


def build_room(recipes: Recipes, kind: str, owner: str) -> Parts:
    """Build a room, x and y from 0 to ROOM_M; ``owner`` labels its individual objects."""
    parts, built = Parts(recipes, (0.0, 0.0), ROOM_M), _KINDS[kind]
    width, depth = ROOM_M
    parts.floor_and_ceiling(kind)
    corners = ((0.0, depth), (width, depth), (width, 0.0), (0.0, 0.0), (0.0, depth))
    trim = recipes.thing("plain", kind, "trim")
    walls = []
    for number, material in enumerate(built.materials):
        size_m = (depth if number % 2 else width, _HEIGHT_M)
        texture = recipes.material(material, size_m, kind, number)
        walls.append(parts.wall(corners[number], corners[number + 1], texture, trim))
    back, right, front, left = walls
    lefts, across, low, high = built.windows
    glass = recipes.thing("window", kind)
    windows = [Opening(x, x + across, low, high, 0.12, glass) for x in lefts]
    back.storey((0, _HEIGHT_M), windows)
    x = width - _DOOR_X - _DOOR_M[0]
    door = Opening(x, x + _DOOR_M[0], 0.0, _DOOR_M[1], WALL_THICKNESS_M, PASSAGE)
    front.storey((0, _HEIGHT_M), [door])
    for side in (right, left):
        side.storey((0, _HEIGHT_M))
    wood, plain = recipes.thing("wood", kind), recipes.thing("plain", kind)
    if kind == "office":
        screen, cloth = recipes.thing("window", "screen"), recipes.thing("plain", "chair")
        for x in (1.2, 4.7):
            parts.table((x, 4.45), (1.6, 0.8), wood, plain)
            sides = (screen, plain, plain, plain)
            parts.shared.add_box((x, 4.6), (0.56, 0.06, 0.36), 0.0, sides, plain, base=0.8)
            parts.chair(x, 3.7, cloth)
        parts.box((5.8, 1.2), (0.4, 1.4, 1.9), recipes.thing("shutter", "shelf"), plain)
        parts.box((0.25, 2.6), (0.5, 0.9, 1.1), recipes.thing("door", "cabinet"), plain)
        parts.poster(left, (2.25, 1.3), "office", 0, own=False)
        parts.poster(front, (0.3, 0.9), "office", 1, own=False)
    else:
        cloth = recipes.thing("plain", "seminar chair")
        for x in (1.6, 4.7):
            for y in (1.5, 4.2):
                parts.table((x, y), (1.6, 0.6), wood, plain)
                parts.chair(x, y - 0.6, cloth)
        board = recipes.thing("shutter", "board")
        left.block((1.3, 3.5), (0.9, 2.1), 0.05, board, plain)
        parts.poster(right, (2.1, 0.9), "seminar", 0, own=False)
    spots = [(walls[number], at) for number in _ORDER for at in built.posters[number]]
    for number, (on, at) in enumerate(spots):
        parts.poster(on, at, owner, number)
    a, b = recipes.thing("wood", owner, 0), recipes.thing("wood", owner, 1)
    parts.own.add_box(built.cupboard, (0.9, 0.42, 1.1), 0.0, (b, a, a, b), b)
    parts.obstacles.append(Obstacle(*built.cupboard, 0.5))
    parts.rug((0.5 * width, 0.5 * depth), (2.0, 1.4), owner, "rug")
    parts.lamp(0.5 * width, 0.5 * depth)
    return parts


def build_module(recipes: Recipes, owner: str) -> Parts:
    """Build a corridor section: x from 0 to MODULE_M, y from -CORRIDOR_M / 2 to CORRIDOR_M / 2.

    A rotation by 180 degrees exchanges its sides, each with the door of a room and a closed door.
    """
    half = CORRIDOR_M / 2
    parts = Parts(recipes, (0.0, -half), (MODULE_M, half))
    parts.floor_and_ceiling("corridor")
    parts.lamp(0.5 * MODULE_M, 0.0)
    trim = recipes.thing("plain", "corridor")
    texture = recipes.material("plaster", (MODULE_M, _HEIGHT_M), "corridor", "wall")
    door = recipes.thing("door", "corridor")
    to_room = 0.5 * (MODULE_M - ROOM_M[0]) + _DOOR_X
    door_x = to_room + 0.5 * _DOOR_M[0]
    sides = (
        ((0.0, half), (MODULE_M, half), (door_x, half - 0.4)),
        ((MODULE_M, -half), (0.0, -half), (MODULE_M - door_x, 0.4 - half)),
    )
    for number, (start, end, mat) in enumerate(sides):
        side = parts.wall(start, end, texture, trim)
        passage = Opening(to_room, to_room + _DOOR_M[0], 0.0, _DOOR_M[1], 0.0, PASSAGE)
        closed = Opening(4.3, 5.2, 0.0, _DOOR_M[1], 0.08, door)
        side.storey((0, _HEIGHT_M), [passage, closed])
        parts.poster(side, (5.9, 0.9), "corridor", own=False)
        parts.rug(mat, (0.9, 0.6), owner, number, "mat")
        for x in (0.2, 3.2):
            parts.poster(side, (x, 0.9), owner, number, str(x))
        for x in (2.35, 5.3):
            parts.poster(side, (x, 1.6), owner, number, str(x), painter="sign")
    # a sign that hangs across the corridor, visible from its ends
    a, b = recipes.thing("sign", owner, "hanging", 0), recipes.thing("sign", owner, "hanging", 1)
    spot, size_m = (0.25 * MODULE_M, 0.0), (0.06, 0.9, 0.3)
    parts.own.add_box(spot, size_m, 0.0, (trim, a, trim, b), trim, base=2.3, bottom=trim)
    return parts


def _build_end(recipes: Recipes, owner: str) -> Parts:
    """Return the wall at an end of the corridor, at x = 0, seen along +x."""
    half = CORRIDOR_M / 2
    parts = Parts(recipes, (0.0, -half), (0.0, half))
    texture = recipes.material("plaster", (CORRIDOR_M, _HEIGHT_M), "corridor", "end")
    end = parts.wall((0.0, half), (0.0, -half), texture, recipes.thing("plain", "corridor"))
    window = Opening(0.2, 1.1, 0.9, 2.3, 0.12, recipes.thing("window", "corridor"))
    end.storey((0, _HEIGHT_M), [window])
    parts.poster(end, (1.35, 0.9), owner)
    return parts


@dataclass(frozen=True, eq=False)
class Zone:
    """A room or corridor section of a floor."""

    name: str  # unique on its floor
    kind: str  # kind of the room, or ``corridor``
    plan: FloorPlan  # free ground, in the place's frame
    place_from_zone: RigidTransform  # zones of a kind are alike in their own frames
    scan_from_place: RigidTransform  # of the scanner in the zone's middle


@dataclass(frozen=True, eq=False)
class Floor:
    """A floor, rendered as a place whose world frame is the floor's official frame."""

    place: Place
    zones: tuple[Zone, ...]  # rooms first, then corridor sections
    own: Bools  # (N,), surfaces of individual objects of a zone
    glass: Bools  # (N,), surfaces that return no laser beam


def floor_place(modules: int, options: SyntheticWorldOptions, index: int) -> Place:
    """Return a floor with ``modules`` corridor sections for :func:`render.render_frames`."""
    return build_floor(options.seed, index, modules).place


@lru_cache(maxsize=4)
def build_floor(seed: int, index: int, modules: int) -> Floor:
    """Return floor ``index`` of a building; results are cached."""
    recipes = Recipes(seed, list(moving_object_recipes(seed)))
    placed: list[tuple[Parts, RigidTransform]] = []
    rooms: list[Zone] = []
    corridor: list[Zone] = []
    along, aside = 0.5 * (MODULE_M - ROOM_M[0]), 0.5 * CORRIDOR_M + WALL_THICKNESS_M
    for module in range(modules):
        name = f"module{module}"
        at = _placed(MODULE_M * (module - 0.5 * modules), 0.0, turned=False)
        placed.append((build_module(recipes, f"floor{index}/{name}"), at))
        corridor.append(_zone(seed, index, name, "corridor", *placed[-1]))
        for turned, kind in zip((False, True), ROOM_KINDS, strict=True):
            name = f"{kind}{module}"
            # to the left of the corridor's direction, or rotated and on the right
            x, y = (MODULE_M - along, -aside) if turned else (along, aside)
            pose = at @ _placed(x, y, turned=turned)
            placed.append((build_room(recipes, kind, f"floor{index}/{name}"), pose))
            rooms.append(_zone(seed, index, name, kind, *placed[-1]))
    for turned in (False, True):
        pose = _placed((-0.5 if turned else 0.5) * MODULE_M * modules, 0.0, turned=turned)
        placed.append((_build_end(recipes, f"floor{index}/end{turned:d}"), pose))
    surfaces, own = SurfaceBuilder().build(), np.zeros(0, bool)
    lamps: list[Float64] = []
    for parts, pose in placed:  # place_from_part
        new, new_own = parts.surfaces()
        moved = new.moved(pose.rotation_matrix(), np.array(pose.translation))
        surfaces, own = surfaces.joined(moved), np.concatenate([own, new_own])
        lamps += [pose.apply(lamp[None])[0] for lamp in parts.lamps]
    rng = stream(seed, "indoor", "frame", index)
    translation = np.array([*rng.uniform(-6, 6, 2), rng.uniform(-0.5, 0.5)])  # floors overlap
    official_from_place = settled_pose(about_z(rng.uniform(-np.pi, np.pi)), translation)
    zones = (*sorted(rooms, key=lambda zone: (zone.kind, zone.name)), *corridor)
    place = Place(
        index=index,
        recipes=tuple(recipes.items),
        surfaces=surfaces,
        lamps=np.array(lamps),
        plan=zones[-1].plan,
        place_from_world=official_from_place.inverse(),
    )
    painters = np.array([recipe.painter for recipe in recipes.items])
    return Floor(place, zones, own, painters[surfaces.texture] == _GLASS)


def _placed(x: float, y: float, *, turned: bool) -> RigidTransform:
    sign = -1.0 if turned else 1.0
    return settled_pose(np.diag([sign, sign, 1.0]), np.array([x, y, 0.0]))


def _zone(
    seed: int, index: int, name: str, kind: str, parts: Parts, place_from_part: RigidTransform
) -> Zone:
    (x0, y0), (x1, y1) = parts.low, parts.high
    corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    outline = place_from_part.apply(np.column_stack([corners, np.zeros(4)]))[:, :2]
    obstacles = []
    for obstacle in parts.obstacles:
        x, y, _ = place_from_part.apply(np.array([[obstacle.x, obstacle.y, 0.0]]))[0].tolist()
        obstacles.append(Obstacle(x, y, obstacle.radius))
    plan = FloorPlan(outline, outline, tuple(obstacles))
    rng = stream(seed, "indoor", "scan", index, name)
    shift = rng.uniform(-_SCAN_SHIFT_M, _SCAN_SHIFT_M, 2)
    spot = np.array([*(outline.mean(axis=0) + shift), _SCAN_HEIGHT_M])
    spot[2] += rng.normal(0, 0.03)
    turn = about_z(rng.uniform(-np.pi, np.pi))
    lean_x, lean_y = (float(a) / 2 for a in (rng.normal(0, _SCAN_TILT), rng.normal(0, _SCAN_TILT)))
    about_x = RigidTransform((float(np.cos(lean_x)), float(np.sin(lean_x)), 0.0, 0.0), (0, 0, 0))
    about_y = RigidTransform((float(np.cos(lean_y)), 0.0, float(np.sin(lean_y)), 0.0), (0, 0, 0))
    rotation = product((about_x @ about_y).rotation_matrix(), turn)
    return Zone(name, kind, plan, place_from_part, settled_pose(rotation, spot).inverse())
