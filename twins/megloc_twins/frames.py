"""A frame: an image of the world before rendering, with camera, pose and light."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.random import Generator

from megloc_kapture.datasets.official import GROUND_TRUTH
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.values import Camera, RigidTransform
from megloc_twins.moving_objects import MovingObject
from megloc_twins.portable import Float64, exp, settled

Triple = tuple[float, float, float]
Rigs = dict[str, dict[str, RigidTransform]]  # sensor_from_rig by ids of rig and sensor

_DARK: Triple = (0.0, 0.0, 0.0)
_UP: Triple = (0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """Light and sensor of one image; colours are RGB, directions in the place's frame."""

    night: bool = False  # stray light around lamps
    sun_direction: Triple = _UP  # unit vector towards the sun
    sun: Triple = _DARK  # on a surface that faces the sun
    sky: Triple  # on a surface that faces up; others get less
    lamps: Triple = _DARK  # at a distance of one metre; zero by day
    glow: Triple = _DARK  # of surfaces that emit light
    sky_colour: Triple = _DARK  # radiance
    cloud_shift: float = 0.0  # rotation of the clouds, radians
    exposure: float  # factor between radiance and the sensor's signal, where 1 saturates
    white_balance: Triple  # gain per channel
    shot_noise: float = 4e-5  # variance of the signal divided by the signal
    read_noise: float = 0.002  # standard deviation of the signal in the dark
    blur_px: float = 0.5  # standard deviation of the Gaussian blur by lens and motion
    vignetting: float  # loss of light in the corners, 0..1


def _triple(values: Float64) -> Triple:
    r, g, b = settled(values).tolist()
    return r, g, b


def day_lighting(rng: Generator, sun: tuple[float, float], *, overcast: float) -> Lighting:
    """Return daylight; exposure and white balance vary a little from image to image.

    ``sun`` is its azimuth and elevation, radians, in the place's frame, ``overcast`` (0..1) its
    attenuation by clouds.
    """
    azimuth, elevation = sun
    cos = np.cos(elevation)
    direction = np.array([cos * np.cos(azimuth), cos * np.sin(azimuth), np.sin(elevation)])
    return Lighting(
        sun_direction=_triple(direction),
        sun=_triple(np.array([1.0, 0.94, 0.84]) * 1.25 * (1 - overcast)),
        sky=_triple(np.array([0.66, 0.70, 0.78]) * (0.85 + 0.45 * overcast)),
        sky_colour=_triple(np.array([0.45, 0.62, 0.95]) * (1 - overcast) + 0.85 * overcast),
        cloud_shift=float(rng.uniform(0, 2 * np.pi)),
        exposure=float(0.85 * exp(rng.normal(0, 0.12))),
        white_balance=_triple(np.exp(rng.normal(0, 0.03, 3))),
        vignetting=0.12,
    )


def night_lighting(rng: Generator, *, exposure: float = 1.0) -> Lighting:
    """Return night light: warm lamps, a faint blue sky, a noisy sensor and more blur."""
    return Lighting(
        night=True,
        lamps=_triple(np.array([1.0, 0.74, 0.42]) * rng.uniform(0.8, 1.2)),
        sky=_triple(np.array([0.014, 0.016, 0.022]) * rng.uniform(0.7, 1.3)),
        glow=(1.0, 0.85, 0.6),
        sky_colour=(0.006, 0.008, 0.016),
        cloud_shift=float(rng.uniform(0, 2 * np.pi)),
        exposure=float(exposure * 0.65 * exp(rng.normal(0, 0.25))),
        white_balance=_triple(np.array([1.0, 0.92, 0.86]) * np.exp(rng.normal(0, 0.05, 3))),
        shot_noise=2.2e-3,
        read_noise=0.006,
        blur_px=float(rng.uniform(0.7, 1.1)),
        vignetting=0.3,
    )


def dusk_lighting(rng: Generator) -> Lighting:
    """Return the light at dusk: the lamps are on, and the sky is still slightly bright."""
    night = night_lighting(rng, exposure=0.65)
    light = float(rng.uniform(0.014, 0.03))
    sky = (0.85 * light, 0.95 * light, 1.25 * light)
    return replace(night, sky=sky, sky_colour=sky)


