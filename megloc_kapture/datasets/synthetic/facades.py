"""House fronts: walls with recessed windows and doors, and things that stick out of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.surfaces import SurfaceBuilder

GROUND_STOREY_M = 3.3
UPPER_STOREY_M = 2.9
CORNICE_M = 0.35
WALL_HEIGHT_M = GROUND_STOREY_M + UPPER_STOREY_M + CORNICE_M

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Opening:
    """A window or door in a wall: x0, x1 along the wall, y0, y1 above the ground, metres."""

    x0: float
    x1: float
    y0: float
    y1: float
    recess: float
    texture: int
    glow: float = 0.0


@dataclass(frozen=True, eq=False)
class Wall:
    """A wall's frame: seen from inside the place it begins at ``start`` and runs to the right.

    Parameters
    ----------
    start : float64 (3,), foot of its left end, metres.
    right, inward : float64 (3,) unit vectors; ``inward`` points to the viewer.
    length : metres.
    texture : of the wall itself, stretched over its length and WALL_HEIGHT_M.
    trim : texture of ledges, reveals and pilasters.
    """

    start: Vector
    right: Vector
    inward: Vector
    length: float
    texture: int
    trim: int

    def point(self, x: float, y: float, out: float = 0.0) -> Vector:
        """World position of ``x`` along, ``y`` up, ``out`` of the wall, metres."""
        return self.start + x * self.right + out * self.inward + np.array([0.0, 0.0, y])

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
        if texture == self.texture:
            uv = (
                x[0] / self.length,
                1 - y[1] / WALL_HEIGHT_M,
                x[1] / self.length,
                1 - y[0] / WALL_HEIGHT_M,
            )
        else:
            uv = (0.0, 0.0, 1.0, 1.0)
        edge_u = (x[1] - x[0]) * self.right
        edge_v = np.array([0.0, 0.0, y[0] - y[1]])
        builder.add(self.point(x[0], y[1], out), edge_u, edge_v, texture, uv=uv, glow=glow)

    def block(
        self,
        builder: SurfaceBuilder,
        x: tuple[float, float],
        y: tuple[float, float],
        depth: float,
        *,
        front: int,
        other: int,
        glow: float = 0.0,
    ) -> None:
        """A box on the wall, ``depth`` metres thick."""
        width, height = x[1] - x[0], y[1] - y[0]
        out, up = self.inward, np.array([0.0, 0.0, 1.0])
        self.rectangle(builder, x, y, front, out=depth, glow=glow)
        builder.add(self.point(x[0], y[1]), depth * out, -height * up, other, glow=glow)
        builder.add(self.point(x[1], y[1], depth), -depth * out, -height * up, other, glow=glow)
        builder.add(self.point(x[0], y[1]), width * self.right, depth * out, other, glow=glow)
        builder.add(
            self.point(x[0], y[0], depth), width * self.right, -depth * out, other, glow=glow
        )

    def opening(self, builder: SurfaceBuilder, hole: Opening) -> None:
        """What is seen in an opening: the window or door at its back, and the reveals."""
        x, y = (hole.x0, hole.x1), (hole.y0, hole.y1)
        width, height, depth = hole.x1 - hole.x0, hole.y1 - hole.y0, hole.recess
        into, up = -self.inward, np.array([0.0, 0.0, 1.0])
        self.rectangle(builder, x, y, hole.texture, out=-depth, glow=hole.glow)
        trim = self.trim
        builder.add(self.point(hole.x0, hole.y1), depth * into, -height * up, trim)
        builder.add(self.point(hole.x1, hole.y1, -depth), -depth * into, -height * up, trim)
        builder.add(self.point(hole.x0, hole.y1), width * self.right, depth * into, trim)
        builder.add(self.point(hole.x0, hole.y0, -depth), width * self.right, -depth * into, trim)

    def storey(
        self, builder: SurfaceBuilder, y: tuple[float, float], openings: list[Opening]
    ) -> None:
        """The wall between two heights, with openings that do not overlap."""
        x = 0.0
        for hole in sorted(openings, key=lambda o: o.x0):
            if hole.x0 > x:
                self.rectangle(builder, (x, hole.x0), y, self.texture)
            if hole.y0 > y[0]:
                self.rectangle(builder, (hole.x0, hole.x1), (y[0], hole.y0), self.texture)
            if hole.y1 < y[1]:
                self.rectangle(builder, (hole.x0, hole.x1), (hole.y1, y[1]), self.texture)
            self.opening(builder, hole)
            x = hole.x1
        if x < self.length:
            self.rectangle(builder, (x, self.length), y, self.texture)


TexturePicker = Callable[[str], int]


def build_facade(
    builder: SurfaceBuilder,
    wall: Wall,
    rng: np.random.Generator,
    pick: TexturePicker,
) -> list[Vector]:
    """Furnish a wall; ``pick`` gives a texture of a kind (window, door, poster ...).

    Returns the positions of its lamps, float64 (3,) each, metres.
    """
    num_bays = max(1, int(round(wall.length / rng.uniform(2.3, 3.0))))
    edges = np.linspace(0, wall.length, num_bays + 1)
    ground, upper = [], []
    uniform_window = pick("window")
    for left, right in zip(edges[:-1], edges[1:], strict=True):
        kind = str(rng.choice(["window", "door", "shutter", "posters"], p=[0.3, 0.2, 0.15, 0.35]))
        middle, width = (left + right) / 2, right - left
        if kind == "posters":
            _posters(builder, wall, rng, pick, (left + 0.25, right - 0.25))
        else:
            half = min({"window": 0.65, "door": 0.55, "shutter": 1.0}[kind], width / 2 - 0.2)
            y0, y1 = {"window": (0.95, 2.45), "door": (0.0, 2.25), "shutter": (0.0, 2.5)}[kind]
            shift = rng.uniform(-0.2, 0.2)
            hole = Opening(
                middle + shift - half,
                middle + shift + half,
                y0,
                y1,
                rng.uniform(0.15, 0.35),
                pick(kind),
                0.25 * float(rng.random() < 0.2),
            )
            ground.append(hole)
            if kind == "window":
                _ledge(builder, wall, hole)
            if rng.random() < 0.5:
                _sign(builder, wall, rng, pick, (left, right), 2.62)
        if rng.random() < 0.85:
            half = min(0.6, width / 2 - 0.25)
            window = uniform_window if rng.random() < 0.6 else pick("window")
            hole = Opening(
                middle - half,
                middle + half,
                GROUND_STOREY_M + 0.75,
                GROUND_STOREY_M + 2.3,
                0.22,
                window,
                0.6 * float(rng.random() < 0.25),
            )
            upper.append(hole)
            if rng.random() < 0.3:
                _balcony(builder, wall, hole, pick)
            else:
                _ledge(builder, wall, hole)
    wall.storey(builder, (0.0, GROUND_STOREY_M), ground)
    wall.storey(builder, (GROUND_STOREY_M, GROUND_STOREY_M + UPPER_STOREY_M), upper)
    top = (GROUND_STOREY_M + UPPER_STOREY_M, WALL_HEIGHT_M)
    wall.block(builder, (0.0, wall.length), top, 0.25, front=wall.trim, other=wall.trim)
    lamps = []
    for edge in edges[1:-1]:
        draw = rng.random()
        if draw < 0.35:  # pilaster
            span = (float(edge) - 0.18, float(edge) + 0.18)
            high = GROUND_STOREY_M + UPPER_STOREY_M
            wall.block(builder, span, (0.0, high), 0.16, front=wall.texture, other=wall.trim)
        elif draw < 0.5:  # drain pipe
            span = (float(edge) - 0.05, float(edge) + 0.05)
            pipe = pick("plain")
            wall.block(builder, span, (0.0, top[0]), 0.1, front=pipe, other=pipe)
    for x in np.arange(rng.uniform(1.5, 3.5), wall.length - 1, rng.uniform(4.5, 7.0)):
        glow = pick("glow")
        span = (float(x) - 0.13, float(x) + 0.13)
        wall.block(builder, span, (2.95, 3.25), 0.24, front=glow, other=glow, glow=4.0)
        lamps.append(wall.point(float(x), 3.1, 0.45))
    return lamps


def _ledge(builder: SurfaceBuilder, wall: Wall, hole: Opening) -> None:
    span = (hole.x0 - 0.1, hole.x1 + 0.1)
    height = (hole.y0 - 0.1, hole.y0)
    wall.block(builder, span, height, 0.14, front=wall.trim, other=wall.trim)


def _balcony(builder: SurfaceBuilder, wall: Wall, hole: Opening, pick: TexturePicker) -> None:
    span = (max(0.0, hole.x0 - 0.25), min(wall.length, hole.x1 + 0.25))
    height = (hole.y0 - 0.55, hole.y0 + 0.2)
    wall.block(builder, span, height, 0.6, front=pick("wood"), other=pick("plain"))


def _sign(
    builder: SurfaceBuilder,
    wall: Wall,
    rng: np.random.Generator,
    pick: TexturePicker,
    bay: tuple[float, float],
    height: float,
) -> None:
    half = min(0.95, (bay[1] - bay[0]) / 2 - 0.1)
    middle = (bay[0] + bay[1]) / 2
    span = (middle - half, middle + half)
    depth = rng.uniform(0.06, 0.2)
    trim = wall.trim
    wall.block(builder, span, (height, height + 0.5), depth, front=pick("sign"), other=trim)


def _posters(
    builder: SurfaceBuilder,
    wall: Wall,
    rng: np.random.Generator,
    pick: TexturePicker,
    span: tuple[float, float],
) -> None:
    x = span[0]
    while x + 0.7 <= span[1]:
        width = float(rng.choice([0.7, 0.9]))
        if x + width > span[1]:
            width = 0.7
        base = rng.uniform(0.6, 1.2)
        height = width * 1.4
        depth = rng.uniform(0.02, 0.08)
        wall.block(
            builder,
            (x, x + width),
            (base, base + height),
            depth,
            front=pick("poster"),
            other=wall.trim,
        )
        x += width + rng.uniform(0.08, 0.3)
