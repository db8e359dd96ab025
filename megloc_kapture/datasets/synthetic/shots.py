"""A shot: everything about one image of the world, before it is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from megloc_kapture.datasets.synthetic.looks import Look
from megloc_kapture.datasets.synthetic.movers import Mover
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions, stream
from megloc_kapture.values import Camera, RigidTransform


@dataclass(frozen=True)
class Shot:
    """One image of the world, before it is drawn.

    Parameters
    ----------
    name : path of the image below ``records_data``.
    role : whether it belongs to the map or asks where it is.
    condition : what it is reported under: day, night, or a name of the dataset's own.
    place : index of the place it shows.
    timestamp, sensor_id : its record; shots of one stop of the rig share the timestamp.
    camera : intrinsics.
    cam_from_world : its pose, metres.
    look : light and sensor.
    movers : people and cars at that moment, in the place's frame.
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
    look: Look
    movers: tuple[Mover, ...]
    bonnet: bool


def noise_seed(options: SyntheticWorldOptions, image: str) -> int:
    """Seed of the sensor's noise in an image."""
    return int(stream(options.seed, "noise", image.rsplit(".", 1)[0]).integers(2**31))
