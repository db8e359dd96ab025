"""The synthetic world as plain kapture: map images from a rig, phone queries by day and night."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path, PurePosixPath

import numpy as np

from megloc_kapture.io.dataset_tables import (
    ImageGroup,
    Protocol,
    SideTables,
    write_side_tables,
)
from megloc_kapture.io.images import write_depth_map, write_image
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Camera, RigidTransform
from megloc_twins.frames import Frame, day_lighting, kapture_records
from megloc_twins.moving_objects import place_moving_objects
from megloc_twins.options import JPEG_QUALITY, SyntheticDataset, SyntheticWorldOptions, stream
from megloc_twins.portable import cam_from_rig, looking_at
from megloc_twins.render import RenderedFrame, render_frames
from megloc_twins.squares import Place, build_place
from megloc_twins.viewpoints import query_frames

RIG_HEIGHT_M = 1.9
_RIG_ID = "rig"
# rig axes: x right, y down, z forward; metres
SENSOR_FROM_RIG = {
    "rig_front": cam_from_rig(0.0, -2.0, (0.0, -0.05, 0.45)),
    "rig_left": cam_from_rig(-62.0, 3.0, (-0.35, 0.0, 0.05)),
    "rig_right": cam_from_rig(62.0, 3.0, (0.35, 0.0, 0.05)),
}
_LENSES = {  # focal length and principal point, as fractions of width and height
    "rig_front": (0.76, 0.5, 0.5),
    "rig_left": (0.73, 0.506, 0.493),
    "rig_right": (0.73, 0.494, 0.507),
}


def rig_cameras(options: SyntheticWorldOptions) -> dict[str, Camera]:
    """Return the mapping rig's cameras by sensor id, PINHOLE."""
    width, height = options.width, options.height
    cameras = {}
    for sensor_id, (f, cx, cy) in _LENSES.items():
        params = (f * width, f * width * 1.004, cx * width, cy * height)
        cameras[sensor_id] = Camera("PINHOLE", width, height, params)
    return cameras


def _mapping_frames(
    options: SyntheticWorldOptions, place: Place, rig_from_world: dict[int, RigidTransform]
) -> Iterator[Frame]:
    """Yield the rig's frames in a place by time; add the rig's poses to ``rig_from_world``."""
    rng = stream(options.seed, "mapping", place.index)
    sun = float(rng.uniform(-np.pi, np.pi)), float(np.radians(rng.uniform(40, 60)))
    for station, (spot, heading) in enumerate(place.plan.stops(options.stations_per_place)):
        timestamp = 1000 * (place.index + 1) + station
        position = np.array([*spot + rng.normal(0, 0.15, 2), RIG_HEIGHT_M + rng.normal(0, 0.03)])
        yaw = heading + float(rng.normal(0, 0.12))
        pitch, roll = (float(a) for a in rng.normal(0, 0.015, 2))
        pose = looking_at(position, yaw, pitch, roll) @ place.place_from_world
        rig_from_world[timestamp] = pose
        moving_objects = place_moving_objects(place.plan, rng, options.moving_objects, position)
        for sensor_id, camera in rig_cameras(options).items():
            folder = sensor_id.removeprefix("rig_")
            image = f"db/{place.name}/{folder}/{station:05d}.jpg"
            yield Frame(
                name=image,
                condition="day",
                place=place.index,
                timestamp=timestamp,
                sensor_id=sensor_id,
                camera=camera,
                cam_from_world=SENSOR_FROM_RIG[sensor_id] @ pose,
                lighting=day_lighting(rng, sun, overcast=0.15),
                noise_seed=options.noise_seed(image),
                moving_objects=moving_objects,
                bonnet=sensor_id == "rig_front",
            )


@dataclass(frozen=True, eq=False)
class SyntheticWorld:
    """All frames and poses, in one world frame (metres, z up)."""

    options: SyntheticWorldOptions
    places: tuple[Place, ...]  # by index
    rig_from_world: dict[int, RigidTransform]  # by timestamp
    mapping: tuple[Frame, ...]  # sorted by name
    queries: tuple[Frame, ...]  # sorted by name

    def frames(self) -> tuple[Frame, ...]:
        return self.mapping + self.queries


