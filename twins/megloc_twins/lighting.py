"""Light and sensor of an image: by day and night, and in the weathers of a road dataset."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from megloc_twins.portable import exp, settled

Triple = tuple[float, float, float]
Condition = Literal["day", "night"]


@dataclass(frozen=True)
class Lighting:
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


def day_lighting(
    rng: np.random.Generator, *, azimuth: float, elevation: float, overcast: float, noise_seed: int
) -> Lighting:
    """Daylight: the sun at ``azimuth`` and ``elevation`` (radians, place's frame), dimmed by
    clouds (``overcast`` 0..1); exposure and white balance vary a little from image to image."""
    cos = np.cos(elevation)
    direction = np.array([cos * np.cos(azimuth), cos * np.sin(azimuth), np.sin(elevation)])
    sun = np.array([1.0, 0.94, 0.84]) * 1.25 * (1 - overcast)
    sky = np.array([0.66, 0.70, 0.78]) * (0.85 + 0.45 * overcast)
    sky_colour = np.array([0.45, 0.62, 0.95]) * (1 - overcast) + 0.85 * overcast
    return Lighting(
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


def night_lighting(rng: np.random.Generator, *, exposure: float, noise_seed: int) -> Lighting:
    """Night: warm lamps, a little blue from the sky, a slow and noisy sensor."""
    lamp = np.array([1.0, 0.74, 0.42]) * rng.uniform(0.8, 1.2)
    return Lighting(
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


@dataclass(frozen=True)
class Weather:
    """A traversal's light and lens.

    Parameters
    ----------
    elevation_deg : of the sun above the horizon; None at night.
    overcast : 0..1, how much clouds dim the sun.
    tint : RGB factor on the sun's light by day, on the camera's white balance at night.
    cast : RGB factor on the camera's white balance by day.
    brightness : factor on the exposure.
    blur_px : deviation of the blur of lens, drops and motion; None leaves the lighting's own.
    noise : factor on the variance of the sensor's noise.
    """

    elevation_deg: float | None
    overcast: float = 0.0
    tint: Triple = (1.0, 1.0, 1.0)
    cast: Triple = (1.0, 1.0, 1.0)
    brightness: float = 1.0
    blur_px: float | None = None
    noise: float = 1.0

    @property
    def is_night(self) -> bool:
        """Only lamps and windows give light."""
        return self.elevation_deg is None


WEATHERS: dict[str, Weather] = {
    "overcast-reference": Weather(50.0, overcast=0.8),
    "dawn": Weather(14.0, tint=(1.0, 0.7, 0.45), cast=(1.06, 0.98, 0.95), brightness=1.15),
    "overcast-winter": Weather(20.0, overcast=1.0, cast=(0.95, 0.99, 1.07), brightness=0.85),
    "rain": Weather(
        35.0, overcast=1.0, cast=(0.97, 1.0, 1.04), brightness=0.75, blur_px=0.8, noise=4.0
    ),
    "sun": Weather(42.0, overcast=0.05),
    "night": Weather(None),
    "night-rain": Weather(None, brightness=0.8, blur_px=1.1, noise=1.5),
}


def road_lighting(
    condition: str,
    rng: np.random.Generator,
    *,
    azimuth: float,
    noise_seed: int,
    night_exposure: float = 1.0,
) -> Lighting:
    """The lighting of one image of a traversal.

    Parameters
    ----------
    condition : a name in :data:`WEATHERS`.
    rng : exposure and white balance vary a little from image to image.
    azimuth : of the sun, radians, in the place's frame.
    noise_seed : of the sensor's noise.
    night_exposure : light that reaches the sensor at night, relative.

    Raises
    ------
    KeyError : no such condition.
    """
    weather = WEATHERS[condition]
    if weather.elevation_deg is None:
        lighting = night_lighting(rng, exposure=night_exposure, noise_seed=noise_seed)
    else:
        lighting = day_lighting(
            rng,
            azimuth=azimuth,
            elevation=float(np.radians(weather.elevation_deg)),
            overcast=weather.overcast,
            noise_seed=noise_seed,
        )
        lighting = replace(lighting, sun=_product(lighting.sun, weather.tint))
    cast = weather.tint if weather.is_night else weather.cast
    return replace(
        lighting,
        white_balance=_product(lighting.white_balance, cast),
        exposure=lighting.exposure * weather.brightness,
        blur_px=lighting.blur_px if weather.blur_px is None else weather.blur_px,
        shot_noise=lighting.shot_noise * weather.noise,
        read_noise=lighting.read_noise * weather.noise**0.5,
    )


def _product(a: Triple, b: Triple) -> Triple:
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]
