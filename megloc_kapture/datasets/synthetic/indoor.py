"""What rooms and corridors are built of: their textures, walls with passages, floor and ceiling."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.facades import Opening, Wall
from megloc_kapture.datasets.synthetic.floor_plans import Obstacle
from megloc_kapture.datasets.synthetic.options import stream
from megloc_kapture.datasets.synthetic.surfaces import SurfaceBuilder, Surfaces
from megloc_kapture.datasets.synthetic.textures import TextureRecipe

HEIGHT_M = 2.8
WALL_THICKNESS_M = 0.15
DOOR_M = (1.0, 2.1)  # width, height
TEXELS_PER_M = 100
GLASS = "window"  # a laser gets nothing back from what this painter paints
PASSAGE = -1  # the texture of an opening one can go through

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


@dataclass(frozen=True, eq=False)
class IndoorWall(Wall):
    """A wall as high as the room, with openings one can go through."""

    def rectangle(
        self,
        builder: SurfaceBuilder,
        x: tuple[float, float],
        y: tuple[float, float],
        texture: int,
        *,
        out: float = 0.0,
        glow: float = 0.0,
    ) -> None:
        """A rectangle parallel to the wall, ``out`` metres in front of it."""
        uv = (0.0, 0.0, 1.0, 1.0)
        if texture == self.texture:
            uv = (
                x[0] / self.length,
                1 - y[1] / HEIGHT_M,
                x[1] / self.length,
                1 - y[0] / HEIGHT_M,
            )
        edge_v = np.array([0.0, 0.0, y[0] - y[1]])
        edge_u = (x[1] - x[0]) * self.right
        builder.add(self.point(x[0], y[1], out), edge_u, edge_v, texture, uv=uv, glow=glow)

    def opening(self, builder: SurfaceBuilder, hole: Opening) -> None:
        """An opening; through a passage one looks, and its reveals belong to one of its sides."""
        if hole.texture != PASSAGE:
            super().opening(builder, hole)
        elif hole.recess:
            up, into = np.array([0.0, 0.0, 1.0]), -hole.recess * self.inward
            across, rise = (hole.x1 - hole.x0) * self.right, (hole.y1 - hole.y0) * up
            for corner, edge_u, edge_v in (
                (self.point(hole.x0, hole.y1), into, -rise),
                (self.point(hole.x1, hole.y1, -hole.recess), -into, -rise),
                (self.point(hole.x0, hole.y1), across, into),
                (self.point(hole.x0, hole.y0, -hole.recess), across, -into),
            ):
                builder.add(corner, edge_u, edge_v, self.trim)


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
        """What one stands on, and what is above, between two corners."""
        width, depth = high[0] - low[0], high[1] - low[1]
        along, across = np.array([width, 0.0, 0.0]), np.array([0.0, depth, 0.0])
        self.shared.add(np.array([low[0], high[1], 0.0]), along, -across, floor)
        corner = np.array([*low, HEIGHT_M])
        self.shared.add(corner, along, across, ceiling, glow=_INDIRECT)


def wall(
    start: tuple[float, float], end: tuple[float, float], texture: int, trim: int
) -> IndoorWall:
    """The wall whose foot runs from ``start`` to ``end``, to the right of who looks at it."""
    along = np.array([end[0] - start[0], end[1] - start[1], 0.0])
    length = float(np.hypot(along[0], along[1]))
    right = along / length
    inward = np.array([right[1], -right[0], 0.0])
    return IndoorWall(np.array([*start, 0.0]), right, inward, length, texture, trim)


def poster(
    builder: SurfaceBuilder,
    on: IndoorWall,
    at: tuple[float, float],
    size: tuple[float, float],
    texture: int,
) -> None:
    """Something flat on a wall: ``at`` its lower left corner, along the wall and above ground."""
    span = (at[0], at[0] + size[0])
    on.block(builder, span, (at[1], at[1] + size[1]), 0.03, front=texture, other=on.trim)
