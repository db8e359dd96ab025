"""What is photographed on a floor, and in what light: cutouts of a scan, telephones' images."""

from __future__ import annotations

import numpy as np

from megloc_kapture.datasets.synthetic.cameras import looking_at
from megloc_kapture.datasets.synthetic.looks import Look
from megloc_kapture.datasets.synthetic.portable import exp
from megloc_kapture.values import Camera, RigidTransform

YAWS_DEG = tuple(range(0, 360, 30))
PITCHES_DEG = (-30, 0, 30)


def cam_from_scan(yaw_deg: float, pitch_deg: float) -> RigidTransform:
    """A cutout's pose in its scan (z up): at yaw 0 it looks along -x, then turns to the right."""
    return looking_at(np.zeros(3), np.pi - np.radians(yaw_deg), np.radians(pitch_deg), 0.0)


def cutout_camera(width: int, height: int) -> Camera:
    """A cutout's camera, 60 degrees wide."""
    focal = width / 2 / np.tan(np.radians(30.0))
    return Camera("SIMPLE_PINHOLE", width, height, (float(focal), width / 2, height / 2))


def phone_camera(width: int, height: int) -> Camera:
    """A telephone's camera with a 28 mm lens (on 36 mm of film)."""
    focal = max(width, height) * 28 / 36
    return Camera("SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))


def lamp_light(
    rng: np.random.Generator, *, noise: float, noise_seed: int, spread: float = 0.0
) -> Look:
    """Light of ceiling lamps; ``spread`` is how much light and colour vary between images."""
    light = float(exp(rng.normal(0, spread)))
    cast = np.exp(rng.normal(0, 0.35 * spread, 3))
    return Look(
        condition="day",
        sun_direction=(0.0, 0.0, 1.0),
        sun=(0.0, 0.0, 0.0),
        sky=(0.62 * light, 0.60 * light, 0.57 * light),
        lamps=(1.9, 1.8, 1.6),
        glow=(3.0, 2.9, 2.7),
        sky_colour=(0.0, 0.0, 0.0),
        cloud_shift=0.0,
        exposure=float(exp(rng.normal(0, spread))),
        white_balance=(float(cast[0]), float(cast[1]), float(cast[2])),
        shot_noise=4e-5 * noise,
        read_noise=0.002 * noise,
        blur_px=0.5,
        vignetting=0.1 if spread else 0.0,
        noise_seed=noise_seed,
    )
