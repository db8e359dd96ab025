"""The weathers and times of day of a road dataset: what the same street looks like under them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from megloc_kapture.datasets.synthetic.looks import Look, Triple, day_look, night_look


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
    blur_px : deviation of the blur of lens, drops and motion; None leaves the look's own.
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
        """Whether only lamps and windows give light."""
        return self.elevation_deg is None


WEATHERS: dict[str, Weather] = {
    "overcast-reference": Weather(50.0, overcast=0.8),
    "dawn": Weather(14.0, tint=(1.0, 0.7, 0.45), cast=(1.06, 0.98, 0.95), brightness=1.15),
    "dusk": Weather(9.0, overcast=0.3, tint=(1.0, 0.6, 0.4), brightness=1.0, noise=4.0),
    "overcast-summer": Weather(60.0, overcast=0.9),
    "overcast-winter": Weather(20.0, overcast=1.0, cast=(0.95, 0.99, 1.07), brightness=0.85),
    "rain": Weather(
        35.0, overcast=1.0, cast=(0.97, 1.0, 1.04), brightness=0.75, blur_px=0.8, noise=4.0
    ),
    "snow": Weather(25.0, overcast=1.0, cast=(0.97, 1.0, 1.05), brightness=1.2),
    "sun": Weather(42.0, overcast=0.05),
    "night": Weather(None),
    "night-rain": Weather(None, brightness=0.8, blur_px=1.1, noise=1.5),
}


def road_look(
    condition: str,
    rng: np.random.Generator,
    *,
    azimuth: float,
    noise_seed: int,
    night_exposure: float = 1.0,
) -> Look:
    """The look of one image of a traversal.

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
        look = night_look(rng, exposure=night_exposure, noise_seed=noise_seed)
    else:
        look = day_look(
            rng,
            azimuth=azimuth,
            elevation=float(np.radians(weather.elevation_deg)),
            overcast=weather.overcast,
            noise_seed=noise_seed,
        )
        look = replace(look, sun=_product(look.sun, weather.tint))
    cast = weather.tint if weather.is_night else weather.cast
    return replace(
        look,
        white_balance=_product(look.white_balance, cast),
        exposure=look.exposure * weather.brightness,
        blur_px=look.blur_px if weather.blur_px is None else weather.blur_px,
        shot_noise=look.shot_noise * weather.noise,
        read_noise=look.read_noise * weather.noise**0.5,
    )


def _product(a: Triple, b: Triple) -> Triple:
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]
