"""Masonry, plaster and paving as seamless tiles that many walls have in common."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from megloc_kapture.datasets.synthetic.drawing import Colour, Picture, shade
from megloc_kapture.datasets.synthetic.noise import periodic_noise
from megloc_kapture.datasets.synthetic.options import stream

TILE = 512  # texels; the period of a material


def _blocks(
    rng: np.random.Generator,
    *,
    base: Colour,
    rows: int,
    cols: int,
    spread: float,
    joint: float,
    joint_colour: Colour,
) -> Picture:
    """Masonry of ``rows`` x ``cols`` blocks per tile, every second row shifted by half a block."""
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
    return blocks * (1 - mortar) + joint_colour * mortar


@lru_cache(maxsize=32)
def material_tile(kind: str, seed: int) -> Picture:
    """A seamless tile (TILE, TILE, 3) float32 of the material, RGB 0..255; not to be written to."""
    rng = stream(seed, "material", kind)
    if kind == "brick":
        base = np.array([150, 84, 66], np.float32) * rng.uniform(0.8, 1.1, 3).astype(np.float32)
        grey = np.full(3, 168, np.float32)
        tile = _blocks(rng, base=base, rows=30, cols=12, spread=0.16, joint=1.2, joint_colour=grey)
    elif kind == "stone":
        base = np.array([172, 160, 136], np.float32) * rng.uniform(0.85, 1.1, 3).astype(np.float32)
        dark = np.full(3, 92, np.float32)
        tile = _blocks(rng, base=base, rows=12, cols=6, spread=0.12, joint=1.5, joint_colour=dark)
        tile = shade(tile, 1 + 0.07 * periodic_noise(rng, TILE, cell=24, octaves=2))
    elif kind == "plaster":
        base = np.array([196, 176, 138], np.float32) * rng.uniform(0.75, 1.1, 3).astype(np.float32)
        tile = np.broadcast_to(base, (TILE, TILE, 3))
        tile = shade(tile, 1 + 0.08 * periodic_noise(rng, TILE, cell=64, octaves=3))
        pits = np.clip(periodic_noise(rng, TILE, cell=28, octaves=2) - 1.6, 0, 1)
        tile = shade(tile, 1 - 0.35 * pits)
    elif kind == "paving":
        base = np.array([142, 138, 130], np.float32) * rng.uniform(0.9, 1.1, 3).astype(np.float32)
        dark = np.full(3, 70, np.float32)
        tile = _blocks(rng, base=base, rows=16, cols=16, spread=0.14, joint=1.6, joint_colour=dark)
    elif kind == "asphalt":
        base = np.array([104, 104, 106], np.float32)
        tile = np.broadcast_to(base, (TILE, TILE, 3))
        tile = shade(tile, 1 + 0.14 * periodic_noise(rng, TILE, cell=24, octaves=2))
    else:
        raise ValueError(f"no material {kind!r}")
    return np.ascontiguousarray(tile, dtype=np.float32)


def tiled(kind: str, seed: int, height: int, width: int, shift: tuple[int, int]) -> Picture:
    """A surface (height, width, 3) of the material, its tile moved by ``shift`` rows, columns."""
    tile = np.roll(material_tile(kind, seed), shift, axis=(0, 1))
    repeats = (-(-height // TILE), -(-width // TILE), 1)
    return np.tile(tile, repeats)[:height, :width]
