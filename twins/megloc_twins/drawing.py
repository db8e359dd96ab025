"""Noise, colours, letters, shapes, cracks and tiles of masonry to paint textures with."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from megloc_twins.options import stream
from megloc_twins.portable import exp, resized

Field2D = NDArray[np.float32]

Rgb = NDArray[np.uint8]
Box = tuple[int, int, int, int]  # x0, y0, x1, y1, texels
Colour = NDArray[np.float32]  # (3,), 0..255
Picture = NDArray[np.float32]  # (H, W, 3), 0..255
TILE = 512  # texels; the period of a material
_FINE = 16  # OpenCV's drawing functions take positions in sixteenths of a texel
_SMOOTH = cv2.LINE_AA, 4  # their last arguments: antialiasing, fractional bits of positions
_MATERIALS = {  # colour, and the smallest random factor of each channel
    "brick": ((150, 84, 66), 0.8),
    "stone": ((172, 160, 136), 0.85),
    "plaster": ((196, 176, 138), 0.75),
    "paving": ((142, 138, 130), 0.9),
    "asphalt": ((104, 104, 106), 1.0),
}
_STAINS = {"stone": (0.07, 24, 2), "plaster": (0.08, 64, 3), "asphalt": (0.14, 24, 2)}
# rows and columns of blocks in a tile (every second row is shifted by half a block); spread of the
# blocks' tones; width of the joints in texels, and their grey level
_MASONRY: dict[str, tuple[int, int, float, float, float]] = {
    "brick": (30, 12, 0.16, 1.2, 168.0),
    "stone": (12, 6, 0.12, 1.5, 92.0),
    "paving": (16, 16, 0.14, 1.6, 70.0),
}


def smooth_noise(rng: Generator, height: int, width: int, *, cell: float, octaves: int) -> Field2D:
    """Return normalised noise; ``cell`` is the cell size of the coarsest octave, texels."""
    total = np.zeros((height, width), np.float32)
    amplitude = 1.0
    for _ in range(octaves):
        rows, cols = int(np.ceil(height / cell)) + 2, int(np.ceil(width / cell)) + 2
        grid = rng.standard_normal((rows, cols), dtype=np.float32)
        fine_height, fine_width = int(round(rows * cell)), int(round(cols * cell))
        fine = resized(grid, fine_width, fine_height, cubic=True)
        top, left = (fine_height - height) // 2, (fine_width - width) // 2
        total += np.float32(amplitude) * fine[top : top + height, left : left + width]
        amplitude *= 0.65
        cell = cell / 2
        if cell < 1.5:
            break
    return (total - total.mean()) / max(float(total.std()), 1e-6)


def periodic_noise(rng: Generator, size: int, *, cell: float, octaves: int = 4) -> Field2D:
    """Return noise like :func:`smooth_noise`, square and seamless when tiled."""
    white = rng.standard_normal((size, size))
    rows, columns = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    freq = np.sqrt(rows * rows + columns * columns) * cell
    upper = 2.0 ** (octaves - 1)
    gain = np.where(freq > 0, 1 / (0.3 + freq), 0) * exp(-((freq / upper) ** 2))
    out = np.fft.irfft2(np.fft.rfft2(white) * gain, (size, size)).astype(np.float32)
    return out / max(float(out.std()), 1e-6)


def random_colour(rng: Generator, low: float, high: float, *, chroma: float = 0.75) -> Colour:
    """Draw a random colour; ``chroma`` 0 gives grey, 1 the strongest colours of the range."""
    channels = rng.uniform(low, high, 3)
    return (channels.mean() + chroma * (channels - channels.mean())).astype(np.float32)


def to_rgb(image: Picture) -> Rgb:
    """Clip to 0..255 and round to uint8."""
    return np.clip(image + 0.5, 0, 255).astype(np.uint8)


def shade(image: Picture | Colour, factor: Field2D) -> Picture:
    return image * factor[..., None]


def draw_glyphs(rng: Generator, image: Rgb, box: Box, colour: Colour, *, rows: int) -> None:
    """Fill ``box`` with lines of random letter-like strokes, in place."""
    x0, y0, x1, y1 = box
    line = (y1 - y0) / rows
    size = 0.72 * line
    thickness = max(1, int(size * 0.16))
    for row in range(rows):
        x = float(x0)
        end = x1 - rng.uniform(0, 0.35) * (x1 - x0) * (rows > 1)
        y = y0 + row * line + 0.1 * line
        while x + 0.6 * size < end:
            if rng.random() < 0.14:
                x += 0.5 * size
                continue
            nodes = np.array([[i, j] for j in range(3) for i in range(2)], np.float32)
            picks = rng.permutation(6)[: int(rng.integers(3, 6))]
            points = nodes[picks] * (0.55 * size, 0.5 * size) + (x, y)
            stroke = np.round(points * _FINE).astype(np.int32)
            closed = bool(rng.random() < 0.3)
            cv2.polylines(image, [stroke], closed, colour.tolist(), thickness, *_SMOOTH)
            x += 0.85 * size


def draw_shapes(rng: Generator, image: Rgb, count: int) -> None:
    """Draw random discs, polygons, rings and bars over the image, in place."""
    height, width = image.shape[:2]
    extent = min(height, width)
    for _ in range(count):
        kind = int(rng.integers(0, 4))
        colour = random_colour(rng, 10, 245).tolist()
        center = (int(rng.uniform(0, width) * _FINE), int(rng.uniform(0, height) * _FINE))
        radius = rng.uniform(0.06, 0.3) * extent
        if kind < 2:
            thickness = max(1, int(radius / 4)) if kind else -1
            cv2.circle(image, center, int(radius * _FINE), colour, thickness, *_SMOOTH)
        elif kind == 2:
            angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 6))))
            ring = np.stack([np.cos(angles), np.sin(angles)], 1) * radius * _FINE * 1.4
            points = np.round(ring + center).astype(np.int32)
            cv2.fillPoly(image, [points], colour, *_SMOOTH)
        else:
            angle = rng.uniform(0, np.pi)
            along = np.array([np.cos(angle), np.sin(angle)]) * extent * (0.75 * _FINE)
            start, stop = np.round([center - along, center + along]).astype(int).tolist()
            cv2.line(image, start, stop, colour, max(1, int(radius * 0.3)), *_SMOOTH)


def draw_cracks(rng: Generator, image: Rgb, count: int) -> None:
    """Draw thin dark wandering lines over the image, in place."""
    height, width = image.shape[:2]
    for _ in range(count):
        steps = rng.normal(0, 5, (int(rng.integers(10, 40)), 2)) + rng.normal(0, 3, 2)
        start = rng.uniform((0, 0), (width, height))
        points = np.round((start + np.cumsum(steps, 0)) * _FINE).astype(np.int32)
        tone = float(rng.uniform(30, 80))
        cv2.polylines(image, [points], False, (tone, tone, tone), 1, *_SMOOTH)


def _blocks(rng: Generator, base: Colour, kind: str) -> Picture:
    rows, cols, spread, joint, joint_grey = _MASONRY[kind]
    y, x = np.mgrid[0:TILE, 0:TILE].astype(np.float32)
    v = (y + 0.5) / TILE * rows
    row = np.floor(v).astype(int)
    u = (x + 0.5) / TILE * cols + 0.5 * (row % 2)
    col = np.floor(u).astype(int) % cols
    tone = rng.normal(0, spread, (rows, cols)).astype(np.float32)
    tint = rng.normal(0, spread * 0.3, (rows, cols, 3)).astype(np.float32)
    to_edge_x = np.abs(u - np.floor(u) - 0.5) * TILE / cols
    to_edge_y = np.abs(v - np.floor(v) - 0.5) * TILE / rows
    edge = np.minimum(TILE / cols / 2 - to_edge_x, TILE / rows / 2 - to_edge_y)
    mortar = np.clip(joint - edge + 0.5, 0, 1)[..., None]
    blocks = base * (1 + tone[row, col][..., None] + tint[row, col])
    blocks = shade(blocks, 1 + 0.10 * periodic_noise(rng, TILE, cell=40, octaves=2))
    return blocks * (1 - mortar) + np.float32(joint_grey) * mortar


@lru_cache(maxsize=32)
def material_tile(kind: str, seed: int) -> Picture:
    """Return a seamless, read-only tile (TILE, TILE, 3) float32 of the material, RGB 0..255."""
    rng = stream(seed, "material", kind)
    colour, darkest = _MATERIALS[kind]
    base = np.array(colour, np.float32)
    if darkest < 1:
        base = base * rng.uniform(darkest, 1.1, 3).astype(np.float32)
    flat = np.broadcast_to(base, (TILE, TILE, 3))
    tile = _blocks(rng, base, kind) if kind in _MASONRY else flat
    if kind in _STAINS:
        strength, cell, octaves = _STAINS[kind]  # cell: of the coarsest octave, texels
        tile = shade(tile, 1 + strength * periodic_noise(rng, TILE, cell=cell, octaves=octaves))
    if kind == "plaster":
        pits = np.clip(periodic_noise(rng, TILE, cell=28, octaves=2) - 1.6, 0, 1)
        tile = shade(tile, 1 - 0.35 * pits)
    return np.ascontiguousarray(tile, dtype=np.float32)


def tiled(kind: str, seed: int, height: int, width: int, shift: tuple[int, int]) -> Picture:
    """Return a surface (height, width, 3) of the material, moved by ``shift`` (rows, columns)."""
    tile = np.roll(material_tile(kind, seed), shift, axis=(0, 1))
    repeats = (-(-height // TILE), -(-width // TILE), 1)
    return np.tile(tile, repeats)[:height, :width]
