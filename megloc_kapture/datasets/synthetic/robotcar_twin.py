"""A rendered twin of RobotCar Seasons in its official layout, with its truth beside it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.colmap_model import ColmapImage, ColmapModel, write_colmap_text
from megloc_kapture.datasets.formats.nvm import NvmModel, write_nvm
from megloc_kapture.datasets.formats.sparse_points import SparsePoints
from megloc_kapture.datasets.official import GROUND_TRUTH
from megloc_kapture.datasets.robotcar.images import RIG_ID
from megloc_kapture.datasets.robotcar.layout import Layout
from megloc_kapture.datasets.synthetic.map_shots import MapShots, draw_map_and_queries
from megloc_kapture.datasets.synthetic.options import stream
from megloc_kapture.datasets.synthetic.robotcar_shots import (
    CAMERAS,
    SCORED_CAMERA,
    Moment,
    RobotCarMoments,
    RobotCarTwinOptions,
    build_robotcar_moments,
    cam_from_car,
    car_cameras,
    official,
)
from megloc_kapture.datasets.synthetic.shots import Shot
from megloc_kapture.datasets.synthetic.sift_points import write_sift_database
from megloc_kapture.io.files import write_bytes
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.stages.work import Track, untracked
from megloc_kapture.values import Camera, RigidTransform

__all__ = ["ROBOTCAR_TWIN_VERSION", "RobotCarTwinOptions", "write_robotcar_twin"]

# raise when the same options give other files than before
ROBOTCAR_TWIN_VERSION = 2
# moments of these traversals, the last of each, are in neither list of version 2
_UNLISTED_CONDITIONS = ("rain", "night-rain")

Item = TypeVar("Item")


def write_robotcar_twin(
    root: Path,
    options: RobotCarTwinOptions | None = None,
    executor: Executor | None = None,
    *,
    track: Track = untracked,
) -> dict[str, int]:
    """Draw the twin and write it as the dataset is published; returns what it holds.

    ``images/``, ``intrinsics/``, ``extrinsics/``, ``3D-models/`` (the merged NVM, text models and
    lists of queries by location), version 2's lists and ``ground_truth/``. Quirks of the original:
    the models say ``.png`` where the images are ``.jpg``, the NVM puts ``./`` before them, the
    test list leaves out the conditions, some reference images are in no model and some queries
    in neither list of version 2; and lists end in a blank line, with CRLF or without a line end.
    With ``model_features`` also ``3D-models/overcast-reference.db``, the features of the models.
    The bytes depend on the options only, not on the executor.

    Parameters
    ----------
    executor : shares the drawing among processes that see the same file system.
    track : shows progress, image by image.

    Raises
    ------
    OutputError : something cannot be written.
    """
    layout = Layout(Path(root))
    options = options or RobotCarTwinOptions()
    moments = build_robotcar_moments(options)
    mapping = moments.mapping_shots()
    drawn = draw_map_and_queries(
        options.world(),
        mapping,
        moments.query_shots(),
        layout.images,
        model_features=options.model_features,
        executor=executor,
        track=track,
    )
    registered = official(_registered(moments))
    _write_models(layout, options, registered, drawn)
    if options.model_features:
        named = {_png(shot.name): shot for shot in mapping}
        write_sift_database(layout.feature_database, dict(sorted(named.items())), drawn.features)
    _write_car(layout, options)
    _write_query_lists(layout, moments)
    _write_version_2(layout, options, moments)
    for role, some in (("mapping", registered), ("query", official(moments.query_shots()))):
        write_sensors(layout.root / GROUND_TRUTH / role, _truth(some))
    return {
        "places": options.num_locations,
        "mapping images": len(registered),
        "query images": len(moments.query_shots()),
    }


def location_name(place: int) -> str:
    """Number of a location as file names have it."""
    return f"{place + 1:03d}"


def _registered(moments: RobotCarMoments) -> list[Shot]:
    """The reference images that the models have: of each location one is left out."""
    last = {moment.place: moment.timestamp for moment in moments.reference}
    return [
        shot
        for shot in moments.mapping_shots()
        if (shot.sensor_id, shot.timestamp) != ("right", last[shot.place])
    ]


def _write_models(
    layout: Layout, options: RobotCarTwinOptions, shots: Sequence[Shot], drawn: MapShots
) -> None:
    """One model per location, and all of them in one, in the same world."""
    places = np.array([shot.place for shot in shots])
    parts = []
    for place in range(options.num_locations):
        positions = np.flatnonzero(places == place).tolist()
        here = [shots[position] for position in positions]
        rng = stream(options.seed, "robotcar", "points", place)
        points = drawn.points(here, points_per_shot=options.points_per_image, rng=rng)
        folder = layout.individual_model(location_name(place))
        write_colmap_text(folder, _colmap_model(here, points))
        parts.append((points, positions))
    merged = NvmModel(
        names=tuple(f"./{_png(shot.name)}" for shot in shots),
        focal_px=np.array([shot.camera.params[0] for shot in shots]),
        quat_wxyz=np.array([shot.cam_from_world.quat_wxyz for shot in shots]),
        centers=np.array([shot.cam_from_world.center() for shot in shots]),
        k_colmap=np.zeros(len(shots)),
        points=SparsePoints.joined(parts),
    )
    write_nvm(layout.merged_model, merged)


def _colmap_model(shots: Sequence[Shot], points: SparsePoints) -> ColmapModel:
    """With the published models' cameras: 1 left, 2 rear, 3 right, SIMPLE_RADIAL."""
    ids = {name: number for number, name in enumerate(CAMERAS, start=1)}
    cameras = {}
    for shot in shots:
        fx, _, cx, cy = shot.camera.params
        size = (shot.camera.width, shot.camera.height)
        cameras[ids[shot.sensor_id]] = Camera("SIMPLE_RADIAL", *size, (fx, cx, cy, 0.0))
    images = tuple(
        ColmapImage(number, _png(shot.name), ids[shot.sensor_id], shot.cam_from_world)
        for number, shot in enumerate(shots, start=1)
    )
    return ColmapModel(cameras, images, points)


