"""Rooms of two kinds, and pieces of corridor: those of a kind are alike but for a few things.

A room has its door in the wall y = 0 and its windows opposite. Only posters, a rug, a cupboard and
the sign at its door are a room's own; all else, dirt included, every room of its kind has, on
every floor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from megloc_twins.facades import PASSAGE, Opening, Wall
from megloc_twins.moving_objects import Obstacle
from megloc_twins.options import stream
from megloc_twins.surfaces import SurfaceBuilder, Surfaces
from megloc_twins.textures import TextureRecipe

HEIGHT_M = 2.8
WALL_THICKNESS_M = 0.15
DOOR_M = (1.0, 2.1)  # width, height
TEXELS_PER_M = 100
GLASS = "window"  # a laser gets nothing back from what this painter paints

_DIRT = 0.8  # of walls, floors and ceilings; rooms of a kind have it in common
_INDIRECT = 0.12  # of the lamps' glow, what a ceiling receives from below
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

Vector = NDArray[np.float64]

ROOM_M = (6.0, 5.0)  # along the corridor, away from it
MODULE_M = 7.0  # of corridor, with one room on each side
CORRIDOR_M = 2.4
_DOOR_X = 0.7  # of a room's door
_POSTER_M = (0.9, 1.26)
_RUG_M = (2.0, 1.4)


@dataclass
class Recipes:
    """The textures of a floor.

    Parameters
    ----------
    seed : of the world; what is shared looks the same wherever the label is the same.
    items : the recipes so far; surfaces count in them.
    """

    seed: int
    items: list[TextureRecipe] = field(default_factory=list)

    def thing(self, painter: str, *label: str | int) -> int:
        """A texture of a kind, the same for the same label."""
        width, height = _SIZES[painter]
        number = int(stream(self.seed, "indoor", painter, *label).integers(2**31))
        return self._index(TextureRecipe(painter, width, height, number))

    def material(self, kind: str, size_m: tuple[float, float], *label: str | int) -> int:
        """A wall's, floor's or ceiling's texture, the same for the same label and size."""
        width, height = (max(8, int(round(side * TEXELS_PER_M))) for side in size_m)
        number = int(stream(self.seed, "indoor", kind, *label).integers(2**31))
        params: dict[str, str | float] = {
            "material": kind,
            "material_seed": int(stream(self.seed, "indoor", label[0]).integers(2**31)),
            "dirt": _DIRT,
        }
        return self._index(TextureRecipe("wall", width, height, number, tuple(params.items())))

    def _index(self, recipe: TextureRecipe) -> int:
        if recipe not in self.items:
            self.items.append(recipe)
        return self.items.index(recipe)


@dataclass
class Parts:
    """A room or a piece of corridor while it is built, in a frame of its own (metres, z up).

    Parameters
    ----------
    shared : what every one of its kind has.
    own : what only this one has.
    lamps : (x, y, z) of each.
    obstacles : what stands in it.
    """

    shared: SurfaceBuilder = field(default_factory=SurfaceBuilder)
    own: SurfaceBuilder = field(default_factory=SurfaceBuilder)
    lamps: list[Vector] = field(default_factory=list)
    obstacles: list[Obstacle] = field(default_factory=list)

    def surfaces(self) -> tuple[Surfaces, NDArray[np.bool_]]:
        """All of it, and which of the surfaces are its own."""
        shared, own = self.shared.build(), self.own.build()
        return shared.joined(own), np.arange(len(shared) + len(own)) >= len(shared)

    def lamp(self, recipes: Recipes, x: float, y: float, size: tuple[float, float]) -> None:
        """A lamp under the ceiling, ``size`` along x and y."""
        glow, plain = recipes.thing("glow", "lamp"), recipes.thing("plain", "lamp")
        low = HEIGHT_M - 0.08
        self.shared.add_box(
            (x, y), (*size, 0.08), 0.0, (plain,) * 4, plain, base=low, bottom=glow, glow=1.0
        )
        self.lamps.append(np.array([x, y, low - 0.1]))

    def floor_and_ceiling(
        self, low: tuple[float, float], high: tuple[float, float], floor: int, ceiling: int
    ) -> None:
        """Add floor and ceiling between two corners."""
        width, depth = high[0] - low[0], high[1] - low[1]
        along, across = np.array([width, 0.0, 0.0]), np.array([0.0, depth, 0.0])
        self.shared.add(np.array([low[0], high[1], 0.0]), along, -across, floor)
        corner = np.array([*low, HEIGHT_M])
        self.shared.add(corner, along, across, ceiling, glow=_INDIRECT)


