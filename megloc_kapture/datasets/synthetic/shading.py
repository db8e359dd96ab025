"""Light on surfaces: sun with shadows, sky, lamps, and what glows by itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.looks import Look, as_array
from megloc_kapture.datasets.synthetic.noise import periodic_noise
from megloc_kapture.datasets.synthetic.options import stream
from megloc_kapture.datasets.synthetic.portable import arctan2, exp, product
from megloc_kapture.datasets.synthetic.render import NO_SURFACE, Visibility
from megloc_kapture.datasets.synthetic.shadow import ShadowMap
from megloc_kapture.datasets.synthetic.surfaces import Surfaces
from megloc_kapture.values import RigidTransform

_LAMP_RANGE_M = 14.0
_CLOUD_SIZE = 512

Float32 = NDArray[np.float32]


def cloud_texture(seed: int) -> Float32:
    """Clouds, float32 (_CLOUD_SIZE, _CLOUD_SIZE) 0..1, seamless from left to right."""
    noise = periodic_noise(stream(seed, "clouds"), _CLOUD_SIZE, cell=160, octaves=5)
    return np.clip(0.5 + 0.5 * noise, 0, 1).astype(np.float32)


def radiance(
    seen: Visibility,
    surfaces: Surfaces,
    colour: Float32,
    look: Look,
    *,
    cam_from_place: RigidTransform,
    lamps: NDArray[np.float64],
    shadows: ShadowMap | None,
    clouds: Float32,
) -> Float32:
    """Light that each sample receives, float32 (rows, columns, 3), linear.

    Parameters
    ----------
    seen, surfaces : what the samples see, in the place's frame.
    colour : float32 (rows, columns, 3), 0..255, gamma 2 (as a texture is painted).
    lamps : float64 (L, 3), metres, in the place's frame.
    shadows : of the sun, None where there is none.
    """
    index = np.maximum(seen.surface, 0).astype(np.int32)
    hit = seen.surface != NO_SURFACE
    albedo = (colour * np.float32(1 / 255)) ** 2
    normals = surfaces.normals()
    ambient = 0.62 + 0.38 * normals[:, 2]
    light = np.take(ambient.astype(np.float32), index)[..., None] * as_array(look.sky)
    has_sun, has_lamps = any(look.sun), any(look.lamps) and len(lamps) > 0
    if has_sun or has_lamps:
        x, y, z = _positions(seen, cam_from_place)
    if has_sun:
        facing = np.clip(product(normals, np.array(look.sun_direction)), 0, None).astype(np.float32)
        sun = np.take(facing, index)
        if shadows is not None:
            sun = sun * shadows.lit(x, y, z)
        light += sun[..., None] * as_array(look.sun)
    if has_lamps:
        normal = np.take(normals.astype(np.float32), index, axis=0)
        lamp_light = _lamp_light((x, y, z), normal, lamps.astype(np.float32))
        light += lamp_light[..., None] * as_array(look.lamps)
    light += np.take(surfaces.glow, index)[..., None] * as_array(look.glow)
    result = albedo * light
    sky = ~hit
    if sky.any():
        result[sky] = _sky(seen, sky, look, cam_from_place, clouds)
    return result


def _positions(seen: Visibility, cam_from_place: RigidTransform) -> tuple[Float32, ...]:
    """x, y, z of what each sample sees, place's frame, metres; the camera where it sees nothing."""
    rotation = cam_from_place.rotation_matrix().astype(np.float32)
    center = cam_from_place.center().astype(np.float32)
    hit = seen.inverse_depth > 0
    depth = np.where(hit, 1 / np.where(hit, seen.inverse_depth, 1), 0).astype(np.float32)
    gx, gy = seen.grid.x.astype(np.float32), seen.grid.y.astype(np.float32)
    return tuple(
        center[i] + depth * (rotation[0, i] * gx + rotation[1, i] * gy + rotation[2, i])
        for i in range(3)
    )


def _lamp_light(position: tuple[Float32, ...], normal: Float32, lamps: Float32) -> Float32:
    """Sum over lamps of cosine over squared distance, cut off smoothly at _LAMP_RANGE_M."""
    total = np.zeros_like(position[0])
    for lamp in lamps:
        dx, dy, dz = (lamp[i] - position[i] for i in range(3))
        squared = dx * dx + dy * dy + dz * dz
        facing = dx * normal[..., 0] + dy * normal[..., 1] + dz * normal[..., 2]
        fade = np.clip(1 - squared * np.float32(_LAMP_RANGE_M**-2), 0, None)
        total += np.clip(facing, 0, None) * fade / (squared * np.sqrt(squared) + np.float32(0.3))
    return total


def _sky(
    seen: Visibility,
    where: NDArray[np.bool_],
    look: Look,
    cam_from_place: RigidTransform,
    clouds: Float32,
) -> Float32:
    from megloc_kapture.datasets.synthetic.texture_kernels import bilinear

    rotation = cam_from_place.rotation_matrix().astype(np.float32)
    gx = np.broadcast_to(seen.grid.x, where.shape)[where].astype(np.float32)
    gy = np.broadcast_to(seen.grid.y, where.shape)[where].astype(np.float32)
    rays = gx[:, None] * rotation[0] + gy[:, None] * rotation[1] + rotation[2]
    azimuth = arctan2(rays[:, 1], rays[:, 0]) + np.float32(look.cloud_shift)
    rise = rays[:, 2] / np.sqrt(rays[:, 0] * rays[:, 0] + rays[:, 1] * rays[:, 1])
    u = np.mod(azimuth * np.float32(_CLOUD_SIZE / (2 * np.pi)), _CLOUD_SIZE)
    v = np.clip(rise, 0, 3) * np.float32(_CLOUD_SIZE / 3.2)
    seamless = np.concatenate([clouds, clouds[:, :1]], axis=1)[..., None]
    cover = bilinear(seamless, u[None], v[None])[0]
    base = as_array(look.sky_colour)
    haze = exp(-3 * np.clip(rise, 0, None))[:, None] * base.mean() * np.float32(0.5)
    return base * (1 - 0.5 * cover) + cover * base.mean() * np.float32(1.1) + haze
