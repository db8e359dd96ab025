"""Procedural textures: bricks, plaster, windows, posters with glyphs, painted from a seed.

Every painter is a function ``(rng, height, width, **params) -> uint8 (height, width, 3)`` RGB.
A :class:`TextureRecipe` names a painter with its size and seed, so that a world can be laid out
without painting it, and two surfaces with the same recipe look the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.options import stream

Rgb = NDArray[np.uint8]
Field2D = NDArray[np.float32]

TILE = 512  # texels; the period of a wall's material


@dataclass(frozen=True)
class TextureRecipe:
    """How to paint one texture.

    Parameters
    ----------
    painter : a name in :data:`PAINTERS`.
    width, height : texels.
    seed : of the texture's random stream.
    params : further arguments of the painter, as sorted (name, value) pairs.
    """

    painter: str
    width: int
    height: int
    seed: int
    params: tuple[tuple[str, str | float], ...] = ()

    def paint(self) -> Rgb:
        """The texture, uint8 (height, width, 3), RGB."""
        rng = stream(self.seed, self.painter)
        return PAINTERS[self.painter](rng, self.height, self.width, **dict(self.params))


# ------------------------------------------------------------------------------ building blocks


def smooth_noise(
    rng: np.random.Generator, height: int, width: int, *, cell: float, octaves: int = 4
) -> Field2D:
    """Multi-octave noise, zero mean and unit deviation; ``cell`` is the coarsest octave, texels."""
    total = np.zeros((height, width), np.float32)
    amplitude = 1.0
    for _ in range(octaves):
        rows, cols = int(np.ceil(height / cell)) + 2, int(np.ceil(width / cell)) + 2
        grid = rng.standard_normal((rows, cols), dtype=np.float32)
        size = (int(round(cols * cell)), int(round(rows * cell)))
        fine = cv2.resize(grid, size, interpolation=cv2.INTER_CUBIC)
        top, left = (size[1] - height) // 2, (size[0] - width) // 2
        total += np.float32(amplitude) * fine[top : top + height, left : left + width]
        amplitude *= 0.65
        cell = cell / 2
        if cell < 1.5:
            break
    return (total - total.mean()) / max(float(total.std()), 1e-6)


def periodic_noise(
    rng: np.random.Generator, size: int, *, cell: float, octaves: int = 4
) -> Field2D:
    """Like :func:`smooth_noise`, square and seamless when tiled."""
    white = rng.standard_normal((size, size))
    freq = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]) * cell
    upper = 2.0 ** (octaves - 1)
    gain = np.where(freq > 0, 1 / (0.3 + freq), 0) * np.exp(-((freq / upper) ** 2))
    out = np.fft.irfft2(np.fft.rfft2(white) * gain, (size, size)).astype(np.float32)
    return out / max(float(out.std()), 1e-6)


def _colour(
    rng: np.random.Generator, low: float = 30, high: float = 225, *, chroma: float = 0.75
) -> NDArray[np.float32]:
    """A random colour; ``chroma`` 0 is grey, 1 as strong as its channels' range allows."""
    channels = rng.uniform(low, high, 3)
    return (channels.mean() + chroma * (channels - channels.mean())).astype(np.float32)


def _to_rgb(image: NDArray[np.float32]) -> Rgb:
    return np.clip(image + 0.5, 0, 255).astype(np.uint8)


def _shade(image: NDArray[np.float32], factor: Field2D) -> NDArray[np.float32]:
    return image * factor[..., None]


def _bgr(colour: NDArray[np.float32]) -> tuple[float, float, float]:
    return float(colour[0]), float(colour[1]), float(colour[2])


def draw_glyphs(
    rng: np.random.Generator,
    image: Rgb,
    box: tuple[int, int, int, int],
    colour: NDArray[np.float32],
    *,
    rows: int,
) -> None:
    """Fill ``box`` (x0, y0, x1, y1 texels) with lines of random letter-like strokes, in place."""
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
            stroke = np.round(points * 16).astype(np.int32)
            cv2.polylines(
                image, [stroke], bool(rng.random() < 0.3), _bgr(colour), thickness, cv2.LINE_AA, 4
            )
            x += 0.85 * size


