"""Times of day: where the light comes from, and what the camera makes of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.portable import exp, settled

Triple = tuple[float, float, float]
Condition = Literal["day", "night"]


@dataclass(frozen=True)
class Look:
    """Light and sensor of one image.

    Parameters
    ----------
    condition : what the image counts as.
    sun_direction : unit vector towards the sun, in the place's frame.
    sun : RGB light of the sun on a surface that faces it.
    sky : RGB light from above; surfaces that look down get less.
    lamps : RGB light of a lamp at one metre; zero by day.
    glow : RGB light that surfaces with a glow of their own give off.
    sky_colour : RGB radiance of the sky.
    cloud_shift : turn of the clouds, radians.
    exposure : factor between radiance and the sensor's signal, where 1 saturates.
    white_balance : RGB gain, the colour cast.
    shot_noise : variance of the signal per signal.
    read_noise : deviation of the signal in the dark.
    blur_px : deviation of the Gaussian blur of lens and hand.
    vignetting : loss of light in the corner, 0..1.
    noise_seed : of the sensor's noise.
    """

    condition: Condition
    sun_direction: Triple
    sun: Triple
    sky: Triple
    lamps: Triple
    glow: Triple
    sky_colour: Triple
    cloud_shift: float
    exposure: float
    white_balance: Triple
    shot_noise: float
    read_noise: float
    blur_px: float
    vignetting: float
    noise_seed: int


def as_array(values: Triple) -> NDArray[np.float32]:
    """float32 (3,)."""
    return np.array(values, np.float32)


def _triple(values: NDArray[np.float64]) -> Triple:
    r, g, b = settled(values).tolist()
    return r, g, b


def day_look(
    rng: np.random.Generator,
    *,
    azimuth: float,
    elevation: float,
    overcast: float,
    noise_seed: int,
) -> Look:
    """Daylight: the sun at ``azimuth`` and ``elevation`` (radians, place's frame), dimmed by
    clouds (``overcast`` 0..1); exposure and white balance vary a little from image to image."""
    cos = np.cos(elevation)
    direction = np.array([cos * np.cos(azimuth), cos * np.sin(azimuth), np.sin(elevation)])
    sun = np.array([1.0, 0.94, 0.84]) * 1.25 * (1 - overcast)
    sky = np.array([0.66, 0.70, 0.78]) * (0.85 + 0.45 * overcast)
    sky_colour = np.array([0.45, 0.62, 0.95]) * (1 - overcast) + 0.85 * overcast
    return Look(
        condition="day",
        sun_direction=_triple(direction),
        sun=_triple(sun),
        sky=_triple(sky),
        lamps=(0.0, 0.0, 0.0),
        glow=(0.0, 0.0, 0.0),
        sky_colour=_triple(sky_colour),
        cloud_shift=float(rng.uniform(0, 2 * np.pi)),
        exposure=float(0.85 * exp(rng.normal(0, 0.12))),
        white_balance=_triple(np.exp(rng.normal(0, 0.03, 3))),
        shot_noise=4e-5,
        read_noise=0.002,
        blur_px=0.5,
        vignetting=0.12,
        noise_seed=noise_seed,
    )


def night_look(rng: np.random.Generator, *, exposure: float, noise_seed: int) -> Look:
    """Night: warm lamps, a little blue from the sky, a slow and noisy sensor."""
    lamp = np.array([1.0, 0.74, 0.42]) * rng.uniform(0.8, 1.2)
    return Look(
        condition="night",
        sun_direction=(0.0, 0.0, 1.0),
        sun=(0.0, 0.0, 0.0),
        sky=_triple(np.array([0.014, 0.016, 0.022]) * rng.uniform(0.7, 1.3)),
        lamps=_triple(lamp),
        glow=_triple(np.array([1.0, 0.85, 0.6])),
        sky_colour=(0.006, 0.008, 0.016),
        cloud_shift=float(rng.uniform(0, 2 * np.pi)),
        exposure=float(exposure * 0.65 * exp(rng.normal(0, 0.25))),
        white_balance=_triple(np.array([1.0, 0.92, 0.86]) * np.exp(rng.normal(0, 0.05, 3))),
        shot_noise=2.2e-3,
        read_noise=0.006,
        blur_px=float(rng.uniform(0.7, 1.1)),
        vignetting=0.3,
        noise_seed=noise_seed,
    )