def wall(start: tuple[float, float], end: tuple[float, float], texture: int, trim: int) -> Wall:
    """The wall whose foot runs from ``start`` to ``end``, to the right of who looks at it."""
    return Wall.between(np.array(start), np.array(end), texture, trim, HEIGHT_M)


def poster(
    builder: SurfaceBuilder,
    on: Wall,
    at: tuple[float, float],
    size: tuple[float, float],
    texture: int,
) -> None:
    """Something flat on a wall: ``at`` its lower left corner, along the wall and above ground."""
    span = (at[0], at[0] + size[0])
    on.block(builder, span, (at[1], at[1] + size[1]), 0.03, front=texture, other=on.trim)


RoomBuilder = Callable[[Parts, Recipes, str], None]


def build_room(recipes: Recipes, kind: str, owner: str) -> Parts:
    """A room of a kind in its own frame: x and y from 0 to ROOM_M; ``owner`` names what is its."""
    parts = Parts()
    width, depth = ROOM_M
    floor = recipes.material("asphalt", ROOM_M, kind, "floor")
    ceiling = recipes.material("paving", ROOM_M, kind, "ceiling")
    parts.floor_and_ceiling((0.0, 0.0), (width, depth), floor, ceiling)
    _BUILDERS[kind](parts, recipes, owner)
    parts.lamp(recipes, 0.5 * width, 0.5 * depth, (1.2, 0.3))
    return parts


def _office(parts: Parts, recipes: Recipes, owner: str) -> None:
    back, right, front, left = _walls(recipes, "office", ("plaster",) * 4)
    shared = parts.shared
    glass = recipes.thing("window", "office")
    back.storey(
        shared, (0, HEIGHT_M), [Opening(x, x + 1.4, 0.95, 2.25, 0.12, glass) for x in (0.6, 4.0)]
    )
    _front_wall(parts, front)
    for side in (right, left):
        side.storey(shared, (0, HEIGHT_M), [])
    wood, plain = recipes.thing("wood", "office"), recipes.thing("plain", "office")
    screen, cloth = recipes.thing("window", "screen"), recipes.thing("plain", "chair")
    for x in (1.2, 4.7):
        _table(parts, (x, 4.45), (1.6, 0.8), wood, plain)
        shared.add_box((x, 4.6), (0.56, 0.06, 0.36), 0.0, (screen, *(plain,) * 3), plain, base=0.8)
        _chair(parts, (x, 3.7), cloth)
    shelf = recipes.thing("shutter", "shelf")
    _box(parts, (5.8, 1.2), (0.4, 1.4, 1.9), shelf, plain)
    _box(parts, (0.25, 2.6), (0.5, 0.9, 1.1), recipes.thing("door", "cabinet"), plain)
    poster(shared, left, (2.25, 1.3), _POSTER_M, recipes.thing("poster", "office", 0))
    poster(shared, front, (0.3, 0.9), _POSTER_M, recipes.thing("poster", "office", 1))
    spots = (
        (back, (2.55, 1.0)),
        (left, (0.5, 0.9)),
        (left, (3.6, 0.9)),
        (right, (0.4, 1.0)),
        (right, (1.7, 0.9)),
        (front, (3.05, 1.0)),
    )
    _own_posters(parts, recipes, owner, spots)
    _own_furniture(parts, recipes, owner, (4.2, 0.25))


