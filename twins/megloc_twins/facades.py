"""House fronts: walls with recessed windows and doors, and things that stick out of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_twins.surfaces import SurfaceBuilder

GROUND_STOREY_M = 3.3
UPPER_STOREY_M = 2.9
CORNICE_M = 0.35
WALL_HEIGHT_M = GROUND_STOREY_M + UPPER_STOREY_M + CORNICE_M

# what is in a bay of the ground floor, and how often
_BAYS = {"window": 0.3, "door": 0.2, "shutter": 0.15, "posters": 0.35}
PASSAGE = -1  # the texture of an opening one can go through

Vector = NDArray[np.float64]

TexturePicker = Callable[[str], int]


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
    texture : of the wall itself, stretched over its length and height.
    trim : texture of ledges, reveals and pilasters.
    height : metres.
    """

    start: Vector
    right: Vector
    inward: Vector
    length: float
    texture: int
    trim: int
    height: float = WALL_HEIGHT_M

    @classmethod
    def between(
        cls, start: Vector, end: Vector, texture: int, trim: int, height: float = WALL_HEIGHT_M
    ) -> Wall:
        """The wall whose foot runs from ``start`` to ``end``, (2,) each, metres."""
        length = float(np.hypot(*(end - start)))
        right = np.array([*(end - start) / length, 0.0])
        inward = np.array([right[1], -right[0], 0.0])
        return cls(np.array([*start, 0.0]), right, inward, length, texture, trim, height)

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
                1 - y[1] / self.height,
                x[1] / self.length,
                1 - y[0] / self.height,
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
        """Add an opening: the window or door at its back, and the reveals.

        Through a passage one looks, and its reveals belong to one of its sides.
        """
        x, y = (hole.x0, hole.x1), (hole.y0, hole.y1)
        width, height, depth = hole.x1 - hole.x0, hole.y1 - hole.y0, hole.recess
        into, up = -self.inward, np.array([0.0, 0.0, 1.0])
        if hole.texture != PASSAGE:
            self.rectangle(builder, x, y, hole.texture, out=-depth, glow=hole.glow)
        if not depth:
            return
        trim = self.trim
        builder.add(self.point(hole.x0, hole.y1), depth * into, -height * up, trim)
        builder.add(self.point(hole.x1, hole.y1, -depth), -depth * into, -height * up, trim)
        builder.add(self.point(hole.x0, hole.y1), width * self.right, depth * into, trim)
        builder.add(self.point(hole.x0, hole.y0, -depth), width * self.right, -depth * into, trim)

    def storey(
        self, builder: SurfaceBuilder, y: tuple[float, float], openings: list[Opening]
    ) -> None:
        """Add the wall between two heights, with openings that do not overlap."""
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


@dataclass(frozen=True, eq=False)
class Facade:
    """The front of a house on a wall; ``pick`` gives a texture of a kind (window, door ...)."""

    builder: SurfaceBuilder
    wall: Wall
    rng: np.random.Generator
    pick: TexturePicker

    def build(self) -> list[Vector]:
        """Furnish the wall; returns the positions of its lamps, float64 (3,) each, metres."""
        builder, wall, rng, pick = self.builder, self.wall, self.rng, self.pick
        num_bays = max(1, int(round(wall.length / rng.uniform(2.3, 3.0))))
        edges = np.linspace(0, wall.length, num_bays + 1)
        ground, upper = [], []
        uniform_window = pick("window")
        for left, right in zip(edges[:-1], edges[1:], strict=True):
            kind = str(
                rng.choice(["window", "door", "shutter", "posters"], p=[0.3, 0.2, 0.15, 0.35])
            )
            middle, width = (left + right) / 2, right - left
            if kind == "posters":
                self._posters(left + 0.25, right - 0.25)
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
                    self._ledge(hole)
                if rng.random() < 0.5:
                    self._sign(left, right)
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
                    self._balcony(hole)
                else:
                    self._ledge(hole)
        wall.storey(builder, (0.0, GROUND_STOREY_M), ground)
        wall.storey(builder, (GROUND_STOREY_M, GROUND_STOREY_M + UPPER_STOREY_M), upper)
        top = (GROUND_STOREY_M + UPPER_STOREY_M, WALL_HEIGHT_M)
        self._block((0.0, wall.length), top, 0.25, wall.trim, wall.trim)
        lamps = []
        for edge in edges[1:-1]:
            draw = rng.random()
            if draw < 0.35:  # pilaster
                span = (float(edge) - 0.18, float(edge) + 0.18)
                high = GROUND_STOREY_M + UPPER_STOREY_M
                self._block(span, (0.0, high), 0.16, wall.texture, wall.trim)
            elif draw < 0.5:  # drain pipe
                span = (float(edge) - 0.05, float(edge) + 0.05)
                pipe = pick("plain")
                self._block(span, (0.0, top[0]), 0.1, pipe, pipe)
        for x in np.arange(rng.uniform(1.5, 3.5), wall.length - 1, rng.uniform(4.5, 7.0)):
            glow = pick("glow")
            span = (float(x) - 0.13, float(x) + 0.13)
            wall.block(builder, span, (2.95, 3.25), 0.24, front=glow, other=glow, glow=4.0)
            lamps.append(wall.point(float(x), 3.1, 0.45))
        return lamps

    def _block(
        self, x: tuple[float, float], y: tuple[float, float], depth: float, front: int, other: int
    ) -> None:
        self.wall.block(self.builder, x, y, depth, front=front, other=other)

    def _ledge(self, hole: Opening) -> None:
        trim = self.wall.trim
        self._block((hole.x0 - 0.1, hole.x1 + 0.1), (hole.y0 - 0.1, hole.y0), 0.14, trim, trim)

    def _balcony(self, hole: Opening) -> None:
        span = (max(0.0, hole.x0 - 0.25), min(self.wall.length, hole.x1 + 0.25))
        height = (hole.y0 - 0.55, hole.y0 + 0.2)
        self._block(span, height, 0.6, self.pick("wood"), self.pick("plain"))

    def _sign(self, left: float, right: float) -> None:
        half, middle = min(0.95, (right - left) / 2 - 0.1), (left + right) / 2
        depth = self.rng.uniform(0.06, 0.2)
        span = (middle - half, middle + half)
        self._block(span, (2.62, 2.62 + 0.5), depth, self.pick("sign"), self.wall.trim)

    def _posters(self, x: float, end: float) -> None:
        rng = self.rng
        while x + 0.7 <= end:
            width = float(rng.choice([0.7, 0.9]))
            if x + width > end:
                width = 0.7
            base = rng.uniform(0.6, 1.2)
            height = (base, base + width * 1.4)
            depth = rng.uniform(0.02, 0.08)
            self._block((x, x + width), height, depth, self.pick("poster"), self.wall.trim)
            x += width + rng.uniform(0.08, 0.3)
