"""A frame: one image of the world before it is rendered, its camera and its pose."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.values import Camera, RigidTransform
from megloc_twins.lighting import Lighting
from megloc_twins.moving_objects import MovingObject
from megloc_twins.options import SyntheticWorldOptions, stream
from megloc_twins.portable import product, settled_pose


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


def cam_from_rig(
    right_deg: float, up_deg: float, position: tuple[float, float, float]
) -> RigidTransform:
    """Pose of a camera on a rig whose frame has x to the right, y down and z ahead, metres.

    It looks ``right_deg`` to the right of ahead and ``up_deg`` up, from ``position``.
    """
    right, up = np.radians(right_deg), np.radians(up_deg)
    about_y = np.array(
        [[np.cos(right), 0, -np.sin(right)], [0, 1, 0], [np.sin(right), 0, np.cos(right)]]
    )
    about_x = np.array([[1, 0, 0], [0, np.cos(up), np.sin(up)], [0, -np.sin(up), np.cos(up)]])
    rotation = product(about_x, about_y)
    return settled_pose(rotation, -product(rotation, np.array(position)))


def reduced(camera: Camera, factor: int) -> Camera:
    """The same view with ``factor`` times fewer pixels per axis (rounded up)."""
    width, height = -(-camera.width // factor), -(-camera.height // factor)
    num_px = 4 if camera.model == "PINHOLE" else 3
    params = [p / factor for p in camera.params[:num_px]] + list(camera.params[num_px:])
    return Camera(camera.model, width, height, tuple(params))


@dataclass(frozen=True)
class Frame:
    """One image of the world, before it is drawn.

    Parameters
    ----------
    name : path of the image below ``records_data``.
    role : whether it belongs to the map or asks where it is.
    condition : what it is reported under: day, night, or a name of the dataset's own.
    place : index of the place it shows.
    timestamp, sensor_id : its record; frames of one stop of the rig share the timestamp.
    camera : intrinsics.
    cam_from_world : its pose, metres.
    lighting : light and sensor.
    moving objects : people and cars at that moment, in the place's frame.
    bonnet : whether the car's bonnet is in view.
    """

    name: str
    role: Literal["mapping", "query"]
    condition: str
    place: int
    timestamp: int
    sensor_id: str
    camera: Camera
    cam_from_world: RigidTransform
    lighting: Lighting
    moving_objects: tuple[MovingObject, ...]
    bonnet: bool


def noise_seed(options: SyntheticWorldOptions, image: str) -> int:
    """Seed of the sensor's noise in an image."""
    return int(stream(options.seed, "noise", image.rsplit(".", 1)[0]).integers(2**31))


def in_frame(frames: Iterable[Frame], official_from_world: RigidTransform) -> list[Frame]:
    """The frames with their poses in the coordinates that a dataset publishes."""
    world_from_official = official_from_world.inverse()
    return [
        replace(frame, cam_from_world=frame.cam_from_world @ world_from_official)
        for frame in frames
    ]


def kapture_records(
    frames: Iterable[Frame], *, poses: bool = True, named: bool = True
) -> KaptureData:
    """Sensors, with their ids as names, and records of the frames, with their poses."""
    data = KaptureData()
    for frame in frames:
        record = frame.timestamp, frame.sensor_id
        name = frame.sensor_id if named else ""
        data.sensors[frame.sensor_id] = Sensor.from_camera(frame.camera, name=name)
        data.records_camera[record] = frame.name
        if poses:
            data.trajectories[record] = frame.cam_from_world
    return data
