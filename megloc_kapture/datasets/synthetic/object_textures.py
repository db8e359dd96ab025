"""Textures of things: posters, signs, crates, people and cars."""

from __future__ import annotations

import cv2
import numpy as np

from megloc_kapture.datasets.synthetic.drawing import (
    Rgb,
    cv_colour,
    draw_glyphs,
    draw_shapes,
    random_colour,
    shade,
    to_rgb,
)
from megloc_kapture.datasets.synthetic.noise import smooth_noise
from megloc_kapture.datasets.synthetic.portable import resized


def paint_poster(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """A poster: shapes, a headline and small print on a coloured ground."""
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
    wear = 1 + 0.05 * smooth_noise(rng, height, width, cell=50, octaves=5)
    return to_rgb(shade(image.astype(np.float32), wear))


def paint_sign(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """A shop sign: one line of large letters and an emblem."""
    ground, ink = random_colour(rng, 20, 110), random_colour(rng, 170, 250)
    if rng.random() < 0.4:
        ground, ink = ink, ground
    image = to_rgb(ground * np.ones((height, width, 3), np.float32))
    emblem = image[:, :height]
    draw_shapes(rng, emblem, 5)
    draw_glyphs(
        rng,
        image,
        (int(1.1 * height), int(0.08 * height), width, int(0.98 * height)),
        ink,
        rows=1 if rng.random() < 0.6 else 2,
    )
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), cv_colour(ink), max(2, height // 20))
    wear = 1 + 0.05 * smooth_noise(rng, height, width, cell=40, octaves=5)
    return to_rgb(shade(image.astype(np.float32), wear))


def paint_wood(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """A crate's side: boards with grain, nails, braces and a stencil."""
    base = np.array([168, 128, 84], np.float32) * rng.uniform(0.7, 1.15)
    boards = int(rng.integers(4, 7))
    y = np.arange(height)
    tone = rng.normal(1, 0.12, boards).astype(np.float32)[
        np.minimum(y * boards // height, boards - 1)
    ]
    seam = np.where((y * boards % height) < boards * 2, 0.4, 1.0)
    grain = smooth_noise(rng, height, max(2, width // 12), cell=8, octaves=3)
    grain = resized(grain, width, height)
    field = (tone * seam)[:, None] * (1 + 0.12 * grain)
    image = to_rgb(shade(np.broadcast_to(base, (height, width, 3)), field))
    for x in (0.04, 0.9):
        strip = (int(x * width), 0), (int((x + 0.07) * width), height)
        cv2.rectangle(image, strip[0], strip[1], cv_colour(base * 0.75), -1)
        for row in range(boards):
            spot = (int((x + 0.035) * width), int((row + 0.5) * height / boards))
            cv2.circle(image, spot, 2, (50, 46, 42), -1, cv2.LINE_AA)
    ink = np.array([40, 34, 30], np.float32)
    box = (int(0.16 * width), int(0.3 * height), int(0.86 * width), int(0.7 * height))
    draw_glyphs(rng, image, box, ink, rows=int(rng.integers(1, 3)))
    return image


def paint_cloth(rng: np.random.Generator, height: int, width: int) -> Rgb:
    """A person from one side: shoes, trousers, a printed or striped coat, a head."""
    coat, legs = random_colour(rng, 20, 230), random_colour(rng, 20, 130)
    image = np.empty((height, width, 3), np.float32)
    image[:] = coat
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
    folds = 1 + 0.12 * smooth_noise(rng, height, width, cell=32, octaves=2)
    return to_rgb(shade(picture.astype(np.float32), folds))


def paint_car(rng: np.random.Generator, height: int, width: int, *, side: float = 1.0) -> Rgb:
    """A car's side (``side`` 1) or end (0): paint, wheels, windows, lamps, a number plate."""
    paint = random_colour(rng, 30, 220)
    ramp = np.linspace(1.15, 0.7, height, dtype=np.float32)[:, None] * np.ones(
        (1, width), np.float32
    )
    image = to_rgb(shade(np.broadcast_to(paint, (height, width, 3)), ramp))
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
            cv2.line(
                image, (int(x * width), 0), (int(x * width), height), cv_colour(paint * 0.5), 2
            )
    else:
        for x in (0.1, 0.9):
            lamp = (int(x * width), int(0.3 * height))
            cv2.circle(image, lamp, int(0.12 * height), (235, 225, 200), -1, cv2.LINE_AA)
        plate = (int(0.35 * width), int(0.55 * height), int(0.65 * width), int(0.72 * height))
        cv2.rectangle(image, plate[:2], plate[2:], (235, 235, 225), -1)
        draw_glyphs(rng, image, plate, np.full(3, 20, np.float32), rows=1)
    return image