def _seminar(parts: Parts, recipes: Recipes, owner: str) -> None:
    back, right, front, left = _walls(recipes, "seminar", ("plaster", "brick", "plaster", "stone"))
    shared = parts.shared
    glass = recipes.thing("window", "seminar")
    back.storey(
        shared,
        (0, HEIGHT_M),
        [Opening(x, x + 1.1, 0.9, 2.3, 0.12, glass) for x in (0.4, 2.45, 4.5)],
    )
    _front_wall(parts, front)
    for side in (right, left):
        side.storey(shared, (0, HEIGHT_M), [])
    wood, plain = recipes.thing("wood", "seminar"), recipes.thing("plain", "seminar")
    cloth = recipes.thing("plain", "seminar chair")
    for x in (1.6, 4.7):
        for y in (1.5, 4.2):
            _table(parts, (x, y), (1.6, 0.6), wood, plain)
            _chair(parts, (x, y - 0.6), cloth)
    board = recipes.thing("shutter", "board")
    left.block(shared, (1.3, 3.5), (0.9, 2.1), 0.05, front=board, other=plain)
    poster(shared, right, (2.1, 0.9), _POSTER_M, recipes.thing("poster", "seminar", 0))
    spots = (
        (back, (1.53, 1.0)),
        (back, (3.58, 1.1)),
        (left, (0.3, 1.0)),
        (left, (3.8, 0.9)),
        (right, (0.5, 0.9)),
        (right, (3.6, 1.0)),
        (front, (0.5, 1.0)),
    )
    _own_posters(parts, recipes, owner, spots)
    _own_furniture(parts, recipes, owner, (3.0, 0.25))


_BUILDERS: dict[str, RoomBuilder] = {"office": _office, "seminar": _seminar}
ROOM_KINDS = tuple(_BUILDERS)


def build_module(recipes: Recipes, owner: str) -> Parts:
    """A piece of corridor: x from 0 to MODULE_M, y from -CORRIDOR_M / 2 on.

    Both its sides are alike, one the other turned by half a turn. Each has the door of a room and
    one that is closed.
    """
    parts, half = Parts(), CORRIDOR_M / 2
    floor = recipes.material("asphalt", (MODULE_M, CORRIDOR_M), "corridor", "floor")
    ceiling = recipes.material("paving", (MODULE_M, CORRIDOR_M), "corridor", "ceiling")
    parts.floor_and_ceiling((0.0, -half), (MODULE_M, half), floor, ceiling)
    parts.lamp(recipes, 0.5 * MODULE_M, 0.0, (1.2, 0.3))
    trim = recipes.thing("plain", "corridor")
    texture = recipes.material("plaster", (MODULE_M, HEIGHT_M), "corridor", "wall")
    door = recipes.thing("door", "corridor")
    to_room = 0.5 * (MODULE_M - ROOM_M[0]) + _DOOR_X
    for number, side in enumerate(
        (
            wall((0.0, half), (MODULE_M, half), texture, trim),
            wall((MODULE_M, -half), (0.0, -half), texture, trim),
        )
    ):
        passage = Opening(to_room, to_room + DOOR_M[0], 0.0, DOOR_M[1], 0.0, PASSAGE)
        closed = Opening(4.3, 5.2, 0.0, DOOR_M[1], 0.08, door)
        side.storey(parts.shared, (0, HEIGHT_M), [passage, closed])
        poster(parts.shared, side, (5.9, 0.9), _POSTER_M, recipes.thing("poster", "corridor"))
        mat = recipes.thing("poster", owner, number, "mat")
        door_x = to_room + 0.5 * DOOR_M[0]
        at = (door_x, half - 0.4) if number == 0 else (MODULE_M - door_x, 0.4 - half)
        _rug(parts, at, (0.9, 0.6), mat)
        for x, size, painter in (
            (0.2, _POSTER_M, "poster"),
            (3.2, _POSTER_M, "poster"),
            (2.35, (0.5, 0.17), "sign"),
            (5.3, (0.5, 0.17), "sign"),
        ):
            texture_of_own = recipes.thing(painter, owner, number, str(x))
            height = 0.9 if painter == "poster" else 1.6
            poster(parts.own, side, (x, height), size, texture_of_own)
    # a sign that hangs across the corridor, to be seen from its ends
    faces = tuple(recipes.thing("sign", owner, "hanging", end) for end in range(2))
    size_m = (0.06, 0.9, 0.3)
    spot = (0.25 * MODULE_M, 0.0)
    parts.own.add_box(
        spot, size_m, 0.0, (trim, faces[0], trim, faces[1]), trim, base=2.3, bottom=trim
    )
    return parts


def build_end(recipes: Recipes, owner: str) -> Parts:
    """The wall at an end of the corridor, seen by who looks along +x; at x = 0."""
    parts, half = Parts(), CORRIDOR_M / 2
    texture = recipes.material("plaster", (CORRIDOR_M, HEIGHT_M), "corridor", "end")
    end = wall((0.0, half), (0.0, -half), texture, recipes.thing("plain", "corridor"))
    glass = recipes.thing("window", "corridor")
    end.storey(parts.shared, (0, HEIGHT_M), [Opening(0.2, 1.1, 0.9, 2.3, 0.12, glass)])
    poster(parts.own, end, (1.35, 0.9), _POSTER_M, recipes.thing("poster", owner))
    return parts