def build_world(options: SyntheticWorldOptions) -> SyntheticWorld:
    """Lay out the world and choose all frames, deterministically."""
    places = tuple(build_place(options, index) for index in range(options.num_places))
    rig_from_world: dict[int, RigidTransform] = {}
    mapping: list[Frame] = []
    queries: list[Frame] = []
    for place in places:
        seen = list(_mapping_frames(options, place, rig_from_world))
        queries += query_frames(options, place, seen, "day", options.day_queries)
        queries += query_frames(options, place, seen, "night", options.night_queries)
        mapping += seen
    mapping.sort(key=attrgetter("name"))
    queries.sort(key=attrgetter("name"))
    return SyntheticWorld(options, places, rig_from_world, tuple(mapping), tuple(queries))


class SyntheticKapture(SyntheticDataset[SyntheticWorldOptions]):
    """The synthetic world as plain kapture.

    ``mapping/`` (images, poses of the rig, depth on request), ``query/`` (images and cameras),
    ``query_gt/`` (the same cameras with poses, without images) and ``megloc/`` (conditions,
    thresholds).
    """

    Options = SyntheticWorldOptions
    version = 2

    def write(self, root: Path, work: Work = HERE) -> dict[str, int]:
        root, world = Path(root), build_world(self.options)
        finish = partial(write_files, root, self.options)
        names = [frame.name for frame in world.mapping] if self.options.depth else []
        render_frames(self.options, world.frames(), finish, with_depth=names, work=work)
        write_sensors(root / "mapping", mapping_data(world))
        write_sensors(root / "query", kapture_records(world.queries, poses=False))
        write_sensors(root / "query_gt", kapture_records(world.queries))
        write_side_tables(root / "megloc", side_tables_of(world))
        mapping, queries = len(world.mapping), len(world.queries)
        return {"places": len(world.places), "mapping images": mapping, "query images": queries}


def mapping_data(world: SyntheticWorld) -> KaptureData:
    """Return the records of the mapping images, with poses of the rig."""
    data = KaptureData()
    members = dict(SENSOR_FROM_RIG)
    for sensor_id, camera in rig_cameras(world.options).items():
        data.sensors[sensor_id] = Sensor.from_camera(camera, name=sensor_id)
        if world.options.depth:
            depth_id = f"{sensor_id}_depth"
            data.sensors[depth_id] = Sensor.from_camera(camera, name=depth_id, sensor_type="depth")
            members[depth_id] = members[sensor_id]
    data.rigs[_RIG_ID] = members
    for timestamp, pose in world.rig_from_world.items():
        data.trajectories[timestamp, _RIG_ID] = pose
    for frame in world.mapping:
        data.records_camera[frame.timestamp, frame.sensor_id] = frame.name
        if world.options.depth:
            record = frame.timestamp, f"{frame.sensor_id}_depth"
            data.records_depth[record] = depth_name(frame.name)
    return data


def side_tables_of(world: SyntheticWorld) -> SideTables:
    """Return the queries' conditions and the names of conditions in reports."""
    groups = {
        frame.name: ImageGroup(condition=frame.condition, location=world.places[frame.place].name)
        for frame in world.queries
    }
    rules = Protocol(dataset="synthetic", conditions=("day", "night"))
    return SideTables(protocol=rules, groups=groups)


def depth_name(image: str) -> str:
    return f"depth/{PurePosixPath(image).with_suffix('.depth')}"


def write_files(
    root: Path, options: SyntheticWorldOptions, frame: Frame, view: RenderedFrame
) -> None:
    """Write an image, and its depth and mask if present."""
    sensors = root / ("query" if frame.name.startswith("query/") else "mapping") / "sensors"
    records = sensors / "records_data"
    write_image(records / frame.name, view.image, jpeg_quality=JPEG_QUALITY)
    if view.depth_m is not None:
        write_depth_map(records / depth_name(frame.name), view.depth_m)
    if options.masks and not view.mask.all():
        mask = np.where(view.mask, 255, 0).astype(np.uint8)
        write_image(sensors / "masks" / f"{frame.name}.png", mask)
