"""A rendered twin of RobotCar Seasons: a car with three cameras, streets in all weathers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.random import Generator
from pydantic import Field

from megloc_kapture.datasets.robotcar import Layout
from megloc_kapture.datasets.robotcar.images import RIG_ID
from megloc_kapture.io.colmap_model import ColmapImage, ColmapModel, SparsePoints
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Camera, RigidTransform
from megloc_twins.frames import Frame, in_frame, road_lighting, write_truth
from megloc_twins.moving_objects import place_moving_objects
from megloc_twins.options import (
    SyntheticDataset,
    SyntheticWorldOptions,
    TwinOptions,
    shuffled,
    stream,
    write_lines,
)
from megloc_twins.portable import Float64, cam_from_rig, looking_at, settled_pose
from megloc_twins.render import render_map_and_queries
from megloc_twins.sparse_models import Depths, as_nvm, exact_tracks, write_colmap_model, write_nvm
from megloc_twins.squares import Place, build_place
from megloc_twins.viewpoints import CoarseView, coarse_view, first_fitting, misfit, views_of

REFERENCE_CONDITION = "overcast-reference"
SCORED_CAMERA = "rear"  # also shows the car's boot

# published coordinates are in metres with z up, and differ from those of the rendered world
OFFICIAL_FROM_WORLD = settled_pose(
    np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    np.array([-412.25, 1381.5, 62.75]),
)
# time of the first image of each traversal, microseconds
_STARTS_US = {
    REFERENCE_CONDITION: 1417176458999821,
    "dawn": 1418721355075498,
    "overcast-winter": 1423840721124367,
    "rain": 1416908241836249,
    "sun": 1425990211450168,
    "night": 1418235223450115,
    "night-rain": 1418840689734892,
}
CONDITIONS = tuple(_STARTS_US)[1:]  # of the queries
_PLACE_US, _STOP_US = 60_000_000, 1_062_501
_CAMERA_HEIGHT_M = 1.6
# viewing directions of the cameras, degrees to the right of straight ahead and upwards, and their
# positions, metres to the right, down and ahead of the car's origin
CAM_FROM_CAR = {
    "left": cam_from_rig(-84.0, 3.0, (-0.35, 0.02, -0.1)),
    "rear": cam_from_rig(179.2, -4.0, (0.06, 0.15, -1.1)),
    "right": cam_from_rig(86.0, 2.0, (0.34, 0.03, -0.1)),
}
_CENTRES = {"left": (0.4884, 0.4995), "rear": (0.4963, 0.4865), "right": (0.4907, 0.4788)}
_FOCAL = 0.6  # focal length over the image width
_MIN_OVERLAP = 0.1  # smallest overlap of a map image that supports a query
_ATTEMPTS = 50
_STEPS = 997  # number of possible positions of a query along the path
# the last moment of each of these traversals is in neither list of version 2
_UNLISTED_CONDITIONS = ("rain", "night-rain")


class RobotCarTwinOptions(TwinOptions):
    """Contents of RobotCar Seasons' twin; ``make eval`` uses the defaults."""

    num_locations: int = Field(default=3, ge=1, description="locations, at least 60 m apart")
    stops_per_location: int = Field(default=12, ge=3, description="map moments per location")
    moments_per_condition: int = Field(default=8, ge=2, description="moments per query traversal")
    size_px: int = Field(default=512, ge=64, description="width and height of an image")

    def world(self) -> SyntheticWorldOptions:
        sizes = {"num_places": self.num_locations, "width": self.size_px, "height": self.size_px}
        return super().world().model_copy(update=sizes)


class RobotCarTwin(SyntheticDataset[RobotCarTwinOptions]):
    """RobotCar Seasons in its published layout, with true poses.

    ``images/``, ``intrinsics/``, ``extrinsics/``, ``3D-models/`` (the merged NVM, text models and
    lists of queries by location), version 2's lists and ``ground_truth/``. Quirks of the original:
    names in the models end in ``.png`` although images are ``.jpg``, and in the NVM begin with
    ``./``; the test list omits the conditions; some reference images are in no model and some
    queries in neither list of version 2; lists end with a blank line, have CRLF line breaks or lack
    the last line break.
    """

    Options = RobotCarTwinOptions
    version = 3

    def write(self, root: Path, work: Work = HERE) -> dict[str, int]:
        layout, options = Layout(Path(root)), self.options
        mapping, queries = build_robotcar_frames(options)
        depths_m = render_map_and_queries(options, mapping, queries, layout.images, work)
        last = {frame.place: frame.timestamp for frame in mapping}
        # all but one reference image per location are in the models
        registered = [
            frame
            for frame in in_frame(mapping, OFFICIAL_FROM_WORLD)
            if (frame.sensor_id, frame.timestamp) != ("right", last[frame.place])
        ]
        queries = in_frame(queries, OFFICIAL_FROM_WORLD)
        _write_models(layout, options, registered, depths_m)
        _write_car(layout, options)
        _write_query_lists(layout, queries)
        _write_version_2(layout, options, queries)
        counts = write_truth(layout.root, registered, queries, rigs={RIG_ID: CAM_FROM_CAR})
        return {"places": options.num_locations} | counts


