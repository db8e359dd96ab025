"""Colours, letters, shapes and cracks to paint textures with; arrays are RGB."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.noise import Field2D

Rgb = NDArray[np.uint8]
Colour = NDArray[np.float32]  # (3,), 0..255
Picture = NDArray[np.float32]  # (H, W, 3), 0..255


def random_colour(
    rng: np.random.Generator, low: float = 30, high: float = 225, *, chroma: float = 0.75
) -> Colour:
    """A random colour; ``chroma`` 0 is grey, 1 as strong as its channels' range allows."""
    channels = rng.uniform(low, high, 3)
    return (channels.mean() + chroma * (channels - channels.mean())).astype(np.float32)


def to_rgb(image: Picture) -> Rgb:
    """Round to uint8, cutting off what is below 0 or above 255."""
    return np.clip(image + 0.5, 0, 255).astype(np.uint8)


def shade(image: Picture, factor: Field2D) -> Picture:
    """The picture times a field (H, W)."""
    return image * factor[..., None]


def cv_colour(colour: Colour) -> tuple[float, float, float]:
    """A colour as OpenCV's drawing functions take it."""
    return float(colour[0]), float(colour[1]), float(colour[2])


def draw_glyphs(
    rng: np.random.Generator,
    image: Rgb,
    box: tuple[int, int, int, int],
    colour: Colour,
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
                image,
                [stroke],
                bool(rng.random() < 0.3),
                cv_colour(colour),
                thickness,
                cv2.LINE_AA,
                4,
            )
            x += 0.85 * size


def draw_shapes(rng: np.random.Generator, image: Rgb, count: int) -> None:
    """Draw random discs, polygons, rings and bars over the image, in place."""
    height, width = image.shape[:2]
    extent = min(height, width)
    for _ in range(count):
        kind = int(rng.integers(0, 4))
        colour = cv_colour(random_colour(rng, 10, 245))
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


def draw_cracks(rng: np.random.Generator, image: Rgb, count: int) -> None:
    """Draw thin dark wandering lines over the image, in place."""
    height, width = image.shape[:2]
    for _ in range(count):
        steps = rng.normal(0, 5, (int(rng.integers(10, 40)), 2)) + rng.normal(0, 3, 2)
        start = rng.uniform((0, 0), (width, height))
        points = np.round((start + np.cumsum(steps, 0)) * 16).astype(np.int32)
        tone = float(rng.uniform(30, 80))
        cv2.polylines(image, [points], False, (tone, tone, tone), 1, cv2.LINE_AA, 4)
