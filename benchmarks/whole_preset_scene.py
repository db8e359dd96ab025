"""A small rendered scene that exercises every stage of the preset ``megloc``.

The map images are from a rig on a circular trajectory and have depth and ego-vehicle masks. The
queries are from phones with lens distortion, and have depth for refinement by ICP.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from megloc_twins.frames import kapture_records
from megloc_twins.options import SyntheticWorldOptions
from megloc_twins.render import render_frames
from megloc_twins.synthetic_kapture import (
    SENSOR_FROM_RIG,
    SyntheticWorld,
    build_world,
    depth_name,
    mapping_data,
    side_tables_of,
    write_files,
)

from megloc_kapture.io.dataset_tables import write_side_tables
from megloc_kapture.io.files import link_images
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.io.tables import STATUS_FILE, write_status
from megloc_kapture.values import LocalizationResult, RigidTransform

_STEP_M = 0.3  # lateral distance between the images of a stop
_QUERY_OFFSET_M = (-0.15, 0.05, 0.0)  # from a map image to its query, in the camera frame
_DISPLACED_M = 0.05


@dataclass(frozen=True)
class Scene:
    """Options of the rendered scene.

    Attributes
    ----------
    steps : images per camera and stop, 30 cm apart.
    beside : place each query 15 cm from a map image instead of at a random pose.
    """

    world: SyntheticWorldOptions
    steps: int = 1
    beside: bool = False


FREE_SCENE = Scene(
    SyntheticWorldOptions(
        num_places=2,
        stations_per_place=6,
        day_queries=20,
        night_queries=0,
        width=400,
        height=300,
        moving_objects=1,
        depth=True,
        masks=True,
    )
)
# random networks match nearby views only
RANDOM_SCENE = Scene(
    FREE_SCENE.world.model_copy(
        update={"stations_per_place": 3, "day_queries": 4, "width": 320, "height": 240}
    ),
    steps=2,
    beside=True,
)


def write_scene(root: Path, scene: Scene) -> None:
    """Render the scene and write mapping/, query/, query_gt/ and megloc/ below ``root``."""
    world = build_world(scene.world)
    world = _stepped(world, scene.steps)
    if scene.beside:
        world = _queries_near_map(world)
    names = [shot.name for shot in world.frames()]
    render_frames(
        world.options, world.frames(), partial(write_files, root, world.options), with_depth=names
    )
    write_sensors(root / "mapping", mapping_data(world))
    write_sensors(root / "query", _with_depth(kapture_records(world.queries, poses=False)))
    write_sensors(root / "query_gt", kapture_records(world.queries))
    write_side_tables(root / "megloc", side_tables_of(world))


def _stepped(world: SyntheticWorld, steps: int) -> SyntheticWorld:
    """Return the world with several laterally displaced images per stop."""
    mapping, rig_from_world = [], {}
    for shot in world.mapping:
        for step in range(steps):
            offset = RigidTransform((1.0, 0.0, 0.0, 0.0), (-_STEP_M * step, 0.0, 0.0))
            pose = offset @ world.rig_from_world[shot.timestamp]
            timestamp = shot.timestamp * steps + step
            rig_from_world[timestamp] = pose
            stem, _, ending = shot.name.rpartition(".")
            name = f"{stem}_{step}.{ending}"
            mapping.append(
                replace(
                    shot,
                    name=name,
                    timestamp=timestamp,
                    cam_from_world=SENSOR_FROM_RIG[shot.sensor_id] @ pose,
                    noise_seed=world.options.noise_seed(name),
                )
            )
    return replace(world, mapping=tuple(mapping), rig_from_world=rig_from_world)


def _queries_near_map(world: SyntheticWorld) -> SyntheticWorld:
    """Return the world with its queries next to evenly sampled map images."""
    every = len(world.mapping) // max(len(world.queries), 1)
    offset = RigidTransform((1.0, 0.0, 0.0, 0.0), _QUERY_OFFSET_M)
    queries = [
        replace(query, place=near.place, cam_from_world=offset @ near.cam_from_world)
        for query, near in zip(world.queries, world.mapping[1::every], strict=False)
    ]
    return replace(world, queries=tuple(queries))


def _with_depth(data: KaptureData) -> KaptureData:
    """Add a depth sensor at the pose of each camera."""
    for (timestamp, sensor), image in data.records_camera.items():
        depth = f"{sensor}_depth"
        camera = data.sensors[sensor].camera()
        data.sensors[depth] = Sensor.from_camera(camera, name=depth, sensor_type="depth")
        identity = RigidTransform.identity()
        data.rigs[f"{sensor}_rig"] = {sensor: identity, depth: identity}
        data.records_depth[timestamp, depth] = depth_name(image)
    return data


def write_displaced_truth(query: KaptureFolder, truth: KaptureFolder, output: Path) -> int:
    """Write the true poses of ``query``, displaced by 5 cm, as a localization result.

    Returns
    -------
    Number of poses.
    """
    data, poses = query.read(), truth.read().poses()
    rng = np.random.default_rng(0)
    for image, pose in sorted(poses.items()):
        offset = rng.normal(size=3)
        offset *= _DISPLACED_M / np.linalg.norm(offset)
        shift = RigidTransform(pose.quat_wxyz, tuple(np.add(pose.translation, offset).tolist()))
        data.trajectories[data.record_of(image)] = shift
    data.rigs.clear()
    data.records_depth.clear()
    write_sensors(output, data)
    link_images(query.root, output)
    write_status(output / STATUS_FILE, [LocalizationResult(name=name) for name in poses])
    return len(poses)
