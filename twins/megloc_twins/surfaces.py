"""Textured parallelograms, seen from their front only, and the atlas of their textures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_twins.portable import product, settled

Vector = NDArray[np.float64]

NUM_LEVELS = 7  # each half the size of the one before
ATLAS_WIDTH = 4096
_BORDER = 2  # texels repeated around each level: bilinear lookups at the edge stay inside


@dataclass(frozen=True, eq=False)
class Surfaces:
    """N textured parallelograms.

    Seen from its front, ``edge_u`` runs along the texture's rows and ``edge_v`` down its columns;
    ``edge_u x edge_v`` points away from the viewer.

    Parameters
    ----------
    origin : float64 (N, 3), metres, the corner where the texture begins.
    edge_u, edge_v : float64 (N, 3), metres.
    texture : int32 (N,), index of the texture.
    uv : float64 (N, 4): the part (u0, v0, u1, v1) of the texture shown, 0..1.
    glow : float32 (N,), light that the surface itself gives off at night, relative to its colour.
    """

    origin: Vector
    edge_u: Vector
    edge_v: Vector
    texture: NDArray[np.int32]
    uv: Vector
    glow: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.texture)

    def normals(self) -> Vector:
        """Unit normals towards the viewer, float64 (N, 3)."""
        normal = np.cross(self.edge_v, self.edge_u)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def corners(self) -> Vector:
        """Corners in the order of the outline, float64 (N, 4, 3)."""
        o, u, v = self.origin, self.edge_u, self.edge_v
        return np.stack([o, o + u, o + u + v, o + v], axis=1)

    def moved(self, rotation: Vector, translation: Vector) -> Surfaces:
        """The surfaces after ``x -> rotation x + translation``."""
        return replace(
            self,
            origin=product(self.origin, rotation.T) + translation,
            edge_u=product(self.edge_u, rotation.T),
            edge_v=product(self.edge_v, rotation.T),
        )

    def joined(self, other: Surfaces) -> Surfaces:
        """These surfaces, then the others."""
        names = (field.name for field in fields(self))
        return Surfaces(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in names))


@dataclass
class SurfaceBuilder:
    """Collects parallelograms and boxes."""

    _rows: list[tuple[Vector, Vector, Vector, int, tuple[float, ...], float]] = field(
        default_factory=list
    )

    def add(
        self,
        origin: Vector,
        edge_u: Vector,
        edge_v: Vector,
        texture: int,
        *,
        uv: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0),
        glow: float = 0.0,
    ) -> None:
        """One parallelogram; see :class:`Surfaces`."""
        self._rows.append((origin, edge_u, edge_v, texture, uv, glow))

    def add_box(
        self,
        center: tuple[float, float],
        size: tuple[float, float, float],
        yaw: float,
        sides: tuple[int, int, int, int],
        top: int,
        *,
        base: float = 0.0,
        bottom: int | None = None,
        uv: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0),
        glow: float = 0.0,
    ) -> None:
        """An upright box: ``size`` is (along x, along y, height) in metres before the turn by
        ``yaw`` (radians); ``sides`` are the textures of the -y, +x, +y and -x faces, of which
        each shows the part ``uv``."""
        half_x, half_y, height = size[0] / 2, size[1] / 2, size[2]
        cos, sin = np.cos(yaw), np.sin(yaw)
        along = np.array([cos, sin, 0.0])
        across = np.array([-sin, cos, 0.0])
        up = np.array([0.0, 0.0, 1.0])
        middle = np.array([center[0], center[1], base])
        frames = [
            (along, -across, half_x, half_y),
            (across, along, half_y, half_x),
            (-along, across, half_x, half_y),
            (-across, -along, half_y, half_x),
        ]
        for texture, (right, outward, half_width, distance) in zip(sides, frames, strict=True):
            corner = middle + distance * outward - half_width * right + height * up
            self.add(corner, 2 * half_width * right, -height * up, texture, uv=uv, glow=glow)
        # from above, with the texture's columns running towards -y
        corner = middle - half_x * along + half_y * across + height * up
        self.add(corner, 2 * half_x * along, -2 * half_y * across, top, glow=glow)
        if bottom is not None:
            corner = middle - half_x * along - half_y * across
            self.add(corner, 2 * half_x * along, 2 * half_y * across, bottom, glow=glow)

    def build(self) -> Surfaces:
        """All that was added, in order."""
        count = len(self._rows)
        return Surfaces(
            settled([r[0] for r in self._rows]).reshape(count, 3),
            settled([r[1] for r in self._rows]).reshape(count, 3),
            settled([r[2] for r in self._rows]).reshape(count, 3),
            np.array([r[3] for r in self._rows], np.int32),
            settled([r[4] for r in self._rows]).reshape(count, 4),
            np.array([r[5] for r in self._rows], np.float32),
        )


@dataclass(frozen=True, eq=False)
class Atlas:
    """Textures packed with their levels.

    Parameters
    ----------
    image : uint8 (H, ATLAS_WIDTH, 3), RGB.
    corner : float32 (T, NUM_LEVELS, 2): x, y of each level's upper left corner in ``image``.
    size : float32 (T, NUM_LEVELS, 2): width and height of each level, texels.
    """

    image: NDArray[np.uint8]
    corner: NDArray[np.float32]
    size: NDArray[np.float32]


def _half(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    size = (image.shape[1] + 1) // 2, (image.shape[0] + 1) // 2
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def build_atlas(textures: Sequence[NDArray[np.uint8]]) -> Atlas:
    """Pack textures, uint8 (h, w, 3) each, at most ATLAS_WIDTH - 4 wide."""
    levels: list[NDArray[np.uint8]] = []
    for texture in textures:
        current = texture
        for level in range(NUM_LEVELS):
            if level:
                current = _half(current)
            levels.append(current)
    heights = np.array([piece.shape[0] for piece in levels]) + 2 * _BORDER
    widths = np.array([piece.shape[1] for piece in levels]) + 2 * _BORDER
    corner = np.zeros((len(levels), 2), np.int64)
    x = y = shelf = 0
    for index in np.argsort(-heights, kind="stable"):  # shelves, highest first
        if x + widths[index] > ATLAS_WIDTH:
            x, y, shelf = 0, y + shelf, 0
        corner[index] = (x + _BORDER, y + _BORDER)
        x += int(widths[index])
        shelf = max(shelf, int(heights[index]))
    image = np.zeros((y + shelf, ATLAS_WIDTH, 3), np.uint8)
    for (left, top), piece in zip(corner - _BORDER, levels, strict=True):
        padded = cv2.copyMakeBorder(piece, _BORDER, _BORDER, _BORDER, _BORDER, cv2.BORDER_REPLICATE)
        image[top : top + padded.shape[0], left : left + padded.shape[1]] = padded
    size = np.array([(piece.shape[1], piece.shape[0]) for piece in levels], np.float32)
    shape = (len(textures), NUM_LEVELS, 2)
    return Atlas(image, corner.astype(np.float32).reshape(shape), size.reshape(shape))
