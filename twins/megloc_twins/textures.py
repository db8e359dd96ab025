"""Textures of houses, ground and objects, painted from a seed.

Every painter is a function ``(rng, height, width, **params) -> uint8 (height, width, 3)`` RGB.
A :class:`TextureRecipe` has a painter's name, a size and a seed, so that a world can be laid out
without painting it. Surfaces with the same recipe look the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.random import Generator

from megloc_twins.drawing import (
    TILE,
    Rgb,
    draw_cracks,
    draw_glyphs,
    draw_shapes,
    random_colour,
    shade,
    smooth_noise,
    tiled,
    to_rgb,
)
from megloc_twins.options import stream
from megloc_twins.portable import Float64, resized, sin

GROUND_TEXELS_PER_M = 80


def paint_wall(
    rng: Generator,
    height: int,
    width: int,
    *,
    material: str,
    material_seed: float,
    dirt: float = 1.0,
    graffiti: float = 0.0,
) -> Rgb:
    """Paint a wall of a shared material, with individual dirt, cracks and graffiti."""
    shift = (0, int(rng.integers(0, TILE)))
    wall = tiled(material, int(material_seed), height, width, shift)
    coarse = smooth_noise(rng, height, width, cell=160, octaves=3)
    fine = smooth_noise(rng, height, width, cell=32, octaves=2)
    patches = np.clip(smooth_noise(rng, height, width, cell=90, octaves=5) - 1.2, 0, 0.25) * 4
    streaks = smooth_noise(rng, max(2, height // 40), width, cell=12, octaves=3)
    streaks = resized(streaks, width, height, cubic=True)
    tone = 1 + dirt * (0.06 * coarse + 0.055 * fine + 0.04 * streaks)
    wall = shade(wall, np.clip(tone, 0.3, 1.6))
    patch = random_colour(rng, 90, 190, chroma=0.3)[None, None]
    share = (min(1.0, 0.75 * dirt) * patches)[..., None]
    wall = wall * (1 - share) + patch * share
    image = to_rgb(wall)
    draw_cracks(rng, image, int(dirt * width * height / 25000))
    for _ in range(int(graffiti)):
        w = int(rng.uniform(0.12, 0.3) * width)
        h = int(rng.uniform(0.12, 0.22) * height)
        x = int(rng.uniform(0, max(1, width - w)))
        y = int(rng.uniform(0.6 * height, max(0.6 * height + 1, height - h)))
        draw_glyphs(rng, image, (x, y, x + w, y + h), random_colour(rng, 10, 240), rows=1)
    return image


def paint_ground(
    rng: Generator, height: int, width: int, *, material: str, material_seed: float
) -> Rgb:
    """Paint paving or asphalt with patches, lines, manholes and leaves."""
    density = GROUND_TEXELS_PER_M
    ground = tiled(material, int(material_seed), height, width, (0, 0))
    coarse = smooth_noise(rng, height, width, cell=200, octaves=4)
    fine = smooth_noise(rng, height, width, cell=32, octaves=2)
    ground = shade(ground, np.clip(1 + (0.08 * coarse + 0.06 * fine), 0.3, 1.6))
    image = to_rgb(ground)
    area_m2 = height * width / density**2
    for _ in range(int(area_m2 / 14)):  # repaired patches
        w, h = rng.uniform(0.4, 1.8, 2) * density
        centre = rng.uniform((0, 0), (width, height)).tolist()
        turn = float(rng.choice([0, 90, rng.uniform(0, 90)]))
        corners = cv2.boxPoints((centre, (float(w), float(h)), turn))
        box = np.round(corners * 16).astype(np.int32)
        tone = float(rng.uniform(60, 130))
        cv2.fillPoly(image, [box], (tone, tone, tone + 3), cv2.LINE_AA, 4)
    for _ in range(2 + int(area_m2 / 60)):
        size = int(0.7 * density)
        x, y = int(rng.uniform(0, width - size)), int(rng.uniform(0, height - size))
        # all manholes of a material look alike
        image[y : y + size, x : x + size] = _manhole(stream(int(material_seed), "manhole"), size)
    for _ in range(int(area_m2 / 50)):
        start = rng.uniform((0, 0), (width, height))
        angle = rng.choice([0, np.pi / 2, rng.uniform(0, np.pi)])
        stop = start + np.array([np.cos(angle), np.sin(angle)]) * rng.uniform(2, 5) * density
        begin, end = ((int(x), int(y)) for x, y in (start, stop))
        paint = float(rng.uniform(170, 225))
        cv2.line(image, begin, end, (paint, paint, paint), int(0.12 * density), cv2.LINE_AA)
    for _ in range(int(area_m2 * 2.5)):  # leaves, litter
        x, y = (int(v) for v in rng.uniform((0, 0), (width, height)))
        a, b = (max(1, int(axis)) for axis in rng.uniform(0.02, 0.06, 2) * density)
        colour = random_colour(rng, 20, 230).tolist()
        turn = float(rng.uniform(0, 180))
        cv2.ellipse(image, (x, y), (a, b), turn, 0, 360, colour, -1, cv2.LINE_AA)
    return _worn(rng, image, 0.04, cell=12, octaves=1)


def _worn(rng: Generator, image: Rgb, strength: float, *, cell: float, octaves: int) -> Rgb:
    noise = smooth_noise(rng, *image.shape[:2], cell=cell, octaves=octaves)
    return to_rgb(shade(image.astype(np.float32), 1 + strength * noise))


def _disc(image: Rgb, centre: tuple[int, int], radius: int, colour: tuple[float, ...]) -> None:
    cv2.circle(image, centre, radius, colour, -1, cv2.LINE_AA)


def _manhole(rng: Generator, size: int) -> Rgb:
    image = np.full((size, size, 3), 96, np.uint8)
    centre, radius = (size // 2, size // 2), size // 2 - 2
    _disc(image, centre, radius, (58, 56, 54))
    for _ in range(14):
        x, y = (rng.normal(0, 0.2, 2) * size + size / 2).astype(int).tolist()
        _disc(image, (x, y), max(1, size // 20), (128, 124, 118))
    cv2.circle(image, centre, radius - 2, (140, 136, 128), 2, cv2.LINE_AA)
    return image


def paint_window(rng: Generator, height: int, width: int) -> Rgb:
    """Paint a window: frame, panes and objects behind them."""
    frame = random_colour(rng, 90, 235, chroma=0.35)
    glass = np.array([58, 72, 88], np.float32) * rng.uniform(0.6, 1.3)
    ramp = np.linspace(1.35, 0.7, height, dtype=np.float32)[:, None]
    cloud = 1 + 0.22 * smooth_noise(rng, height, width, cell=50, octaves=4)
    image = to_rgb(shade(glass, ramp * cloud))
    if rng.random() < 0.6:  # curtains with folds
        part = int(width * rng.uniform(0.15, 0.35))
        folds = 1 + 0.25 * sin(np.arange(part) * rng.uniform(0.3, 0.7))
        cloth = random_colour(rng, 110, 220, chroma=0.4) * folds[:, None]
        image[:, :part] = cloth.clip(0, 255).astype(np.uint8)
        image[:, width - part :] = image[:, :part][:, ::-1]
    for _ in range(int(rng.integers(1, 4))):  # plants, lamps and vases on the sill
        x, w = int(rng.uniform(0.1, 0.8) * width), int(rng.uniform(0.08, 0.2) * width)
        h = int(rng.uniform(0.1, 0.35) * height)
        colour = random_colour(rng, 30, 225).tolist()
        cv2.ellipse(image, (x, height - h // 2), (w, h), 0, 0, 360, colour, -1)
    bar = max(3, width // 18)
    colour = frame.tolist()
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), colour, 2 * bar)
    rows, cols = int(rng.integers(1, 4)), int(rng.integers(2, 4))
    for i in range(1, cols):
        x = i * width // cols
        cv2.rectangle(image, (x - bar // 2, 0), (x + bar // 2, height), colour, -1)
    for j in range(1, rows + 1):
        y = j * height // (rows + 1)
        cv2.rectangle(image, (0, y - bar // 2), (width, y + bar // 2), colour, -1)
    return _worn(rng, image, 0.04, cell=8, octaves=2)


def paint_door(rng: Generator, height: int, width: int) -> Rgb:
    """Paint a door of planks or panels with a handle and a number plate."""
    base = random_colour(rng, 40, 150, chroma=0.6)
    planks = int(rng.integers(4, 9))
    tone = _planks(rng, planks, width, seam=0.5)
    grain = smooth_noise(rng, max(2, height // 16), width, cell=6, octaves=2)
    field = tone[None] * (1 + 0.09 * resized(grain, width, height))
    image = to_rgb(shade(base, field))
    for _ in range(int(rng.integers(1, 4))):
        x0, x1 = (int(x) for x in np.sort(rng.uniform(0.08, 0.92, 2)) * width)
        y0, y1 = (int(y) for y in np.sort(rng.uniform(0.05, 0.95, 2)) * height)
        cv2.rectangle(image, (x0, y0), (x1, y1), (base * 0.5).tolist(), max(2, width // 30))
    bar = max(3, width // 16)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (base * 0.45).tolist(), bar)
    knob = (int(0.86 * width), int(0.52 * height))
    _disc(image, knob, max(3, width // 22), (214, 190, 110))
    plate = (int(0.3 * width), int(0.14 * height), int(0.7 * width), int(0.24 * height))
    cv2.rectangle(image, plate[:2], plate[2:], (225, 222, 210), -1)
    draw_glyphs(rng, image, plate, np.array([20, 30, 90], np.float32), rows=1)
    return image


def _planks(rng: Generator, count: int, texels: int, *, seam: float) -> Float64:
    """Return the tones (texels,) of adjacent boards, each with a dark seam at its beginning."""
    tone = rng.normal(1, 0.12, count).astype(np.float32)
    at = np.arange(texels)
    seams = np.where((at * count % texels) < count * 2, seam, 1.0)
    return np.asarray(tone[np.minimum(at * count // texels, count - 1)] * seams, np.float64)


def paint_shutter(rng: Generator, height: int, width: int) -> Rgb:
    """Paint a rolling shutter: horizontal slats with graffiti."""
    base = random_colour(rng, 110, 200, chroma=0.3)
    slats = 1 + 0.18 * sin(np.arange(height) * (2 * np.pi / 11))
    dirt = 1 + 0.09 * smooth_noise(rng, height, width, cell=40, octaves=4)
    image = to_rgb(shade(base, slats[:, None] * dirt))
    box = (int(0.08 * width), int(0.3 * height), int(0.95 * width), int(0.85 * height))
    draw_glyphs(rng, image, box, random_colour(rng, 10, 240), rows=int(rng.integers(1, 3)))
    return image


def paint_plain(rng: Generator, height: int, width: int) -> Rgb:
    base = np.full(3, rng.uniform(80, 190), np.float32)
    base *= rng.uniform(0.92, 1.08, 3).astype(np.float32)
    field = 1 + 0.09 * smooth_noise(rng, height, width, cell=32, octaves=5)
    return to_rgb(shade(base, field))


def paint_glow(rng: Generator, height: int, width: int) -> Rgb:
    """Paint a lamp shade: nearly white."""
    return np.full((height, width, 3), (255, 244, 220), np.uint8)


def paint_poster(rng: Generator, height: int, width: int) -> Rgb:
    """Paint a poster: shapes, a headline and small print on a coloured ground."""
    low, high = random_colour(rng, 20, 240), random_colour(rng, 20, 240)
    ramp = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    image = to_rgb((low * (1 - ramp) + high * ramp) * np.ones((1, width, 1), np.float32))
    draw_shapes(rng, image, int(rng.integers(6, 14)))
    ink = random_colour(rng, 0, 80) if rng.random() < 0.5 else random_colour(rng, 200, 255)
    margin = int(0.07 * width)
    head = int(height * rng.uniform(0.05, 0.5))
    box = (margin, head, width - margin, head + int(0.16 * height))
    draw_glyphs(rng, image, box, ink, rows=1)
    small = (margin, int(0.78 * height), width - margin, int(0.96 * height))
    draw_glyphs(rng, image, small, ink, rows=int(rng.integers(3, 6)))
    border = max(2, width // 40)
    tone = 240 if rng.random() < 0.6 else 25
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (tone, tone, tone), border)
    return _worn(rng, image, 0.05, cell=50, octaves=5)


def paint_sign(rng: Generator, height: int, width: int) -> Rgb:
    """Paint a shop sign: one line of large letters and an emblem."""
    ground, ink = random_colour(rng, 20, 110), random_colour(rng, 170, 250)
    if rng.random() < 0.4:
        ground, ink = ink, ground
    image = to_rgb(ground * np.ones((height, width, 3), np.float32))
    draw_shapes(rng, image[:, :height], 5)
    box = (int(1.1 * height), int(0.08 * height), width, int(0.98 * height))
    draw_glyphs(rng, image, box, ink, rows=1 if rng.random() < 0.6 else 2)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), ink.tolist(), max(2, height // 20))
    return _worn(rng, image, 0.05, cell=40, octaves=5)


def paint_wood(rng: Generator, height: int, width: int) -> Rgb:
    """Paint a crate's side: boards with grain, nails, braces and a stencil."""
    base = np.array([168, 128, 84], np.float32) * rng.uniform(0.7, 1.15)
    boards = int(rng.integers(4, 7))
    tone = _planks(rng, boards, height, seam=0.4)
    grain = smooth_noise(rng, height, max(2, width // 12), cell=8, octaves=3)
    field = tone[:, None] * (1 + 0.12 * resized(grain, width, height))
    image = to_rgb(shade(base, field))
    for x in (0.04, 0.9):
        end = (int((x + 0.07) * width), height)
        cv2.rectangle(image, (int(x * width), 0), end, (base * 0.75).tolist(), -1)
        for row in range(boards):
            spot = (int((x + 0.035) * width), int((row + 0.5) * height / boards))
            _disc(image, spot, 2, (50, 46, 42))
    ink = np.array([40, 34, 30], np.float32)
    box = (int(0.16 * width), int(0.3 * height), int(0.86 * width), int(0.7 * height))
    draw_glyphs(rng, image, box, ink, rows=int(rng.integers(1, 3)))
    return image


def paint_cloth(rng: Generator, height: int, width: int) -> Rgb:
    """Paint a person from one side: shoes, trousers, a printed or striped coat, a head."""
    coat, legs = random_colour(rng, 20, 230), random_colour(rng, 20, 130)
    image = np.tile(coat, (height, width, 1))
    if rng.random() < 0.5:
        stripes = np.sin(np.arange(height) * rng.uniform(0.15, 0.5)) > 0.3
        image[stripes] = random_colour(rng, 20, 230)
    image[int(0.52 * height) :] = legs
    image[int(0.94 * height) :] = 30
    image[: int(0.13 * height)] = (196, 156, 130)
    image[: int(0.05 * height)] = rng.uniform(20, 120)
    image[int(0.52 * height) :, int(0.47 * width) : int(0.53 * width)] *= 0.4
    picture = to_rgb(image)
    chest = picture[int(0.18 * height) : int(0.45 * height), int(0.2 * width) : int(0.8 * width)]
    draw_shapes(rng, chest, 5)
    return _worn(rng, picture, 0.12, cell=32, octaves=2)


def paint_car(rng: Generator, height: int, width: int, *, side: float = 1.0) -> Rgb:
    """Paint a car's side (``side`` 1) or end (0): paint, wheels, windows, lamps, a number plate."""
    paint = random_colour(rng, 30, 220)
    ramp = np.linspace(1.15, 0.7, height, dtype=np.float32)[:, None]
    image = to_rgb(shade(np.broadcast_to(paint, (height, width, 3)), ramp))
    if side:
        for x in (0.2, 0.8):
            hub = (int(x * width), int(0.92 * height))
            radius = int(0.36 * height)
            _disc(image, hub, radius, (24, 24, 26))
            _disc(image, hub, int(0.6 * radius), (150, 150, 156))
            for spoke in range(5):
                angle = 2 * np.pi * spoke / 5
                tip = hub + 0.55 * radius * np.array([np.cos(angle), np.sin(angle)])
                cv2.line(image, hub, (int(tip[0]), int(tip[1])), (50, 50, 52), 3, cv2.LINE_AA)
        for share in (0.33, 0.52, 0.7):
            at = int(share * width)
            cv2.line(image, (at, 0), (at, height), (paint * 0.5).tolist(), 2)
    else:
        for x in (0.1, 0.9):
            lamp = (int(x * width), int(0.3 * height))
            _disc(image, lamp, int(0.12 * height), (235, 225, 200))
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
    "plain": paint_plain,
    "glow": paint_glow,
    "poster": paint_poster,
    "sign": paint_sign,
    "wood": paint_wood,
    "cloth": paint_cloth,
    "car": paint_car,
}


@dataclass(frozen=True)
class TextureRecipe:
    painter: str  # a name in PAINTERS
    width: int  # texels
    height: int
    seed: int
    params: tuple[tuple[str, str | float], ...] = ()  # further arguments of the painter

    def paint(self) -> Rgb:
        rng = stream(self.seed, self.painter)
        return PAINTERS[self.painter](rng, self.height, self.width, **dict(self.params))


def index_of(recipe: TextureRecipe, recipes: list[TextureRecipe]) -> int:
    """Return the recipe's index in a list; append it if new."""
    if recipe not in recipes:
        recipes.append(recipe)
    return recipes.index(recipe)


def texels(size_m: tuple[float, float], per_m: float) -> tuple[int, int]:
    """Return width and height of the texture of a surface."""
    width, height = (max(8, int(round(side * per_m))) for side in size_m)
    return width, height
