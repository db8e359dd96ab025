"""A ray-cast room with two boxes, two lights and a moving object."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import fourier_gaussian, map_coordinates
from scipy.spatial.transform import Rotation

from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("PINHOLE", 160, 120, (110.0, 110.0, 80.0, 60.0))
ROOM = (np.array([-2.0, -1.25, -2.0]), np.array([2.0, 1.25, 2.0]))
BOXES = (
    (np.array([-1.2, 0.35, 0.5]), np.array([-0.4, 1.25, 1.2])),
    (np.array([0.8, 0.05, -1.5]), np.array([1.5, 1.25, -0.9])),
)
# of each light: its colour, and where it stands
LIGHTS = (
    (np.array([1.0, 0.97, 0.9]), np.array([0.5, -1.1, 0.3])),
    (np.array([0.45, 0.55, 0.85]), np.array([-1.6, -0.6, -1.6])),
)
_TEXTURE_PX = 256


@dataclass(frozen=True, eq=False)
class RoomImage:
    """Image uint8 (H, W, 3), depth float32 (H, W), and the mask of the moving object."""

    image: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    moving: NDArray[np.bool_]


@cache
def _texture(seed: int) -> NDArray[np.float64]:
    """Return periodic colours (256, 256, 3), 0 to 1."""
    rng = np.random.default_rng(seed)
    image = np.zeros((_TEXTURE_PX, _TEXTURE_PX, 3))
    for sigma, strength in ((3.0, 1.0), (8.0, 1.2), (24.0, 1.5)):
        noise = rng.normal(size=(_TEXTURE_PX, _TEXTURE_PX, 3))
        spectrum = fourier_gaussian(np.fft.fft2(noise, axes=(0, 1)), (sigma, sigma, 0))
        layer = np.fft.ifft2(spectrum, axes=(0, 1)).real
        image += strength * layer / layer.std()
    return np.clip(0.5 + 0.1 * image, 0.02, 0.98)


def _hit_box(
    origin: NDArray[np.float64], rays: NDArray[np.float64], box: tuple, *, inside: bool
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return distances (N,) in lengths of the rays, and faces: axis, plus 3 on the far side."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = ((side - origin) / rays for side in box)
    near, far = np.fmin(a, b), np.fmax(a, b)
    if inside:
        t, axis = far.min(1), far.argmin(1)
        return t, axis + 3 * (rays[np.arange(len(rays)), axis] > 0)
    t, axis = near.max(1), near.argmax(1)
    missed = (t > far.min(1)) | (t <= 0)
    return np.where(missed, np.inf, t), axis + 3 * (rays[np.arange(len(rays)), axis] < 0)


def render(
    cam_from_world: RigidTransform,
    *,
    camera: Camera = CAMERA,
    light: int = 0,
    moving: int | None = None,
) -> RoomImage:
    """Render a view; ``light`` is the one that shines, ``moving`` the seed of a sphere in the way.

    Exact except for bilinear textures and rounding to 8 bit.
    """
    fx, fy, cx, cy = camera.params
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    in_cam = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1).reshape(-1, 3)
    rays = in_cam @ cam_from_world.rotation_matrix()
    origin = cam_from_world.center()
    t, face = _hit_box(origin, rays, ROOM, inside=True)
    number = np.zeros(len(t), np.int64)
    for which, box in enumerate(BOXES, start=1):
        other, its_face = _hit_box(origin, rays, box, inside=False)
        nearer = other < t
        t, face = np.where(nearer, other, t), np.where(nearer, its_face, face)
        number = np.where(nearer, which, number)
    points = origin + t[:, None] * rays
    colour = np.zeros((len(t), 3))
    for surface in np.unique(6 * number + face):
        rows = np.flatnonzero(6 * number + face == surface)
        across = [axis for axis in range(3) if axis != surface % 3]
        at = points[rows][:, across].T * 64 + 20.0 * surface
        texture = _texture(int(surface))
        looked = [
            map_coordinates(texture[..., channel], at[::-1], order=1, mode="grid-wrap")
            for channel in range(3)
        ]
        colour[rows] = np.stack(looked, axis=1)
    tint, stands = LIGHTS[light]
    away = points - stands
    distance = np.linalg.norm(away, axis=1)
    normal = np.zeros_like(points)
    normal[np.arange(len(t)), face % 3] = 1.0
    slant = np.abs((away * normal).sum(1)) / distance
    shade = 0.45 + 0.55 * slant / (1.0 + 0.15 * distance**2)
    colour = colour * shade[:, None] * tint
    hidden = np.zeros(len(t), bool)
    if moving is not None:
        rng = np.random.default_rng(1000 + moving)
        ball = rng.uniform(0.2, 0.3)
        ahead = np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.4), 1.0])
        centre = cam_from_world.inverse().apply(rng.uniform(0.9, 1.3) * ahead[None])[0]
        b = rays @ (origin - centre)
        a = (rays * rays).sum(1)
        inner = b * b - a * (((origin - centre) ** 2).sum() - ball**2)
        nearest = (-b - np.sqrt(np.maximum(inner, 0))) / a
        hidden = (inner > 0) & (nearest > 0) & (nearest < t)
        t = np.where(hidden, nearest, t)
        colour[hidden] = rng.uniform(0.05, 0.95, 3) * tint
    shape = camera.height, camera.width
    image = np.clip(colour * 255, 0, 255).round().astype(np.uint8)
    return RoomImage(
        image.reshape(*shape, 3), t.astype(np.float32).reshape(shape), hidden.reshape(shape)
    )


def poses(count: int, seed: int) -> list[RigidTransform]:
    """Return cameras near the middle of the room with any direction."""
    rng = np.random.default_rng(seed)
    result = []
    for number in range(count):
        centre = rng.uniform([-0.7, -0.5, -0.6], [0.6, 0.3, 0.6])
        yaw = 360.0 * (number * 0.381966) + rng.uniform(-10, 10)
        rotation = Rotation.from_euler("xy", [rng.uniform(-15, 15), yaw], degrees=True).as_matrix()
        result.append(RigidTransform.from_matrix(rotation, -rotation @ centre))
    return result