def draw_shapes(rng: np.random.Generator, image: Rgb, count: int) -> None:
    """Draw random discs, polygons, rings and bars over the image, in place."""
    height, width = image.shape[:2]
    extent = min(height, width)
    for _ in range(count):
        kind = int(rng.integers(0, 4))
        colour = _bgr(_colour(rng, 10, 245))
        center = (int(rng.uniform(0, width) * 16), int(rng.uniform(0, height) * 16))
        radius = rng.uniform(0.06, 0.3) * extent
        if kind == 0:
            cv2.circle(image, center, int(radius * 16), colour, -1, cv2.LINE_AA, 4)
        elif kind == 1:
            cv2.circle(
                image, center, int(radius * 16), colour, max(1, int(radius / 4)), cv2.LINE_AA, 4
            )
        elif kind == 2:
            angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 6))))
            ring = np.stack([np.cos(angles), np.sin(angles)], 1) * radius * 16 * 1.4
            points = np.round(ring + center).astype(np.int32)
            cv2.fillPoly(image, [points], colour, cv2.LINE_AA, 4)
        else:
            angle = rng.uniform(0, np.pi)
            along = np.array([np.cos(angle), np.sin(angle)]) * extent * 12
            start = np.round(center - along).astype(int)
            stop = np.round(center + along).astype(int)
            cv2.line(
                image,
                (int(start[0]), int(start[1])),
                (int(stop[0]), int(stop[1])),
                colour,
                max(1, int(radius * 0.3)),
                cv2.LINE_AA,
                4,
            )


# ------------------------------------------------------------------------------------ materials


def _blocks(
    rng: np.random.Generator,
    *,
    base: NDArray[np.float32],
    rows: int,
    cols: int,
    spread: float,
    joint: float,
    joint_colour: NDArray[np.float32],
) -> NDArray[np.float32]:
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
    blocks = _shade(blocks, 1 + 0.10 * periodic_noise(rng, TILE, cell=40, octaves=6))
    return blocks * (1 - mortar) + joint_colour * mortar


@lru_cache(maxsize=32)
def material_tile(kind: str, seed: int) -> NDArray[np.float32]:
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
        tile = _shade(tile, 1 + 0.07 * periodic_noise(rng, TILE, cell=12, octaves=3))
    elif kind == "plaster":
        base = np.array([196, 176, 138], np.float32) * rng.uniform(0.75, 1.1, 3).astype(np.float32)
        tile = np.broadcast_to(base, (TILE, TILE, 3))
        tile = _shade(tile, 1 + 0.08 * periodic_noise(rng, TILE, cell=64, octaves=6))
        pits = np.clip(periodic_noise(rng, TILE, cell=14, octaves=2) - 1.6, 0, 1)
        tile = _shade(tile, 1 - 0.35 * pits)
    elif kind == "paving":
        base = np.array([142, 138, 130], np.float32) * rng.uniform(0.9, 1.1, 3).astype(np.float32)
        dark = np.full(3, 70, np.float32)
        tile = _blocks(rng, base=base, rows=16, cols=16, spread=0.14, joint=1.6, joint_colour=dark)
    elif kind == "asphalt":
        base = np.array([104, 104, 106], np.float32)
        tile = np.broadcast_to(base, (TILE, TILE, 3))
        tile = _shade(tile, 1 + 0.14 * periodic_noise(rng, TILE, cell=10, octaves=3))
    else:
        raise ValueError(f"no material {kind!r}")
    return np.ascontiguousarray(tile, dtype=np.float32)


