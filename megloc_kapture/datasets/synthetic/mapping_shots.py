"""The mapping rig's round through a place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from megloc_kapture.datasets.synthetic.cameras import (
    BONNET_CAMERA,
    looking_at,
    rig_cameras,
    rig_geometry,
)
from megloc_kapture.datasets.synthetic.looks import day_look
from megloc_kapture.datasets.synthetic.movers import place_movers
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions, stream
from megloc_kapture.datasets.synthetic.places import Place
from megloc_kapture.datasets.synthetic.shots import Shot, noise_seed
from megloc_kapture.values import RigidTransform

RIG_ID = "rig"
RIG_HEIGHT_M = 1.9


@dataclass(frozen=True)
class RigStop:
    """The rig at one moment: its pose, and what its cameras take."""

    timestamp: int
    rig_from_world: RigidTransform
    shots: tuple[Shot, ...]


def rig_sensor_id(camera: str) -> str:
    """Id of one of the rig's cameras."""
    return f"{RIG_ID}_{camera}"


def mapping_stops(options: SyntheticWorldOptions, place: Place) -> list[RigStop]:
    """The rig's stops in a place, in order of time."""
    rng = stream(options.seed, "mapping", place.index)
    azimuth = float(rng.uniform(-np.pi, np.pi))
    elevation = float(np.radians(rng.uniform(40, 60)))
    cameras, geometry = rig_cameras(options), rig_geometry()
    stops = []
    for station, (spot, heading) in enumerate(place.plan.stops(options.stations_per_place)):
        timestamp = 1000 * (place.index + 1) + station
        position = np.array([*spot + rng.normal(0, 0.15, 2), RIG_HEIGHT_M + rng.normal(0, 0.03)])
        yaw = heading + float(rng.normal(0, 0.12))
        pitch, roll = (float(a) for a in rng.normal(0, 0.015, 2))
        rig_from_world = looking_at(position, yaw, pitch, roll) @ place.place_from_world
        movers = place_movers(place.plan, rng, options.moving_objects, position, yaw=None)
        shots = []
        for name, camera in cameras.items():
            image = f"db/{place.name}/{name}/{station:05d}.{options.image_format}"
            look = day_look(
                rng,
                azimuth=azimuth,
                elevation=elevation,
                overcast=0.15,
                noise_seed=noise_seed(options, image),
            )
            shots.append(
                Shot(
                    name=image,
                    role="mapping",
                    condition="day",
                    place=place.index,
                    timestamp=timestamp,
                    sensor_id=rig_sensor_id(name),
                    camera=camera,
                    cam_from_world=geometry[name] @ rig_from_world,
                    look=look,
                    movers=movers,
                    bonnet=options.bonnet and name == BONNET_CAMERA,
                )
            )
        stops.append(RigStop(timestamp, rig_from_world, tuple(shots)))
    return stops