def lamp_lighting(rng: Generator, *, noise: float, spread: float = 0.0) -> Lighting:
    """Return the light of ceiling lamps; ``spread`` is the variation between images."""
    light = float(exp(rng.normal(0, spread)))
    red, green, blue = np.exp(rng.normal(0, 0.35 * spread, 3)).tolist()
    return Lighting(
        sky=(0.62 * light, 0.60 * light, 0.57 * light),
        lamps=(1.9, 1.8, 1.6),
        glow=(3.0, 2.9, 2.7),
        exposure=float(exp(rng.normal(0, spread))),
        white_balance=(red, green, blue),
        shot_noise=4e-5 * noise,
        read_noise=0.002 * noise,
        vignetting=0.1 if spread else 0.0,
    )


@dataclass(frozen=True)
class Weather:
    """Light and lens of a traversal."""

    elevation_deg: float | None  # of the sun above the horizon; None at night
    overcast: float = 0.0  # 0..1, attenuation of the sun by clouds
    tint: Triple = (1.0, 1.0, 1.0)  # factor of the sun's light
    cast: Triple = (1.0, 1.0, 1.0)  # factor of the white balance
    brightness: float = 1.0  # factor of the exposure
    blur_px: float | None = None  # blur by lens, drops and motion; None: as in the lighting
    noise: float = 1.0  # factor of the sensor noise's variance


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


def road_lighting(condition: str, rng: Generator, *, azimuth: float) -> Lighting:
    """Return the lighting in one of the WEATHERS; the sun's ``azimuth`` is in the place's frame."""
    weather = WEATHERS[condition]
    if weather.elevation_deg is None:
        lighting = night_lighting(rng)
    else:
        sun = azimuth, float(np.radians(weather.elevation_deg))
        lighting = day_lighting(rng, sun, overcast=weather.overcast)
        lighting = replace(lighting, sun=_product(lighting.sun, weather.tint))
    return replace(
        lighting,
        white_balance=_product(lighting.white_balance, weather.cast),
        exposure=lighting.exposure * weather.brightness,
        blur_px=lighting.blur_px if weather.blur_px is None else weather.blur_px,
        shot_noise=lighting.shot_noise * weather.noise,
        read_noise=lighting.read_noise * weather.noise**0.5,
    )


def _product(a: Triple, b: Triple) -> Triple:
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


def reduced(camera: Camera, factor: int) -> Camera:
    """Return the camera with ``factor`` times fewer pixels per axis (rounded up)."""
    width, height = -(-camera.width // factor), -(-camera.height // factor)
    num_px = 4 if camera.model == "PINHOLE" else 3
    params = [p / factor for p in camera.params[:num_px]] + list(camera.params[num_px:])
    return Camera(camera.model, width, height, tuple(params))


@dataclass(frozen=True)
class Frame:
    """An image of the world before rendering."""

    name: str  # path below ``records_data``
    condition: str  # day, night or a condition of the dataset, for reports
    place: int  # index of the visible place
    timestamp: int  # equal for the frames of one stop of a rig
    sensor_id: str
    camera: Camera
    cam_from_world: RigidTransform  # metres
    lighting: Lighting
    noise_seed: int  # of the sensor's noise
    moving_objects: tuple[MovingObject, ...] = ()  # in the place's frame
    bonnet: bool = False  # the car's bonnet is visible


def in_frame(frames: Iterable[Frame], official_from_world: RigidTransform) -> list[Frame]:
    """Convert the frames' poses to the coordinates of the published dataset."""
    world_from_official = official_from_world.inverse()
    return [replace(f, cam_from_world=f.cam_from_world @ world_from_official) for f in frames]


def kapture_records(frames: Iterable[Frame], *, poses: bool = True) -> KaptureData:
    """Return sensors, records and, on request, poses of the frames."""
    data = KaptureData()
    for frame in frames:
        record = frame.timestamp, frame.sensor_id
        data.sensors[frame.sensor_id] = Sensor.from_camera(frame.camera, name=frame.sensor_id)
        data.records_camera[record] = frame.name
        if poses:
            data.trajectories[record] = frame.cam_from_world
    return data


def write_truth(
    root: Path, mapping: list[Frame], queries: list[Frame], *, rigs: Rigs | None = None
) -> dict[str, int]:
    """Write the true poses of all images as kapture below ``root``; return the image counts."""
    counts = {}
    for role, frames in (("mapping", mapping), ("query", queries)):
        data = kapture_records(frames)
        data.rigs.update(rigs or {})
        write_sensors(root / GROUND_TRUTH / role, data)
        counts[f"{role} images"] = len(data.records_camera)
    return counts
