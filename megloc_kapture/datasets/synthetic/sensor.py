"""From light to pixels: the car's bonnet, the lens, the sensor's noise and gamma."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.looks import Look, as_array
from megloc_kapture.datasets.synthetic.options import stream
from megloc_kapture.datasets.synthetic.portable import averaged, blurred, exp, resized

Float32 = NDArray[np.float32]


def develop(
    light: Float32, look: Look, supersampling: int, *, bonnet_seed: int | None
) -> NDArray[np.uint8]:
    """Image uint8 (H, W, 3) RGB of the samples' light (H * ss, W * ss, 3).

    ``bonnet_seed`` puts a car's bonnet in front; None leaves it out.
    """
    height, width = light.shape[0] // supersampling, light.shape[1] // supersampling
    if supersampling > 1:
        light = averaged(light, supersampling)
    if bonnet_seed is not None:
        cover, paint = bonnet(width, height, bonnet_seed)
        lit = as_array(look.sky) + np.float32(0.4) * as_array(look.sun)
        lit = lit + np.float32(0.04) * as_array(look.lamps)
        light = light * (1 - cover[..., None]) + paint * cover[..., None] * lit
    signal = light * (as_array(look.white_balance) * np.float32(look.exposure))
    signal *= (1 - np.float32(look.vignetting) * _corner_distance(width, height))[..., None]
    if look.condition == "night":  # light that strays around lamps
        haze = resized(blurred(averaged(np.minimum(signal, 4.0), 8), 3.0), width, height)
        signal = signal + np.float32(0.06) * haze
    signal = blurred(signal, look.blur_px)
    rng = np.random.default_rng(look.noise_seed)
    deviation = np.sqrt(look.shot_noise * signal + look.read_noise**2)
    signal = signal + deviation * rng.standard_normal(signal.shape, dtype=np.float32)
    # a shoulder instead of a hard limit, then gamma 2
    signal = np.clip(signal, 0, None)
    signal = np.where(signal > 0.7, 1 - 0.3 * exp(-(signal - 0.7) / 0.3), signal)
    return np.clip(np.sqrt(signal) * 255 + 0.5, 0, 255).astype(np.uint8)


@lru_cache(maxsize=8)
def _corner_distance(width: int, height: int) -> Float32:
    """Squared distance from the image's middle, 1 in the corners, float32 (height, width)."""
    x = (np.arange(width, dtype=np.float32) + 0.5) / width * 2 - 1
    y = (np.arange(height, dtype=np.float32) + 0.5) / height * 2 - 1
    return ((x[None] ** 2 + y[:, None] ** 2) / 2).astype(np.float32)


@lru_cache(maxsize=4)
def bonnet(width: int, height: int, seed: int) -> tuple[Float32, Float32]:
    """The bonnet as the front camera sees it: cover (H, W) 0..1 and paint (H, W, 3) linear.

    It keeps its place in the image while the world moves, and so do its seams, dirt and emblem.
    """
    x = (np.arange(width, dtype=np.float32) + 0.5) / width * 2 - 1
    y = (np.arange(height, dtype=np.float32) + 0.5) / height
    edge = 0.86 + 0.11 * x**2
    below = y[:, None] - edge[None]
    cover = np.clip(below * height + 0.5, 0, 1).astype(np.float32)
    rng = stream(seed, "bonnet")
    colour = rng.uniform(0.05, 0.35, 3).astype(np.float32)
    gloss = exp(-(((below - 0.035) / 0.02) ** 2)) * 0.5 + 0.6 + 1.5 * np.clip(below, 0, None)
    canvas = np.clip(colour * gloss[..., None], 0, 1).astype(np.float32)
    for side in (-0.42, 0.42):
        start = (int((0.5 + side * 0.6) * width), int(0.86 * height))
        stop = (int((0.5 + side) * width), height)
        cv2.line(canvas, start, stop, (0.02, 0.02, 0.02), max(1, height // 200), cv2.LINE_AA)
    for _ in range(40):
        spot = (int(rng.uniform(0, width)), int(rng.uniform(0.86, 1.0) * height))
        tone = float(rng.uniform(0.2, 0.5))
        cv2.circle(canvas, spot, int(rng.integers(1, 4)), (tone, tone, tone), -1, cv2.LINE_AA)
    emblem = (width // 2, int(0.9 * height))
    cv2.circle(canvas, emblem, height // 48, (0.7, 0.7, 0.7), -1, cv2.LINE_AA)
    cv2.circle(canvas, emblem, height // 80, (0.1, 0.1, 0.3), -1, cv2.LINE_AA)
    cover.setflags(write=False)
    canvas.setflags(write=False)
    return cover, canvas