def build_robotcar_frames(options: RobotCarTwinOptions) -> tuple[list[Frame], list[Frame]]:
    """Choose the map images and queries, three per moment, with poses in the world.

    Map images are sorted by location, then time, queries by condition, then time.
    """
    mapping: list[Frame] = []
    queries: list[Frame] = []
    for index in range(options.num_locations):
        place = build_place(options.world(), index)
        here = list(_reference_frames(options, place))
        views = views_of(place, here)
        for condition in CONDITIONS:
            queries += _query_frames(options, place, views, condition)
        mapping += here
    queries.sort(key=lambda frame: (frame.condition, frame.timestamp))
    return mapping, queries


def car_cameras(size_px: int) -> dict[str, Camera]:
    """Return the cameras by name, PINHOLE with the six decimals of the published files."""
    focal = round(_FOCAL * size_px, 6)
    cameras = {}
    for name, centre in _CENTRES.items():
        cx, cy = (round(share * size_px, 6) for share in centre)
        cameras[name] = Camera("PINHOLE", size_px, size_px, (focal, focal, cx, cy))
    return cameras


def _reference_frames(options: RobotCarTwinOptions, place: Place) -> Iterator[Frame]:
    rng = stream(options.seed, "robotcar", REFERENCE_CONDITION, place.index)
    azimuth = float(rng.uniform(-np.pi, np.pi))
    for number, (spot, heading) in enumerate(place.plan.stops(options.stops_per_location)):
        pose = _car_from_place(spot + rng.normal(0, 0.15, 2), heading + rng.normal(0, 0.1), rng)
        yield from _moment(options, place, REFERENCE_CONDITION, number, pose, azimuth, rng)


def _query_frames(
    options: RobotCarTwinOptions, place: Place, map_views: list[CoarseView], condition: str
) -> Iterator[Frame]:
    azimuth = float(stream(options.seed, "robotcar", condition, place.index).uniform(-np.pi, np.pi))
    for number in range(place.index, options.moments_per_condition, options.num_locations):
        rng = stream(options.seed, "robotcar", condition, place.index, number)
        pose = first_fitting(_query_poses(options, place, map_views, rng))
        yield from _moment(options, place, condition, number, pose, azimuth, rng)


def _moment(
    options: RobotCarTwinOptions,
    place: Place,
    condition: str,
    number: int,
    car_from_place: RigidTransform,
    azimuth: float,
    rng: Generator,
) -> Iterator[Frame]:
    """Yield the three cameras' frames at a moment of a traversal, in the order of CAM_FROM_CAR."""
    jitter = int(rng.integers(0, 1000))
    timestamp = _STARTS_US[condition] + place.index * _PLACE_US + number * _STOP_US + jitter
    car_from_world = car_from_place @ place.place_from_world
    count, position = options.world().moving_objects, car_from_place.center()
    moving_objects = place_moving_objects(place.plan, rng, count, position)
    for camera, intrinsics in car_cameras(options.size_px).items():
        name = f"{condition}/{camera}/{timestamp}.jpg"
        lighting = road_lighting(condition, rng, azimuth=azimuth)
        yield Frame(
            name=name,
            condition=condition,
            place=place.index,
            timestamp=timestamp,
            sensor_id=camera,
            camera=intrinsics,
            cam_from_world=CAM_FROM_CAR[camera] @ car_from_world,
            lighting=lighting,
            noise_seed=options.noise_seed(name),
            moving_objects=moving_objects,
            bonnet=camera == SCORED_CAMERA,
        )


def _query_poses(
    options: RobotCarTwinOptions, place: Place, map_views: list[CoarseView], rng: Generator
) -> Iterator[tuple[float, RigidTransform]]:
    """Yield the misfit of the scored camera's view and ``car_from_place``, near the map's path."""
    camera, cam_on_car = car_cameras(options.size_px)[SCORED_CAMERA], CAM_FROM_CAR[SCORED_CAMERA]
    path = place.plan.stops(_STEPS)
    for _ in range(_ATTEMPTS):
        spot, heading = path[int(rng.integers(_STEPS))]
        aside = np.clip(rng.normal(0, 0.6), -1.2, 1.2)
        spot = spot + aside * np.array([-np.sin(heading), np.cos(heading)])
        yaw = heading + rng.normal(0, 0.12)
        if place.plan.is_free(float(spot[0]), float(spot[1]), 0.9):
            pose = _car_from_place(spot, yaw, rng)
            view = coarse_view(place.surfaces, camera, cam_on_car @ pose)
            yield misfit(view, map_views, min_overlap=_MIN_OVERLAP), pose


