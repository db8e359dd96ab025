"""A small rendered scene on which every stage of the preset ``megloc`` has something to do.

The rendered world as plain kapture, and of the queries depth as well: the map's cameras are a rig
on a round, with depth and with masks of the car's bonnet; the queries are telephones with lens
distortion whose depth lets them be refined by ICP.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from megloc_twins.frames import kapture_records, noise_seed
from megloc_twins.options import SyntheticWorldOptions
from megloc_twins.render import render_frames
from megloc_twins.synthetic_kapture import (
    SENSOR_FROM_RIG,
    SyntheticWorld,
    build_world,
    depth_name,
    mapping_data,
    write_files,
    write_side_tables,
)

from megloc_kapture.io.files import link_images
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.io.tables import STATUS_FILE, write_status
from megloc_kapture.values import LocalizationResult, RigidTransform

_STEP_M = 0.3  # to the side, between the images of a stop
_BESIDE_M = (-0.15, 0.05, 0.0)  # of a query that is taken beside a map image, in its frame
_DISPLACED_M = 0.05


@dataclass(frozen=True)
class Scene:
    """What is rendered.

    Attributes
    ----------
    world : the rendered world.
    steps : images that each of the rig's cameras takes at a stop, 30 cm from one to the next.
    beside : queries are taken 15 cm beside map images, not anywhere.
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
# what random networks see of a place changes with every step: they match views that are near
RANDOM_SCENE = Scene(
    FREE_SCENE.world.model_copy(
        update={"stations_per_place": 3, "day_queries": 4, "width": 320, "height": 240}
    ),
    steps=2,
    beside=True,
)


def write_scene(root: Path, scene: Scene) -> None:
    """Draw the scene and write mapping/, query/, query_gt/ and megloc/ below ``root``."""
    world = build_world(scene.world)
    world = _stepped(world, scene.steps)
    if scene.beside:
        world = _queries_beside(world)
    names = [shot.name for shot in world.frames()]
    render_frames(
        world.options, world.frames(), partial(write_files, root, world.options), with_depth=names
    )
    write_sensors(root / "mapping", mapping_data(world))
    write_sensors(root / "query", _with_depth(kapture_records(world.queries, poses=False)))
    write_sensors(root / "query_gt", kapture_records(world.queries))
    write_side_tables(root / "megloc", world)


def _stepped(world: SyntheticWorld, steps: int) -> SyntheticWorld:
    """The world whose rig takes several images at each stop, side by side."""
    mapping, rig_from_world = [], {}
    for shot in world.mapping:
        for step in range(steps):
            aside = RigidTransform((1.0, 0.0, 0.0, 0.0), (-_STEP_M * step, 0.0, 0.0))
            pose = aside @ world.rig_from_world[shot.timestamp]
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
                    noise_seed=noise_seed(world.options.seed, name),
                )
            )
    return replace(world, mapping=tuple(mapping), rig_from_world=rig_from_world)


def _queries_beside(world: SyntheticWorld) -> SyntheticWorld:
    """The world whose queries stand beside map images, spread over all of them."""
    every = len(world.mapping) // max(len(world.queries), 1)
    beside = RigidTransform((1.0, 0.0, 0.0, 0.0), _BESIDE_M)
    queries = [
        replace(query, place=near.place, cam_from_world=beside @ near.cam_from_world)
        for query, near in zip(world.queries, world.mapping[1::every], strict=False)
    ]
    return replace(world, queries=tuple(queries))


def _with_depth(data: KaptureData) -> KaptureData:
    """Records of queries, with a depth sensor in the place of each one's camera."""
    for (timestamp, sensor), image in data.records_camera.items():
        depth = f"{sensor}_depth"
        camera = data.sensors[sensor].camera()
        data.sensors[depth] = Sensor.from_camera(camera, name=depth, sensor_type="depth")
        still = RigidTransform.identity()
        data.rigs[f"{sensor}_rig"] = {sensor: still, depth: still}
        data.records_depth[timestamp, depth] = depth_name(image)
    return data


def write_displaced_truth(query: KaptureFolder, truth: KaptureFolder, output: Path) -> int:
    """Write the true poses, each moved by 5 cm, as if they had been estimated.

    Parameters
    ----------
    query : images that the result refers to.

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
