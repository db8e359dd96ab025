"""Textures of houses and ground: walls, paving, windows, doors, shutters, plain surfaces."""

from __future__ import annotations

import cv2
import numpy as np

from megloc_kapture.datasets.synthetic.drawing import (
    Rgb,
    cv_colour,
    draw_cracks,
    draw_glyphs,
    random_colour,
    shade,
    to_rgb,
)
from megloc_kapture.datasets.synthetic.materials import TILE, tiled
from megloc_kapture.datasets.synthetic.noise import smooth_noise
from megloc_kapture.datasets.synthetic.options import stream
from megloc_kapture.datasets.synthetic.portable import resized, sin


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
    ground = tiled(material, int(material_seed), height, width, (0, 0))
    coarse = smooth_noise(rng, height, width, cell=200, octaves=4)
    fine = smooth_noise(rng, height, width, cell=32, octaves=2)
    ground = shade(ground, np.clip(1 + dirt * (0.08 * coarse + 0.06 * fine), 0.3, 1.6))
    image = to_rgb(ground)
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
    for _ in range(2 + int(area_m2 / 60)):
        size = int(0.7 * density)
        x, y = int(rng.uniform(0, width - size)), int(rng.uniform(0, height - size))
        # all of one kind, like the paving
        image[y : y + size, x : x + size] = _manhole(stream(int(material_seed), "manhole"), size)
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
        colour = cv_colour(random_colour(rng, 20, 230))
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
    grain = 1 + 0.04 * smooth_noise(rng, height, width, cell=12, octaves=1)
    return to_rgb(shade(image.astype(np.float32), grain))


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
    frame = random_colour(rng, 90, 235, chroma=0.35)
    glass = np.array([58, 72, 88], np.float32) * rng.uniform(0.6, 1.3)
    ramp = np.linspace(1.35, 0.7, height, dtype=np.float32)[:, None] * np.ones(
        (1, width), np.float32
    )
    cloud = 1 + 0.22 * smooth_noise(rng, height, width, cell=50, octaves=4)
    image = to_rgb(shade(np.broadcast_to(glass, (height, width, 3)), ramp * cloud))
    if rng.random() < 0.6:  # curtains with folds
        part = int(width * rng.uniform(0.15, 0.35))
        folds = 1 + 0.25 * sin(np.arange(part) * rng.uniform(0.3, 0.7))
        cloth = (
            (random_colour(rng, 110, 220, chroma=0.4) * folds[:, None])
            .clip(0, 255)
            .astype(np.uint8)
        )
        image[:, :part] = cloth[None]
        image[:, width - part :] = cloth[None, ::-1]
    for _ in range(int(rng.integers(1, 4))):  # plants, lamps, vases on the sill
        x, w = int(rng.uniform(0.1, 0.8) * width), int(rng.uniform(0.08, 0.2) * width)
        h = int(rng.uniform(0.1, 0.35) * height)
        cv2.ellipse(
            image, (x, height - h // 2), (w, h), 0, 0, 360, cv_colour(random_colour(rng)), -1
        )
    bar = max(3, width // 18)
    colour = cv_colour(frame)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), colour, 2 * bar)
    rows, cols = int(rng.integers(1, 4)), int(rng.integers(2, 4))
    for i in range(1, cols):
        x = i * width // cols
        cv2.rectangle(image, (x - bar // 2, 0), (x + bar // 2, height), colour, -1)
    for j in range(1, rows + 1):
        y = j * height // (rows + 1)
        cv2.rectangle(image, (0, y - bar // 2), (width, y + bar // 2), colour, -1)
    grain = 1 + 0.04 * smooth_noise(rng, height, width, cell=8, octaves=2)
    return to_rgb(shade(image.astype(np.float32), grain))


def paint_door(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """A door of planks or panels with a handle and a number plate."""
    base = random_colour(rng, 40, 150, chroma=0.6)
    planks = int(rng.integers(4, 9))
    tone = rng.normal(1, 0.12, planks).astype(np.float32)
    x = np.arange(width)
    column = tone[np.minimum(x * planks // width, planks - 1)]
    seam = np.where((x * planks % width) < planks * 2, 0.5, 1.0)
    grain = smooth_noise(rng, max(2, height // 16), width, cell=6, octaves=2)
    grain = resized(grain, width, height)
    image = to_rgb(
        shade(
            base * np.ones((height, width, 3), np.float32),
            (column * seam)[None] * (1 + 0.09 * grain),
        )
    )
    for _ in range(int(rng.integers(1, 4))):
        x0, x1 = np.sort(rng.uniform(0.08, 0.92, 2)) * width
        y0, y1 = np.sort(rng.uniform(0.05, 0.95, 2)) * height
        corners = (int(x0), int(y0)), (int(x1), int(y1))
        cv2.rectangle(image, corners[0], corners[1], cv_colour(base * 0.5), max(2, width // 30))
    bar = max(3, width // 16)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), cv_colour(base * 0.45), bar)
    knob = (int(0.86 * width), int(0.52 * height))
    cv2.circle(image, knob, max(3, width // 22), (214, 190, 110), -1, cv2.LINE_AA)
    plate = (int(0.3 * width), int(0.14 * height), int(0.7 * width), int(0.24 * height))
    cv2.rectangle(image, plate[:2], plate[2:], (225, 222, 210), -1)
    draw_glyphs(rng, image, plate, np.array([20, 30, 90], np.float32), rows=1)
    return image


def paint_shutter(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """A rolling shutter: horizontal slats, with a graffito."""
    base = random_colour(rng, 110, 200, chroma=0.3)
    slats = 1 + 0.18 * sin(np.arange(height) * (2 * np.pi / 11))
    dirt = 1 + 0.09 * smooth_noise(rng, height, width, cell=40, octaves=4)
    image = to_rgb(shade(np.broadcast_to(base, (height, width, 3)), slats[:, None] * dirt))
    box = (int(0.08 * width), int(0.3 * height), int(0.95 * width), int(0.85 * height))
    draw_glyphs(rng, image, box, random_colour(rng, 10, 240), rows=int(rng.integers(1, 3)))
    return image


def paint_plain(rng: np.random.Generator, height: int, width: int, *, tone: float = 0.0) -> Rgb:
    """A painted surface with little on it: ledges, pipes, reveals. ``tone`` 0 chooses one."""
    level = tone or float(rng.uniform(80, 190))
    base = np.full(3, level, np.float32) * rng.uniform(0.92, 1.08, 3).astype(np.float32)
    field = 1 + 0.09 * smooth_noise(rng, height, width, cell=32, octaves=5)
    return to_rgb(shade(np.broadcast_to(base, (height, width, 3)), field))


def paint_glow(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """The shade of a lamp: nearly white."""
    return np.full((height, width, 3), (255, 244, 220), np.uint8)