def _car_from_place(spot: Float64, yaw: float, rng: Generator) -> RigidTransform:
    """Return the pose of a slightly tilted car at a position (2,) that drives along ``yaw``."""
    pitch, roll = (float(a) for a in rng.normal(0, 0.012, 2))
    height = _CAMERA_HEIGHT_M + float(rng.normal(0, 0.02))
    return looking_at(np.array([*spot, height]), float(yaw), pitch, roll)


def _write_models(
    layout: Layout, options: RobotCarTwinOptions, frames: Sequence[Frame], depths_m: Depths
) -> None:
    """Write one model per location and a merged model, in the same coordinates."""
    parts = []
    for place in range(options.num_locations):
        positions = [index for index, frame in enumerate(frames) if frame.place == place]
        here = [frames[position] for position in positions]
        points = exact_tracks(here, depths_m, stream(options.seed, "robotcar", "points", place))
        folder = layout.individual_model(f"{place + 1:03d}")
        write_colmap_model(folder, _colmap_model(here, points), text=True)
        image_ids = np.array(positions, np.int32)[points.image_ids]
        parts.append(replace(points, image_ids=image_ids))
    names = [f"./{frame.name}".replace(".jpg", ".png") for frame in frames]
    write_nvm(layout.merged_model, as_nvm(names, frames, SparsePoints.joined(parts)))


def _colmap_model(frames: Sequence[Frame], points: SparsePoints) -> ColmapModel:
    """Return a model with the published cameras: 1 left, 2 rear, 3 right, SIMPLE_RADIAL."""
    ids = {name: number for number, name in enumerate(CAM_FROM_CAR, start=1)}
    cameras = {}
    images: list[ColmapImage] = []
    for frame in frames:
        fx, _, cx, cy = frame.camera.params
        camera = replace(frame.camera, model="SIMPLE_RADIAL", params=(fx, cx, cy, 0.0))
        cameras[ids[frame.sensor_id]] = camera
        name = frame.name.replace(".jpg", ".png")
        image_id, camera_id = len(images) + 1, ids[frame.sensor_id]
        images.append(ColmapImage(image_id, name, camera_id, frame.cam_from_world))
    return ColmapModel(cameras, tuple(images), points)


def _write_car(layout: Layout, options: RobotCarTwinOptions) -> None:
    for name, camera in car_cameras(options.size_px).items():
        fx, fy, cx, cy = camera.params
        lines = [f"fx {fx:f}", f"fy {fy:f}", f"cx {cx:f}", f"cy {cy:f}"]
        write_lines(layout.intrinsics(name), lines)
    for name, pose in CAM_FROM_CAR.items():
        rows = [",".join(map(repr, row)) for row in pose.inverse().matrix().tolist()]
        write_lines(layout.extrinsics(name), rows)


def _write_query_lists(layout: Layout, queries: Sequence[Frame]) -> None:
    """Write the queries of all cameras, with the various line breaks of the published files."""
    for place in sorted({frame.place for frame in queries}):
        names = [frame.name for frame in queries if frame.place == place]
        path = layout.query_list(f"{place + 1:03d}")
        if place % 3 == 0:
            write_lines(path, [*names, ""])
        elif place % 3 == 1:
            write_lines(path, names, line_end="\r\n")
        else:
            write_lines(path, names, last_line_ends=False)


def _write_version_2(layout: Layout, options: RobotCarTwinOptions, queries: list[Frame]) -> None:
    """Write version 2's lists: half of each traversal's moments have poses, a few are missing."""
    train: list[Frame] = []
    test: list[Frame] = []
    scored = [frame for frame in queries if frame.sensor_id == SCORED_CAMERA]
    for condition in dict.fromkeys(frame.condition for frame in scored):
        here = [frame for frame in scored if frame.condition == condition]
        # alternately, so that both lists have moments of all locations
        listed = here[:-1] if condition in _UNLISTED_CONDITIONS else here
        train += listed[::2]
        test += listed[1::2]
    rows = []
    for frame in shuffled(train, options.seed, "robotcar", "order", "train"):
        matrix = frame.cam_from_world.inverse().matrix().ravel().tolist()
        rows.append(" ".join([frame.name.replace(".jpg", ".png"), *map(repr, matrix)]))
    write_lines(layout.train_list, rows)
    names = [f"{frame.sensor_id}/{frame.timestamp}.png" for frame in test]
    write_lines(layout.test_list, shuffled(names, options.seed, "robotcar", "order", "test"))