def _write_car(layout: Layout, options: RobotCarTwinOptions) -> None:
    for name, camera in car_cameras(options.size_px).items():
        lines = [
            f"{key} {value:f}"
            for key, value in zip(("fx", "fy", "cx", "cy"), camera.params, strict=True)
        ]
        _write_lines(layout.intrinsics(name), lines)
    for name, pose in cam_from_car().items():
        rows = [",".join(map(repr, row)) for row in _matrix(pose.inverse()).tolist()]
        _write_lines(layout.extrinsics(name), rows)


def _write_query_lists(layout: Layout, moments: RobotCarMoments) -> None:
    """All cameras' queries; the files' ends are as different as tools have left them."""
    for place in sorted({moment.place for moment in moments.queries}):
        names = [shot.name for shot in moments.query_shots() if shot.place == place]
        path = layout.query_list(location_name(place))
        if place % 3 == 0:
            _write_lines(path, [*names, ""])
        elif place % 3 == 1:
            _write_lines(path, names, line_end="\r\n")
        else:
            _write_lines(path, names, last_line_ends=False)


def _write_version_2(
    layout: Layout, options: RobotCarTwinOptions, moments: RobotCarMoments
) -> None:
    """Half of each traversal's moments with poses, half without; a few in neither list."""
    train, test = [], []
    for condition in dict.fromkeys(moment.condition for moment in moments.queries):
        here = [moment for moment in moments.queries if moment.condition == condition]
        # by turns, so that both lists have moments of all locations
        listed = here[:-1] if condition in _UNLISTED_CONDITIONS else here
        train += [_scored_shot(moment) for moment in listed[::2]]
        test += [_scored_shot(moment) for moment in listed[1::2]]
    rows = []
    for shot in _shuffled(official(train), options, "train"):
        matrix = _matrix(shot.cam_from_world.inverse()).ravel().tolist()
        rows.append(" ".join([_png(shot.name), *map(repr, matrix)]))
    _write_lines(layout.train_list, rows)
    names = [f"{shot.sensor_id}/{shot.timestamp}.png" for shot in test]
    _write_lines(layout.test_list, _shuffled(names, options, "test"))


def _scored_shot(moment: Moment) -> Shot:
    return moment.shots[CAMERAS.index(SCORED_CAMERA)]


def _truth(shots: Sequence[Shot]) -> KaptureData:
    data = KaptureData(rigs={RIG_ID: cam_from_car()})
    for shot in shots:
        data.sensors[shot.sensor_id] = Sensor.from_camera(shot.camera, name=shot.sensor_id)
        data.records_camera[shot.timestamp, shot.sensor_id] = shot.name
        data.trajectories[shot.timestamp, shot.sensor_id] = shot.cam_from_world
    return data


def _matrix(pose: RigidTransform) -> NDArray[np.float64]:
    """float64 (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation_matrix(), pose.translation
    return matrix


def _png(name: str) -> str:
    return name.removesuffix(".jpg") + ".png"


def _shuffled(items: Sequence[Item], options: RobotCarTwinOptions, label: str) -> list[Item]:
    order = stream(options.seed, "robotcar", "order", label).permutation(len(items))
    return [items[index] for index in order]


def _write_lines(
    path: Path, lines: Sequence[str], *, line_end: str = "\n", last_line_ends: bool = True
) -> None:
    write_bytes(path, (line_end.join(lines) + line_end * last_line_ends).encode())
