"""The mapping rig, query cameras, and poses from where one stands and looks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions
from megloc_kapture.datasets.synthetic.portable import product, settled_pose
from megloc_kapture.values import Camera, RigidTransform

BONNET_CAMERA = "front"


def looking_at(
    position: NDArray[np.float64], yaw: float, pitch: float, roll: float
) -> RigidTransform:
    """``cam_from_world`` of a camera at ``position`` (3,), metres, in a frame with z up.

    It looks along ``yaw`` (radians from +x towards +y), ``pitch`` above the horizon, and is then
    turned by ``roll`` about its axis (clockwise as seen by the camera).
    """
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    cos, sin = np.cos(roll), np.sin(roll)
    rotation = np.stack([cos * right + sin * down, cos * down - sin * right, forward])
    return settled_pose(rotation, -product(rotation, position))


def rig_cameras(options: SyntheticWorldOptions) -> dict[str, Camera]:
    """Cameras of the mapping rig by name, PINHOLE."""
    width, height = options.width, options.height
    focal = {"front": 0.76, "left": 0.73, "right": 0.73}
    centre = {"front": (0.5, 0.5), "left": (0.506, 0.493), "right": (0.494, 0.507)}
    return {
        name: Camera(
            "PINHOLE",
            width,
            height,
            (
                focal[name] * width,
                focal[name] * width * 1.004,
                centre[name][0] * width,
                centre[name][1] * height,
            ),
        )
        for name in focal
    }


def rig_geometry() -> dict[str, RigidTransform]:
    """``sensor_from_rig`` of the rig's cameras; the rig looks along z, y down, metres."""
    result = {}
    for name, yaw_deg, pitch_deg, offset in (
        ("front", 0.0, -2.0, (0.0, -0.05, 0.45)),
        ("left", -62.0, 3.0, (-0.35, 0.0, 0.05)),
        ("right", 62.0, 3.0, (0.35, 0.0, 0.05)),
    ):
        yaw, pitch = np.radians(yaw_deg), np.radians(pitch_deg)
        about_y = np.array(
            [[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]]
        )
        about_x = np.array(
            [[1, 0, 0], [0, np.cos(pitch), np.sin(pitch)], [0, -np.sin(pitch), np.cos(pitch)]]
        )
        rotation = product(about_x, about_y)
        result[name] = settled_pose(rotation, -product(rotation, np.array(offset)))
    return result


def query_camera(options: SyntheticWorldOptions, rng: np.random.Generator) -> Camera:
    """A telephone's camera: its own focal length, principal point and distortion."""
    width, height = options.width, options.height
    focal = rng.uniform(0.7, 0.95) * width
    cx, cy = width / 2 + rng.normal(0, 2), height / 2 + rng.normal(0, 2)
    if not options.distortion:
        return Camera("SIMPLE_PINHOLE", width, height, (focal, cx, cy))
    k = rng.uniform(-0.09, 0.04)
    return Camera("SIMPLE_RADIAL", width, height, (focal, cx, cy, k))


def reduced(camera: Camera, factor: int) -> Camera:
    """The same view with ``factor`` times fewer pixels per axis (rounded up)."""
    width, height = -(-camera.width // factor), -(-camera.height // factor)
    num_px = 4 if camera.model == "PINHOLE" else 3
    params = [p / factor for p in camera.params[:num_px]] + list(camera.params[num_px:])
    return Camera(camera.model, width, height, tuple(params))