def _tiled(kind: str, seed: int, height: int, width: int, shift: tuple[int, int]) -> NDArray:
    tile = np.roll(material_tile(kind, seed), shift, axis=(0, 1))
    repeats = (-(-height // TILE), -(-width // TILE), 1)
    return np.tile(tile, repeats)[:height, :width]


def _cracks(rng: np.random.Generator, image: Rgb, count: int) -> None:
    height, width = image.shape[:2]
    for _ in range(count):
        steps = rng.normal(0, 5, (int(rng.integers(10, 40)), 2)) + rng.normal(0, 3, 2)
        start = rng.uniform((0, 0), (width, height))
        points = np.round((start + np.cumsum(steps, 0)) * 16).astype(np.int32)
        tone = float(rng.uniform(30, 80))
        cv2.polylines(image, [points], False, (tone, tone, tone), 1, cv2.LINE_AA, 4)


# ------------------------------------------------------------------------------------- painters


def paint_wall(
    rng: np.random.Generator,
    height: int,
    width: int,
    *,
    material: str,
    material_seed: float,
    dirt: float = 1.0,
    graffiti: float = 0.0,
) -> Rgb:
    """A wall of a material that other walls share, under dirt, cracks and graffiti of its own."""
    shift = (0, int(rng.integers(0, TILE)))
    wall = _tiled(material, int(material_seed), height, width, shift)
    coarse = smooth_noise(rng, height, width, cell=160, octaves=3)
    fine = smooth_noise(rng, height, width, cell=24, octaves=4)
    patches = np.clip(smooth_noise(rng, height, width, cell=90, octaves=5) - 1.2, 0, 0.25) * 4
    streaks = cv2.resize(
        smooth_noise(rng, max(2, height // 40), width, cell=12, octaves=3),
        (width, height),
        interpolation=cv2.INTER_CUBIC,
    )
    tone = 1 + dirt * (0.06 * coarse + 0.055 * fine + 0.04 * streaks)
    wall = _shade(wall, np.clip(tone, 0.3, 1.6))
    patch = _colour(rng, 90, 190, chroma=0.3)[None, None]
    share = (min(1.0, 0.75 * dirt) * patches)[..., None]
    wall = wall * (1 - share) + patch * share
    image = _to_rgb(wall)
    _cracks(rng, image, int(dirt * width * height / 25000))
    for _ in range(int(graffiti)):
        w = int(rng.uniform(0.12, 0.3) * width)
        h = int(rng.uniform(0.12, 0.22) * height)
        x = int(rng.uniform(0, max(1, width - w)))
        y = int(rng.uniform(0.6 * height, max(0.6 * height + 1, height - h)))
        draw_glyphs(rng, image, (x, y, x + w, y + h), _colour(rng, 10, 240), rows=1)
    return image


def paint_ground(
    rng: np.random.Generator,
    height: int,
    width: int,
    *,
    material: str,
    material_seed: float,
    dirt: float = 1.0,
    density: float = 80.0,
) -> Rgb:
    """Paving or asphalt with patches, lines, manholes and leaves; ``density`` texels per metre."""
    ground = _tiled(material, int(material_seed), height, width, (0, 0))
    coarse = smooth_noise(rng, height, width, cell=200, octaves=4)
    fine = smooth_noise(rng, height, width, cell=20, octaves=3)
    ground = _shade(ground, np.clip(1 + dirt * (0.08 * coarse + 0.06 * fine), 0.3, 1.6))
    image = _to_rgb(ground)
    area_m2 = height * width / density**2
    for _ in range(int(area_m2 / 14)):  # repaired patches
        w, h = rng.uniform(0.4, 1.8, 2) * density
        centre = rng.uniform((0, 0), (width, height))
        rect = (
            centre.tolist(),
            (float(w), float(h)),
            float(rng.choice([0, 90, rng.uniform(0, 90)])),
        )
        box = np.round(cv2.boxPoints(rect) * 16).astype(np.int32)
        tone = float(rng.uniform(60, 130))
        cv2.fillPoly(image, [box], (tone, tone, tone + 3), cv2.LINE_AA, 4)
    manhole = stream(int(material_seed), "manhole")
    for _ in range(2 + int(area_m2 / 60)):
        size = int(0.7 * density)
        x, y = int(rng.uniform(0, width - size)), int(rng.uniform(0, height - size))
        image[y : y + size, x : x + size] = _manhole(manhole, size)
        manhole = stream(int(material_seed), "manhole")
    for _ in range(int(area_m2 / 50)):
        start = rng.uniform((0, 0), (width, height))
        angle = rng.choice([0, np.pi / 2, rng.uniform(0, np.pi)])
        stop = start + np.array([np.cos(angle), np.sin(angle)]) * rng.uniform(2, 5) * density
        ends = [(int(p[0]), int(p[1])) for p in (start, stop)]
        paint = float(rng.uniform(170, 225))
        cv2.line(image, ends[0], ends[1], (paint, paint, paint), int(0.12 * density), cv2.LINE_AA)
    for _ in range(int(dirt * area_m2 * 2.5)):  # leaves, litter
        centre = rng.uniform((0, 0), (width, height))
        axes = rng.uniform(0.02, 0.06, 2) * density
        colour = _bgr(_colour(rng, 20, 230))
        cv2.ellipse(
            image,
            (int(centre[0]), int(centre[1])),
            (max(1, int(axes[0])), max(1, int(axes[1]))),
            float(rng.uniform(0, 180)),
            0,
            360,
            colour,
            -1,
            cv2.LINE_AA,
        )
    grain = 1 + 0.05 * smooth_noise(rng, height, width, cell=6, octaves=2)
    return _to_rgb(_shade(image.astype(np.float32), grain))


def _manhole(rng: np.random.Generator, size: int) -> Rgb:
    image = np.full((size, size, 3), 96, np.uint8)
    centre, radius = (size // 2, size // 2), size // 2 - 2
    cv2.circle(image, centre, radius, (58, 56, 54), -1, cv2.LINE_AA)
    for _ in range(14):
        x, y = (rng.normal(0, 0.2, 2) * size + size / 2).astype(int)
        cv2.circle(image, (int(x), int(y)), max(1, size // 20), (128, 124, 118), -1, cv2.LINE_AA)
    cv2.circle(image, centre, radius - 2, (140, 136, 128), 2, cv2.LINE_AA)
    return image


def paint_window(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """A window: frame, panes, what stands behind them."""
    frame = _colour(rng, 90, 235, chroma=0.35)
    glass = np.array([58, 72, 88], np.float32) * rng.uniform(0.6, 1.3)
    ramp = np.linspace(1.35, 0.7, height, dtype=np.float32)[:, None] * np.ones(
        (1, width), np.float32
    )
    cloud = 1 + 0.22 * smooth_noise(rng, height, width, cell=50, octaves=4)
    image = _to_rgb(_shade(np.broadcast_to(glass, (height, width, 3)), ramp * cloud))
    if rng.random() < 0.6:  # curtains with folds
        part = int(width * rng.uniform(0.15, 0.35))
        folds = 1 + 0.25 * np.sin(np.arange(part) * rng.uniform(0.3, 0.7))
        cloth = (_colour(rng, 110, 220, chroma=0.4) * folds[:, None]).clip(0, 255).astype(np.uint8)
        image[:, :part] = cloth[None]
        image[:, width - part :] = cloth[None, ::-1]
    for _ in range(int(rng.integers(1, 4))):  # plants, lamps, vases on the sill
        x, w = int(rng.uniform(0.1, 0.8) * width), int(rng.uniform(0.08, 0.2) * width)
        h = int(rng.uniform(0.1, 0.35) * height)
        cv2.ellipse(image, (x, height - h // 2), (w, h), 0, 0, 360, _bgr(_colour(rng)), -1)
    bar = max(3, width // 18)
    colour = _bgr(frame)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), colour, 2 * bar)
    rows, cols = int(rng.integers(1, 4)), int(rng.integers(2, 4))
    for i in range(1, cols):
        x = i * width // cols
        cv2.rectangle(image, (x - bar // 2, 0), (x + bar // 2, height), colour, -1)
    for j in range(1, rows + 1):
        y = j * height // (rows + 1)
        cv2.rectangle(image, (0, y - bar // 2), (width, y + bar // 2), colour, -1)
    grain = 1 + 0.04 * smooth_noise(rng, height, width, cell=8, octaves=2)
    return _to_rgb(_shade(image.astype(np.float32), grain))


def paint_door(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """A door of planks or panels with a handle and a number plate."""
    base = _colour(rng, 40, 150, chroma=0.6)
    planks = int(rng.integers(4, 9))
    tone = rng.normal(1, 0.12, planks).astype(np.float32)
    x = np.arange(width)
    column = tone[np.minimum(x * planks // width, planks - 1)]
    seam = np.where((x * planks % width) < planks * 2, 0.5, 1.0)
    grain = cv2.resize(
        smooth_noise(rng, max(2, height // 16), width, cell=6, octaves=2), (width, height)
    )
    image = _to_rgb(
        _shade(
            base * np.ones((height, width, 3), np.float32),
            (column * seam)[None] * (1 + 0.09 * grain),
        )
    )
    for _ in range(int(rng.integers(1, 4))):
        x0, x1 = np.sort(rng.uniform(0.08, 0.92, 2)) * width
        y0, y1 = np.sort(rng.uniform(0.05, 0.95, 2)) * height
        corners = (int(x0), int(y0)), (int(x1), int(y1))
        cv2.rectangle(image, corners[0], corners[1], _bgr(base * 0.5), max(2, width // 30))
    bar = max(3, width // 16)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), _bgr(base * 0.45), bar)
    knob = (int(0.86 * width), int(0.52 * height))
    cv2.circle(image, knob, max(3, width // 22), (214, 190, 110), -1, cv2.LINE_AA)
    plate = (int(0.3 * width), int(0.14 * height), int(0.7 * width), int(0.24 * height))
    cv2.rectangle(image, plate[:2], plate[2:], (225, 222, 210), -1)
    draw_glyphs(rng, image, plate, np.array([20, 30, 90], np.float32), rows=1)
    return image


def paint_shutter(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """A rolling shutter: horizontal slats, with a graffito."""
    base = _colour(rng, 110, 200, chroma=0.3)
    slats = 1 + 0.18 * np.sin(np.arange(height, dtype=np.float32) * (2 * np.pi / 11))
    dirt = 1 + 0.09 * smooth_noise(rng, height, width, cell=40, octaves=4)
    image = _to_rgb(_shade(np.broadcast_to(base, (height, width, 3)), slats[:, None] * dirt))
    box = (int(0.08 * width), int(0.3 * height), int(0.95 * width), int(0.85 * height))
    draw_glyphs(rng, image, box, _colour(rng, 10, 240), rows=int(rng.integers(1, 3)))
    return image


def paint_poster(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """A poster: shapes, a headline and small print on a coloured ground."""
    low, high = _colour(rng, 20, 240), _colour(rng, 20, 240)
    ramp = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    image = _to_rgb((low * (1 - ramp) + high * ramp) * np.ones((1, width, 1), np.float32))
    draw_shapes(rng, image, int(rng.integers(6, 14)))
    ink = _colour(rng, 0, 80) if rng.random() < 0.5 else _colour(rng, 200, 255)
    margin = int(0.07 * width)
    head = int(height * rng.uniform(0.05, 0.5))
    box = (margin, head, width - margin, head + int(0.16 * height))
    draw_glyphs(rng, image, box, ink, rows=1)
    small = (margin, int(0.78 * height), width - margin, int(0.96 * height))
    draw_glyphs(rng, image, small, ink, rows=int(rng.integers(3, 6)))
    border = max(2, width // 40)
    tone = 240 if rng.random() < 0.6 else 25
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (tone, tone, tone), border)
    wear = 1 + 0.05 * smooth_noise(rng, height, width, cell=50, octaves=5)
    return _to_rgb(_shade(image.astype(np.float32), wear))


def paint_sign(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """A shop sign: one line of large letters and an emblem."""
    ground, ink = _colour(rng, 20, 110), _colour(rng, 170, 250)
    if rng.random() < 0.4:
        ground, ink = ink, ground
    image = _to_rgb(ground * np.ones((height, width, 3), np.float32))
    emblem = image[:, :height]
    draw_shapes(rng, emblem, 5)
    draw_glyphs(
        rng,
        image,
        (int(1.1 * height), int(0.08 * height), width, int(0.98 * height)),
        ink,
        rows=1 if rng.random() < 0.6 else 2,
    )
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), _bgr(ink), max(2, height // 20))
    wear = 1 + 0.05 * smooth_noise(rng, height, width, cell=40, octaves=5)
    return _to_rgb(_shade(image.astype(np.float32), wear))


def paint_wood(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """A crate's side: boards with grain, nails, braces and a stencil."""
    base = np.array([168, 128, 84], np.float32) * rng.uniform(0.7, 1.15)
    boards = int(rng.integers(4, 7))
    y = np.arange(height)
    tone = rng.normal(1, 0.12, boards).astype(np.float32)[
        np.minimum(y * boards // height, boards - 1)
    ]
    seam = np.where((y * boards % height) < boards * 2, 0.4, 1.0)
    grain = cv2.resize(
        smooth_noise(rng, height, max(2, width // 12), cell=8, octaves=3), (width, height)
    )
    field = (tone * seam)[:, None] * (1 + 0.12 * grain)
    image = _to_rgb(_shade(np.broadcast_to(base, (height, width, 3)), field))
    for x in (0.04, 0.9):
        strip = (int(x * width), 0), (int((x + 0.07) * width), height)
        cv2.rectangle(image, strip[0], strip[1], _bgr(base * 0.75), -1)
        for row in range(boards):
            spot = (int((x + 0.035) * width), int((row + 0.5) * height / boards))
            cv2.circle(image, spot, 2, (50, 46, 42), -1, cv2.LINE_AA)
    ink = np.array([40, 34, 30], np.float32)
    box = (int(0.16 * width), int(0.3 * height), int(0.86 * width), int(0.7 * height))
    draw_glyphs(rng, image, box, ink, rows=int(rng.integers(1, 3)))
    return image


def paint_plain(rng: np.random.Generator, height: int, width: int, *, tone: float = 0.0) -> Rgb:
    """A painted surface with little on it: ledges, pipes, reveals. ``tone`` 0 chooses one."""
    level = tone or float(rng.uniform(80, 190))
    base = np.full(3, level, np.float32) * rng.uniform(0.92, 1.08, 3).astype(np.float32)
    field = 1 + 0.09 * smooth_noise(rng, height, width, cell=32, octaves=5)
    return _to_rgb(_shade(np.broadcast_to(base, (height, width, 3)), field))


def paint_glow(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """The shade of a lamp: nearly white."""
    return np.full((height, width, 3), (255, 244, 220), np.uint8)


def paint_cloth(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """A person from one side: shoes, trousers, a printed or striped coat, a head."""
    coat, legs = _colour(rng, 20, 230), _colour(rng, 20, 130)
    image = np.empty((height, width, 3), np.float32)
    image[:] = coat
    if rng.random() < 0.5:
        stripes = np.sin(np.arange(height) * rng.uniform(0.15, 0.5)) > 0.3
        image[stripes] = _colour(rng, 20, 230)
    image[int(0.52 * height) :] = legs
    image[int(0.94 * height) :] = 30
    image[: int(0.13 * height)] = (196, 156, 130)
    image[: int(0.05 * height)] = rng.uniform(20, 120)
    image[int(0.52 * height) :, int(0.47 * width) : int(0.53 * width)] *= 0.4
    picture = _to_rgb(image)
    chest = picture[int(0.18 * height) : int(0.45 * height), int(0.2 * width) : int(0.8 * width)]
    draw_shapes(rng, chest, 5)
    folds = 1 + 0.12 * smooth_noise(rng, height, width, cell=24, octaves=3)
    return _to_rgb(_shade(picture.astype(np.float32), folds))


def paint_car(rng: np.random.Generator, height: int, width: int, *, side: float = 1.0) -> Rgb:
    """A car's side (``side`` 1) or end (0): paint, wheels, windows, lamps, a number plate."""
    paint = _colour(rng, 30, 220)
    ramp = np.linspace(1.15, 0.7, height, dtype=np.float32)[:, None] * np.ones(
        (1, width), np.float32
    )
    image = _to_rgb(_shade(np.broadcast_to(paint, (height, width, 3)), ramp))
    if side:
        for x in (0.2, 0.8):
            hub = (int(x * width), int(0.92 * height))
            radius = int(0.36 * height)
            cv2.circle(image, hub, radius, (24, 24, 26), -1, cv2.LINE_AA)
            cv2.circle(image, hub, int(0.6 * radius), (150, 150, 156), -1, cv2.LINE_AA)
            for spoke in range(5):
                angle = 2 * np.pi * spoke / 5
                tip = hub + 0.55 * radius * np.array([np.cos(angle), np.sin(angle)])
                cv2.line(image, hub, (int(tip[0]), int(tip[1])), (50, 50, 52), 3, cv2.LINE_AA)
        for x in (0.33, 0.52, 0.7):
            cv2.line(image, (int(x * width), 0), (int(x * width), height), _bgr(paint * 0.5), 2)
    else:
        for x in (0.1, 0.9):
            lamp = (int(x * width), int(0.3 * height))
            cv2.circle(image, lamp, int(0.12 * height), (235, 225, 200), -1, cv2.LINE_AA)
        plate = (int(0.35 * width), int(0.55 * height), int(0.65 * width), int(0.72 * height))
        cv2.rectangle(image, plate[:2], plate[2:], (235, 235, 225), -1)
        draw_glyphs(rng, image, plate, np.full(3, 20, np.float32), rows=1)
    return image


PAINTERS: dict[str, Callable[..., Rgb]] = {
    "wall": paint_wall,
    "ground": paint_ground,
    "window": paint_window,
    "door": paint_door,
    "shutter": paint_shutter,
    "poster": paint_poster,
    "sign": paint_sign,
    "wood": paint_wood,
    "plain": paint_plain,
    "glow": paint_glow,
    "cloth": paint_cloth,
    "car": paint_car,
}
