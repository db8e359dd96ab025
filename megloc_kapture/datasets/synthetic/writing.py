"""The synthetic world as plain kapture: ``mapping/``, ``query/``, ``query_gt/`` and ``megloc/``."""

from __future__ import annotations

from concurrent.futures import Executor
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from megloc_kapture.datasets.synthetic.mapping_shots import RIG_ID
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions
from megloc_kapture.datasets.synthetic.shots import Shot
from megloc_kapture.datasets.synthetic.studio import draw_shots
from megloc_kapture.datasets.synthetic.views import View
from megloc_kapture.datasets.synthetic.world import SyntheticWorld, build_world
from megloc_kapture.io.dataset_tables import (
    ImageGroup,
    Protocol,
    World,
    write_groups,
    write_protocol,
    write_world,
)
from megloc_kapture.io.images import write_depth_map, write_image
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.stages.work import Track, untracked

DATASET = "synthetic"


def write_synthetic_kapture(
    root: Path,
    options: SyntheticWorldOptions | None = None,
    executor: Executor | None = None,
    *,
    track: Track = untracked,
) -> dict[str, int]:
    """Draw a synthetic world and write it as kapture; returns what it holds.

    Below ``root``: ``mapping/`` (images, poses through the rig, depth if asked), ``query/``
    (images and cameras), ``query_gt/`` (the same cameras with poses, no images) and ``megloc/``
    (day and night, thresholds). The bytes depend on the options only, not on the executor.

    Parameters
    ----------
    executor : shares the drawing among processes that see the same file system.
    track : shows progress, image by image.

    Raises
    ------
    OutputError : something cannot be written.
    """
    root = Path(root)
    world = build_world(options)
    draw_shots(
        world.options,
        world.shots(),
        partial(_write_files, root, world.options),
        with_depth=[shot.name for shot in world.mapping] if world.options.depth else (),
        executor=executor,
        track=track,
    )
    write_sensors(root / "mapping", mapping_data(world))
    write_sensors(root / "query", query_data(world, poses=False))
    write_sensors(root / "query_gt", query_data(world, poses=True))
    write_side_tables(root / "megloc", world)
    return {
        "places": len(world.places),
        "mapping images": len(world.mapping),
        "query images": len(world.queries),
    }


def mapping_data(world: SyntheticWorld) -> KaptureData:
    """The mapping images' records; their poses are those of the rig."""
    data = KaptureData()
    members = {}
    for sensor_id, camera in world.rig_cameras.items():
        data.sensors[sensor_id] = Sensor.from_camera(camera, name=sensor_id)
        members[sensor_id] = world.sensor_from_rig[sensor_id]
        if world.options.depth:
            depth_id = _depth_sensor(sensor_id)
            data.sensors[depth_id] = Sensor.from_camera(camera, name=depth_id, sensor_type="depth")
            members[depth_id] = world.sensor_from_rig[sensor_id]
    data.rigs[RIG_ID] = members
    for timestamp, pose in world.rig_from_world.items():
        data.trajectories[timestamp, RIG_ID] = pose
    for shot in world.mapping:
        data.records_camera[shot.timestamp, shot.sensor_id] = shot.name
        if world.options.depth:
            record = shot.timestamp, _depth_sensor(shot.sensor_id)
            data.records_depth[record] = depth_name(shot.name)
    return data


def query_data(world: SyntheticWorld, *, poses: bool) -> KaptureData:
    """The queries' sensors and records, with their true poses or without."""
    data = KaptureData()
    for shot in world.queries:
        data.sensors[shot.sensor_id] = Sensor.from_camera(shot.camera, name=shot.sensor_id)
        data.records_camera[shot.timestamp, shot.sensor_id] = shot.name
        if poses:
            data.trajectories[shot.timestamp, shot.sensor_id] = shot.cam_from_world
    return data


def write_side_tables(folder: Path, world: SyntheticWorld) -> None:
    """Conditions of the queries, thresholds and frame."""
    groups = {
        shot.name: ImageGroup(condition=shot.condition, location=world.places[shot.place].name)
        for shot in world.queries
    }
    write_groups(folder, groups)
    write_protocol(folder, Protocol(dataset=DATASET, conditions=("day", "night")))
    write_world(folder, World())


def depth_name(image: str) -> str:
    """Path of an image's depth map below ``records_data``."""
    return str(PurePosixPath("depth") / PurePosixPath(image).with_suffix(".depth"))


def _depth_sensor(sensor_id: str) -> str:
    return f"{sensor_id}_depth"


def _write_files(root: Path, options: SyntheticWorldOptions, shot: Shot, view: View) -> None:
    sensors = root / shot.role / "sensors"
    records = sensors / "records_data"
    write_image(records / shot.name, view.image, jpeg_quality=options.jpeg_quality)
    if view.depth_m is not None:
        write_depth_map(records / depth_name(shot.name), view.depth_m)
    if options.masks and not view.mask.all():
        mask = np.where(view.mask, 255, 0).astype(np.uint8)
        write_image(sensors / "masks" / f"{shot.name}.png", mask)
