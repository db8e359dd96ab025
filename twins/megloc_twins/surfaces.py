"""Textured, one-sided parallelograms; boxes and walls of them; their texture atlas."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_twins.portable import Float64, product, settled

Span = tuple[float, float]
Part = tuple[float, float, float, float]  # u0, v0, u1, v1 of a texture
WHOLE: Part = (0.0, 0.0, 1.0, 1.0)

NUM_LEVELS = 7  # each half the size of the previous level
ATLAS_WIDTH = 4096
_BORDER = 2  # repeated edge texels around each level, for bilinear interpolation


@dataclass(frozen=True, eq=False)
class Surfaces:
    """N textured parallelograms.

    Seen from the front, ``edge_u`` points along the texture's rows and ``edge_v`` down its columns;
    ``edge_u x edge_v`` points away from the viewer. In metres.
    """

    origin: Float64  # (N, 3), the corner where the texture begins
    edge_u: Float64  # (N, 3)
    edge_v: Float64  # (N, 3)
    texture: NDArray[np.int32]  # (N,), index of the texture
    uv: Float64  # (N, 4): the part (u0, v0, u1, v1) of the texture shown, 0..1
    glow: NDArray[np.float32]  # (N,), emitted light at night, relative to the colour

    def __len__(self) -> int:
        return len(self.texture)

    def normals(self) -> Float64:
        """Return unit normals towards the viewer, float64 (N, 3)."""
        normal = np.cross(self.edge_v, self.edge_u)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def corners(self) -> Float64:
        """Return the corners in order, float64 (N, 4, 3)."""
        o, u, v = self.origin, self.edge_u, self.edge_v
        return np.stack([o, o + u, o + u + v, o + v], axis=1)

    def moved(self, rotation: Float64, translation: Float64) -> Surfaces:
        """Return the surfaces after ``x -> rotation x + translation``."""
        return replace(
            self,
            origin=product(self.origin, rotation.T) + translation,
            edge_u=product(self.edge_u, rotation.T),
            edge_v=product(self.edge_v, rotation.T),
        )

    def joined(self, other: Surfaces) -> Surfaces:
        names = (field.name for field in fields(self))
        return Surfaces(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in names))


@dataclass
class SurfaceBuilder:
    """Collector of parallelograms and boxes."""

    _rows: list[tuple[Float64, Float64, Float64, int, Part, float]] = field(default_factory=list)

    def add(
        self,
        origin: Float64,
        edge_u: Float64,
        edge_v: Float64,
        texture: int,
        *,
        uv: Part = WHOLE,
        glow: float = 0.0,
    ) -> None:
        self._rows.append((origin, edge_u, edge_v, texture, uv, glow))

    def add_box(
        self,
        center: tuple[float, float],
        size: tuple[float, float, float],
        yaw: float,
        sides: int | tuple[int, int, int, int],
        top: int,
        *,
        base: float = 0.0,
        bottom: int | None = None,
        uv: Part = WHOLE,
        glow: float = 0.0,
    ) -> None:
        """Add an upright box of size (along x, along y, height), rotated by ``yaw``.

        ``sides`` are the textures of the -y, +x, +y and -x faces, each showing the part ``uv``.
        """
        half_x, half_y, height = size[0] / 2, size[1] / 2, size[2]
        cos, sin = np.cos(yaw), np.sin(yaw)
        along = np.array([cos, sin, 0.0])
        across = np.array([-sin, cos, 0.0])
        up = np.array([0.0, 0.0, 1.0])
        middle = np.array([*center, base])
        right, outward, half_width, distance = along, -across, half_x, half_y
        for texture in (sides,) * 4 if isinstance(sides, int) else sides:
            corner = middle + distance * outward - half_width * right + height * up
            self.add(corner, 2 * half_width * right, -height * up, texture, uv=uv, glow=glow)
            right, outward, half_width, distance = -outward, right, distance, half_width
        # seen from above, the texture's columns point towards -y
        corner = middle - half_x * along + half_y * across + height * up
        self.add(corner, 2 * half_x * along, -2 * half_y * across, top, glow=glow)
        if bottom is not None:
            corner = middle - half_x * along - half_y * across
            self.add(corner, 2 * half_x * along, 2 * half_y * across, bottom, glow=glow)

    def build(self) -> Surfaces:
        count = len(self._rows)
        columns = list(zip(*self._rows, strict=True)) or [()] * 6
        origin, edge_u, edge_v = (settled(column).reshape(count, 3) for column in columns[:3])
        texture, uv = np.array(columns[3], np.int32), settled(columns[4]).reshape(count, 4)
        return Surfaces(origin, edge_u, edge_v, texture, uv, np.array(columns[5], np.float32))


PASSAGE = -1  # texture of an opening without window or door


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


@dataclass(eq=False)
class Wall:
    """A wall; its parts are added to ``builder``."""

    builder: SurfaceBuilder
    ends: tuple[ArrayLike, ArrayLike]  # left and right, seen from inside, (2,) each, metres
    texture: int  # of the wall itself, stretched over its length and height
    trim: int  # texture of ledges, reveals and pilasters
    height: float  # metres

    def __post_init__(self) -> None:
        start, end = np.asarray(self.ends)
        self.length = float(np.hypot(*(end - start)))
        self.start = np.array([*start, 0.0])  # the lower left corner
        self.right = np.array([*(end - start) / self.length, 0.0])  # unit vector
        self.inward = np.array([self.right[1], -self.right[0], 0.0])  # towards the viewer

    def point(self, x: float, y: float, out: float = 0.0) -> Float64:
        """Return the point at ``x`` along, ``y`` above the foot and ``out`` of the wall, metres."""
        return self.start + x * self.right + out * self.inward + np.array([0.0, 0.0, y])

    def rectangle(
        self, x: Span, y: Span, texture: int, *, out: float = 0.0, glow: float = 0.0
    ) -> None:
        """Add a rectangle parallel to the wall, ``out`` metres in front of it."""
        uv = WHOLE
        if texture == self.texture:
            across, down = self.length, self.height
            uv = (x[0] / across, 1 - y[1] / down, x[1] / across, 1 - y[0] / down)
        edge_u = (x[1] - x[0]) * self.right
        edge_v = np.array([0.0, 0.0, y[0] - y[1]])
        self.builder.add(self.point(x[0], y[1], out), edge_u, edge_v, texture, uv=uv, glow=glow)

    def block(
        self, x: Span, y: Span, depth: float, front: int, other: int, *, glow: float = 0.0
    ) -> None:
        """Add a box on the wall, ``depth`` metres thick."""
        self.rectangle(x, y, front, out=depth, glow=glow)
        self._frame(x, y, depth, other, glow)

    def _frame(self, x: Span, y: Span, out: float, texture: int, glow: float = 0.0) -> None:
        """Add the four sides between the wall and a rectangle ``out`` in front of or behind it."""
        width, outward = (x[1] - x[0]) * self.right, out * self.inward
        down = -(y[1] - y[0]) * np.array([0.0, 0.0, 1.0])
        add = self.builder.add
        add(self.point(x[0], y[1]), outward, down, texture, glow=glow)
        add(self.point(x[1], y[1], out), -outward, down, texture, glow=glow)
        add(self.point(x[0], y[1]), width, outward, texture, glow=glow)
        add(self.point(x[0], y[0], out), width, -outward, texture, glow=glow)

    def storey(self, y: Span, openings: Iterable[Opening] = ()) -> None:
        """Add the wall between two heights, with openings that do not overlap.

        An opening has reveals, and a window or door at its back. A passage has no back; it has
        reveals on one of the wall's sides only.
        """
        x = 0.0
        for hole in sorted(openings, key=lambda o: o.x0):
            across, up = (hole.x0, hole.x1), (hole.y0, hole.y1)
            if hole.x0 > x:
                self.rectangle((x, hole.x0), y, self.texture)
            if hole.y0 > y[0]:
                self.rectangle(across, (y[0], hole.y0), self.texture)
            if hole.y1 < y[1]:
                self.rectangle(across, (hole.y1, y[1]), self.texture)
            if hole.texture != PASSAGE:
                self.rectangle(across, up, hole.texture, out=-hole.recess, glow=hole.glow)
            if hole.recess:
                self._frame(across, up, -hole.recess, self.trim)
            x = hole.x1
        if x < self.length:
            self.rectangle((x, self.length), y, self.texture)


@dataclass(frozen=True, eq=False)
class Atlas:
    """Textures with their pyramid levels, packed in one image."""

    image: NDArray[np.uint8]  # (H, ATLAS_WIDTH, 3), RGB
    corner: NDArray[np.float32]  # (T, NUM_LEVELS, 2): x, y of a level's upper left corner
    size: NDArray[np.float32]  # (T, NUM_LEVELS, 2): width and height of a level, texels


def build_atlas(textures: Sequence[NDArray[np.uint8]]) -> Atlas:
    """Pack textures, uint8 (h, w, 3) each, at most ATLAS_WIDTH - 4 wide."""
    levels: list[NDArray[np.uint8]] = []
    for texture in textures:
        levels.append(texture)
        for _ in range(NUM_LEVELS - 1):
            size = [(side + 1) // 2 for side in levels[-1].shape[1::-1]]
            half = cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA)
            levels.append(np.asarray(half, np.uint8))
    heights = np.array([piece.shape[0] for piece in levels]) + 2 * _BORDER
    widths = np.array([piece.shape[1] for piece in levels]) + 2 * _BORDER
    corner = np.zeros((len(levels), 2), np.int64)
    x = y = shelf = 0
    for index in np.argsort(-heights, kind="stable"):  # in rows, tallest textures first
        if x + widths[index] > ATLAS_WIDTH:
            x, y, shelf = 0, y + shelf, 0
        corner[index] = (x + _BORDER, y + _BORDER)
        x += int(widths[index])
        shelf = max(shelf, int(heights[index]))
    image = np.zeros((y + shelf, ATLAS_WIDTH, 3), np.uint8)
    for (left, top), piece in zip(corner - _BORDER, levels, strict=True):
        padded = cv2.copyMakeBorder(piece, _BORDER, _BORDER, _BORDER, _BORDER, cv2.BORDER_REPLICATE)
        image[top : top + padded.shape[0], left : left + padded.shape[1]] = padded
    shape = (len(textures), NUM_LEVELS, 2)
    sizes = np.array([piece.shape[1::-1] for piece in levels], np.float32).reshape(shape)
    return Atlas(image, corner.astype(np.float32).reshape(shape), sizes)