def _walls(
    recipes: Recipes, kind: str, materials: tuple[str, str, str, str]
) -> tuple[Wall, Wall, Wall, Wall]:
    """The walls opposite the door, to its right, of the door, to its left; seen from inside."""
    width, depth = ROOM_M
    feet = (
        ((0.0, depth), (width, depth)),
        ((width, depth), (width, 0.0)),
        ((width, 0.0), (0.0, 0.0)),
        ((0.0, 0.0), (0.0, depth)),
    )
    trim = recipes.thing("plain", kind, "trim")
    found = []
    for number, ((start, end), material) in enumerate(zip(feet, materials, strict=True)):
        length = abs(end[0] - start[0]) + abs(end[1] - start[1])
        texture = recipes.material(material, (length, HEIGHT_M), kind, number)
        found.append(wall(start, end, texture, trim))
    back, right, front, left = found
    return back, right, front, left


def _front_wall(parts: Parts, front: Wall) -> None:
    x = ROOM_M[0] - _DOOR_X - DOOR_M[0]
    door = Opening(x, x + DOOR_M[0], 0.0, DOOR_M[1], WALL_THICKNESS_M, PASSAGE)
    front.storey(parts.shared, (0, HEIGHT_M), [door])


def _own_posters(
    parts: Parts, recipes: Recipes, owner: str, spots: tuple[tuple[Wall, tuple[float, float]], ...]
) -> None:
    for number, (on, at) in enumerate(spots):
        poster(parts.own, on, at, _POSTER_M, recipes.thing("poster", owner, number))


def _own_furniture(parts: Parts, recipes: Recipes, owner: str, at: tuple[float, float]) -> None:
    """A cupboard at ``at``, and a rug in the middle."""
    sides = tuple(recipes.thing("wood", owner, side) for side in range(2))
    faces = (sides[1], sides[0], sides[0], sides[1])
    parts.own.add_box(at, (0.9, 0.42, 1.1), 0.0, faces, sides[1])
    parts.obstacles.append(Obstacle(*at, 0.5))
    _rug(parts, (0.5 * ROOM_M[0], 0.5 * ROOM_M[1]), _RUG_M, recipes.thing("poster", owner, "rug"))


def _rug(parts: Parts, at: tuple[float, float], size: tuple[float, float], texture: int) -> None:
    """Add a thing that lies on the ground, ``at`` its middle."""
    corner = np.array([at[0] - 0.5 * size[0], at[1] + 0.5 * size[1], 0.01])
    along, across = np.array([size[0], 0.0, 0.0]), np.array([0.0, size[1], 0.0])
    parts.own.add(corner, along, -across, texture)


def _table(
    parts: Parts, at: tuple[float, float], size: tuple[float, float], wood: int, plain: int
) -> None:
    """A table top on two solid ends."""
    for side in (-1, 1):
        spot = (at[0] + side * (0.5 * size[0] - 0.1), at[1])
        parts.shared.add_box(spot, (0.08, size[1] - 0.1, 0.7), 0.0, (wood,) * 4, plain)
    top = (*size, 0.05)
    parts.shared.add_box(at, top, 0.0, (wood,) * 4, wood, base=0.7, bottom=plain)
    parts.obstacles += [
        Obstacle(at[0] + side * 0.25 * size[0], at[1], 0.5 * size[1]) for side in (-1, 1)
    ]


def _chair(parts: Parts, at: tuple[float, float], cloth: int) -> None:
    parts.shared.add_box(at, (0.45, 0.45, 0.45), 0.0, (cloth,) * 4, cloth)
    back = (at[0], at[1] - 0.2)
    parts.shared.add_box(back, (0.45, 0.06, 0.45), 0.0, (cloth,) * 4, cloth, base=0.45)
    parts.obstacles.append(Obstacle(*at, 0.3))


def _box(
    parts: Parts, at: tuple[float, float], size: tuple[float, float, float], side: int, top: int
) -> None:
    parts.shared.add_box(at, size, 0.0, (side,) * 4, top)
    parts.obstacles.append(Obstacle(*at, 0.5 * max(size[:2])))
