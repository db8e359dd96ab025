"""A rendered twin of Aachen Day-Night in its official layout, with its truth beside it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

import numpy as np

from megloc_kapture.datasets.aachen.layout import Layout
from megloc_kapture.datasets.formats.colmap_model import (
    ColmapImage,
    ColmapModel,
    write_colmap_binary,
)
from megloc_kapture.datasets.formats.nvm import NvmModel, write_nvm
from megloc_kapture.datasets.formats.query_list import write_query_list
from megloc_kapture.datasets.official import GROUND_TRUTH
from megloc_kapture.datasets.synthetic.aachen_shots import (
    AachenShots,
    AachenTwinOptions,
    build_aachen_shots,
    official,
)
from megloc_kapture.datasets.synthetic.map_shots import MapShots, draw_map_and_queries
from megloc_kapture.datasets.synthetic.options import stream
from megloc_kapture.datasets.synthetic.shots import Shot
from megloc_kapture.datasets.synthetic.sift_points import write_sift_database
from megloc_kapture.io.files import write_bytes
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.stages.work import Track, untracked

__all__ = ["AACHEN_TWIN_VERSION", "AachenTwinOptions", "write_aachen_twin"]

# raise when the same options give other files than before
AACHEN_TWIN_VERSION = 2
_IMAGES = "images_upright"
_MODELS = "3D-models"


def write_aachen_twin(
    root: Path,
    options: AachenTwinOptions | None = None,
    executor: Executor | None = None,
    *,
    track: Track = untracked,
) -> dict[str, int]:
    """Draw the twin and write it as the dataset is published; returns what it holds.

    ``images_upright/``, ``3D-models/`` (NVM, its list and ``database_intrinsics.txt``; for v1.1
    also ``aachen_v_1_1/`` with a binary COLMAP model), ``queries/`` and ``ground_truth/``. Quirks
    of the original: database images are numbered without order and the NVM has an order of its
    own, features of the NVM are not numbered densely, v1.1's night list stands in the place of
    v1.0's, lists end without a line end, and some images below ``query/`` are in no list. With
    ``model_features`` also ``aachen.db``, the features of v1.0's model; none of v1.1's are
    published. The bytes depend on the options only, not on the executor.

    Parameters
    ----------
    executor : shares the drawing among processes that see the same file system.
    track : shows progress, image by image.

    Raises
    ------
    OutputError : something cannot be written.
    """
    root = Path(root)
    options = options or AachenTwinOptions()
    shots = build_aachen_shots(options)
    drawn = draw_map_and_queries(
        options.world(),
        shots.mapping(),
        [*shots.queries(), *shots.unlisted],
        root / _IMAGES,
        model_features=options.model_features,
        executor=executor,
        track=track,
    )
    _write_nvm_model(root / _MODELS, options, official(shots.database), drawn)
    if options.model_features:
        database = {shot.name: shot for shot in sorted(shots.database, key=attrgetter("name"))}
        write_sift_database(Layout(root).feature_database, database, drawn.features)
    if options.version == "1.1":
        _write_colmap_model(
            root / _MODELS / "aachen_v_1_1", options, official(shots.mapping()), drawn
        )
    _write_lists(root / "queries", shots)
    for role, some in (("mapping", shots.mapping()), ("query", shots.queries())):
        write_sensors(root / GROUND_TRUTH / role, _truth(official(some)))
    return {
        "places": options.num_places,
        "mapping images": len(shots.mapping()),
        "query images": len(shots.queries()),
    }


def _write_nvm_model(
    folder: Path,
    options: AachenTwinOptions,
    shots: Sequence[Shot],
    drawn: MapShots,
) -> None:
    """v1.0's model, which knows only focal lengths, and the list that has the whole cameras."""
    rng = stream(options.seed, "aachen", "points", "1.0")
    points = drawn.points(shots, points_per_shot=options.points_per_image, rng=rng)
    if not drawn.features:
        # as if the images had more features than see a point
        points = replace(points, feature_ids=3 * points.feature_ids + 1)
    cameras = {shot.name: shot.camera for shot in shots}
    model = NvmModel(
        names=tuple(cameras),
        focal_px=np.array([camera.params[0] for camera in cameras.values()]),
        quat_wxyz=np.array([shot.cam_from_world.quat_wxyz for shot in shots]),
        centers=np.array([shot.cam_from_world.center() for shot in shots]),
        k_colmap=np.array([camera.params[3] for camera in cameras.values()]),
        points=points,
    )
    write_nvm(folder / "aachen_cvpr2018_db.nvm", model)
    _write_names(folder / "aachen_cvpr2018_db.list.txt", model.names)
    write_query_list(folder / "database_intrinsics.txt", dict(sorted(cameras.items())))


def _write_colmap_model(
    folder: Path,
    options: AachenTwinOptions,
    shots: Sequence[Shot],
    drawn: MapShots,
) -> None:
    """v1.1's model: image and camera ids have no order, and a sequence shares its camera."""
    rng = stream(options.seed, "aachen", "points", "1.1")
    shots = [shots[index] for index in rng.permutation(len(shots))]
    cameras = {shot.sensor_id: shot.camera for shot in shots}
    camera_ids = dict(zip(cameras, (rng.permutation(len(cameras)) + 1).tolist(), strict=True))
    image_ids = (rng.permutation(2 * len(shots)) + 1).tolist()
    model = ColmapModel(
        cameras={camera_ids[sensor]: camera for sensor, camera in cameras.items()},
        images=tuple(
            ColmapImage(image_id, shot.name, camera_ids[shot.sensor_id], shot.cam_from_world)
            for image_id, shot in zip(image_ids, shots, strict=False)
        ),
        points=drawn.points(shots, points_per_shot=options.points_per_image, rng=rng),
    )
    write_colmap_binary(folder, model)


def _write_lists(folder: Path, shots: AachenShots) -> None:
    night = shots.night + shots.additional_night
    for when, some in (("day", shots.day), ("night", night)):
        write_query_list(
            folder / f"{when}_time_queries_with_intrinsics.txt",
            {shot.name: shot.camera for shot in some},
            last_line_ends=False,
        )
    names = [shot.name for shot in shots.day]
    _write_names(folder / "day_time_queries_without_intrinsics.txt", names)


def _write_names(path: Path, names: Sequence[str]) -> None:
    write_bytes(path, ("\n".join(names) + "\n").encode())


def _truth(shots: Sequence[Shot]) -> KaptureData:
    data = KaptureData()
    for timestamp, shot in enumerate(shots):
        data.sensors[shot.sensor_id] = Sensor.from_camera(shot.camera)
        data.records_camera[timestamp, shot.sensor_id] = shot.name
        data.trajectories[timestamp, shot.sensor_id] = shot.cam_from_world
    return data
