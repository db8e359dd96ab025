"""A rendered twin of Aachen Day-Night: photographs of many people, sequences, phone queries."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.random import Generator
from pydantic import Field

from megloc_kapture.io.colmap_model import ColmapImage, ColmapModel
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Camera
from megloc_twins.frames import Frame, day_lighting, in_frame, write_truth
from megloc_twins.moving_objects import place_moving_objects
from megloc_twins.options import SyntheticDataset, TwinOptions, shuffled, stream, write_lines
from megloc_twins.portable import Float64, looking_at, settled_pose
from megloc_twins.render import render_map_and_queries
from megloc_twins.sparse_models import Depths, as_nvm, exact_tracks, write_colmap_model, write_nvm
from megloc_twins.squares import Place, build_place
from megloc_twins.viewpoints import query_frames

# the published model has y down, and is several hundred metres from the origin
OFFICIAL_FROM_WORLD = settled_pose(
    np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), np.array([738.5, -6.25, -41.75])
)
NUM_UNLISTED = 2  # query images on disk that are in no list
_PORTRAIT_SHARE = 1 / 6
_YAWS_DEG = (0.0, 62.0, -62.0)  # of the photographs taken from about the same spot
_DEVICES = ("nexus4", "milestone", "nexus4", "milestone", "nexus5x")  # by day, in turn
_FILES = {  # image names, formatted with hour, minute, second and a running number
    "day/nexus4": "IMG_20140520_{:02d}{:02d}{:02d}.jpg",
    "day/milestone": "2011-12-17_{:02d}-{:02d}-{:02d}_{}.jpg",
    "day/nexus5x": "IMG_20160914_{:02d}{:02d}{:02d}.jpg",
    "night/nexus5x": "IMG_20161227_{:02d}{:02d}{:02d}.jpg",
    "night/nexus5x_additional_night": "IMG_20180115_{:02d}{:02d}{:02d}.jpg",
}
_WRONG_IMAGE = 1228  # not used: db/1228.jpg has a wrong pose in the published model


class AachenTwinOptions(TwinOptions):
    """Contents of Aachen's twin; ``make eval`` uses the defaults."""

    num_places: int = Field(default=4, ge=1, description="places, at least 60 m apart")
    stations_per_place: int = Field(default=8, ge=3, description="spots of three photographs each")
    sequence_images: int = Field(default=5, ge=2, description="images of a place's sequence")
    day_queries: int = Field(default=24, ge=1, description="query images by day, in total")
    night_queries: int = Field(default=16, ge=1, description="query images at night, in total")
    additional_night_queries: int = Field(default=8, ge=1, description="night queries only in v1.1")
    width: int = Field(default=640, ge=64, description="image width in px; a portrait's height")
    height: int = Field(default=480, ge=48, description="image height in px")


class AachenTwin(SyntheticDataset[AachenTwinOptions]):
    """Aachen Day-Night v1.1 in its published layout, which includes v1.0, with true poses.

    ``images_upright/``, ``3D-models/`` (v1.0's NVM and ``database_intrinsics.txt``;
    ``aachen_v_1_1/`` with a binary COLMAP model), ``queries/`` and ``ground_truth/``. Quirks
    of the original: database images are numbered at random, the NVM is ordered differently, feature
    numbers in the NVM have gaps, v1.1's night list replaces v1.0's, lists lack the last line break,
    and some images below ``query/`` are in no list.
    """

    Options = AachenTwinOptions
    version = 3

    def write(self, root: Path, work: Work = HERE) -> dict[str, int]:
        root, options = Path(root), self.options
        models = root / "3D-models"
        frames = build_aachen_frames(options)
        mapping = in_frame(frames.mapping(), OFFICIAL_FROM_WORLD)
        database = mapping[: len(frames.database)]
        others, images = [*frames.queries(), *frames.unlisted], root / "images_upright"
        depths_m = render_map_and_queries(options, frames.mapping(), others, images, work)
        _write_nvm_model(models, options, database, depths_m)
        _write_colmap_model(models / "aachen_v_1_1", options, mapping, depths_m)
        for when, listed in (("day", frames.day), ("night", frames.night)):
            path = root / f"queries/{when}_time_queries_with_intrinsics.txt"
            _write_cameras(path, listed, last_line_ends=False)
        queries = in_frame(frames.queries(), OFFICIAL_FROM_WORLD)
        # no two images were taken at the same time
        timed = (
            [replace(frame, timestamp=time) for time, frame in enumerate(some)]
            for some in (mapping, queries)
        )
        return {"places": options.num_places} | write_truth(root, *timed)


@dataclass(frozen=True, eq=False)
class AachenFrames:
    """All images with their official names, and with poses in the rendered world."""

    database: list[Frame]  # map images with separate cameras, in the order of the NVM
    sequences: list[Frame]  # map images, with one sensor per sequence
    day: list[Frame]  # queries in the order of the lists
    night: list[Frame]  # queries of v1.0, then those added by v1.1
    unlisted: list[Frame]  # below ``query/``, but in no list

    def mapping(self) -> list[Frame]:
        return self.database + self.sequences

    def queries(self) -> list[Frame]:
        return self.day + self.night


def build_aachen_frames(options: AachenTwinOptions) -> AachenFrames:
    world = options.world()
    # numbers of the database images, unordered and with gaps
    count = options.num_places * options.stations_per_place * len(_YAWS_DEG)
    drawn = stream(options.seed, "aachen", "numbers").permutation(2 * count + 50) + 1
    numbers = iter(drawn[drawn != _WRONG_IMAGE].tolist())
    database: list[Frame] = []
    sequences: list[Frame] = []
    day: list[Frame] = []
    night: list[Frame] = []
    num_day, num_v1_0 = options.day_queries, options.night_queries
    num_night = num_v1_0 + options.additional_night_queries
    for index in range(options.num_places):
        place = build_place(world, index)
        album = list(_photographs(options, place, numbers))
        database += album
        sequences += _sequence(options, place)
        day += query_frames(world, place, album, "day", num_day + NUM_UNLISTED)
        night += query_frames(world, place, album, "night", num_night)
    day, night = _as_telephones(day, "day", options), _as_telephones(night, "night", options)
    return AachenFrames(
        database=shuffled(database, options.seed, "aachen", "order", "nvm"),
        sequences=sequences,
        day=shuffled(day[:num_day], options.seed, "aachen", "order", "day"),
        night=shuffled(night[:num_v1_0], options.seed, "aachen", "order", "night")
        + shuffled(night[num_v1_0:], options.seed, "aachen", "order", "additional"),
        unlisted=day[num_day:],
    )


def _photographs(
    options: AachenTwinOptions, place: Place, numbers: Iterator[int]
) -> Iterator[Frame]:
    """Yield a place's map images, each with a separate camera, taken on two sunny days."""
    rng = stream(options.seed, "aachen", "database", place.index)
    suns = [(rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(40, 60))) for _ in range(2)]
    for station, (spot, heading) in enumerate(place.plan.stops(options.stations_per_place)):
        # photographs of a day are consecutive, so that its shadow map is computed once
        sun = suns[2 * station // options.stations_per_place]
        for yaw_deg in _YAWS_DEG:
            number = next(numbers)
            at = np.array([*spot + rng.normal(0, 0.15, 2), rng.uniform(1.5, 1.9)])
            yaw = heading + np.radians(yaw_deg) + float(rng.normal(0, 0.1))
            camera = _photo_camera(options, rng)
            names = f"db/{number}.jpg", f"db_{number}"
            yield _map_frame(options, place, names, camera, at, yaw, sun, rng)


def _sequence(options: AachenTwinOptions, place: Place) -> Iterator[Frame]:
    """Yield a sequence: a few images along the path of a place, by one camera facing left."""
    rng = stream(options.seed, "aachen", "sequence", place.index)
    sun = (float(rng.uniform(-np.pi, np.pi)), float(np.radians(rng.uniform(40, 60))))
    width, height = options.width, options.height
    if place.index == 0:
        folder, file = "sequences/gopro3_undistorted", "gopro_{:05d}.png"
        camera = Camera("PINHOLE", width, height, (0.7 * width,) * 2 + (width / 2, height / 2))
    else:
        folder = f"sequences/nexus4_sequences/sequence_{place.index}"
        file = "frame_{:06d}.jpg"
        camera = _photo_camera(options, rng, portraits=False)
    # steps of half the distance between the spots of the photographs
    steps = place.plan.stops(max(2 * options.stations_per_place, options.sequence_images))
    for step, (spot, heading) in enumerate(steps[: options.sequence_images]):
        at = np.array([*spot, 1.6 + rng.normal(0, 0.02)])
        yaw = heading + np.pi / 2 + float(rng.normal(0, 0.05))
        names = f"{folder}/{file.format(30 * step + 1)}", folder
        yield _map_frame(options, place, names, camera, at, yaw, sun, rng)


def _map_frame(
    options: AachenTwinOptions,
    place: Place,
    names: tuple[str, str],
    camera: Camera,
    at: Float64,
    yaw: float,
    sun: tuple[float, float],
    rng: Generator,
) -> Frame:
    """Return a hand-held image at a position; ``names`` are the image's and the sensor's."""
    pitch, roll = (float(a) for a in rng.normal(0.02, 0.03, 2))
    return Frame(
        name=names[0],
        condition="day",
        place=place.index,
        timestamp=0,  # replaced when the frames are written
        sensor_id=names[1],
        camera=camera,
        cam_from_world=looking_at(at, yaw, pitch, roll) @ place.place_from_world,
        lighting=day_lighting(rng, sun, overcast=0.15),
        noise_seed=options.noise_seed(names[0]),
        moving_objects=place_moving_objects(place.plan, rng, options.world().moving_objects, at),
    )


def _photo_camera(options: AachenTwinOptions, rng: Generator, *, portraits: bool = True) -> Camera:
    """Draw a SIMPLE_RADIAL camera with a central principal point, some in portrait format."""
    width, height = options.width, options.height
    focal, k = rng.uniform(0.7, 0.9) * width, rng.uniform(-0.1, 0.02)
    if rng.random() < _PORTRAIT_SHARE and portraits:
        width, height = height, width
    return _simple_radial(width, height, focal, k)


def _simple_radial(width: int, height: int, focal: float, k: float) -> Camera:
    """Round to the six digits of the published lists."""
    params = (float(f"{focal:.6g}"), width / 2, height / 2, float(f"{k:.6g}"))
    return Camera("SIMPLE_RADIAL", width, height, params)


def _as_telephones(frames: list[Frame], condition: str, options: AachenTwinOptions) -> list[Frame]:
    """Return the queries sorted by number, with names of phones as in the lists."""
    renamed = []
    for number, frame in enumerate(sorted(frames, key=lambda frame: frame.timestamp)):
        focal, _, _, k = frame.camera.params
        camera = _simple_radial(frame.camera.width, frame.camera.height, focal, k)
        if condition == "day":
            folder, first_hour = f"day/{_DEVICES[number % len(_DEVICES)]}", 14
        else:
            added = "_additional_night" if number >= options.night_queries else ""
            folder, first_hour = f"night/nexus5x{added}", 18
        second = 37 * number  # so that times differ
        clock = first_hour + second // 3600, second // 60 % 60, second % 60
        name = f"query/{folder}/{_FILES[folder].format(*clock, 257 + number)}"
        renamed.append(replace(frame, name=name, camera=camera))
    return renamed


def _write_nvm_model(
    folder: Path, options: AachenTwinOptions, frames: Sequence[Frame], depths_m: Depths
) -> None:
    """Write v1.0's NVM, which has only focal lengths, and the list of complete cameras."""
    rng = stream(options.seed, "aachen", "points", "1.0")
    points = exact_tracks(frames, depths_m, rng)
    # as if some features observed no point
    points = replace(points, feature_ids=3 * points.feature_ids + 1)
    names = [frame.name for frame in frames]
    write_nvm(folder / "aachen_cvpr2018_db.nvm", as_nvm(names, frames, points))
    by_name = sorted(frames, key=lambda frame: frame.name)
    _write_cameras(folder / "database_intrinsics.txt", by_name, last_line_ends=True)


def _write_colmap_model(
    folder: Path, options: AachenTwinOptions, frames: Sequence[Frame], depths_m: Depths
) -> None:
    """Write v1.1's model: image and camera ids are unordered, and a sequence shares a camera."""
    rng = stream(options.seed, "aachen", "points", "1.1")
    frames = [frames[index] for index in rng.permutation(len(frames))]
    cameras = {frame.sensor_id: frame.camera for frame in frames}
    camera_ids = dict(zip(cameras, (rng.permutation(len(cameras)) + 1).tolist(), strict=True))
    image_ids = (rng.permutation(2 * len(frames)) + 1).tolist()
    model = ColmapModel(
        cameras={camera_ids[sensor]: camera for sensor, camera in cameras.items()},
        images=tuple(
            ColmapImage(image_id, frame.name, camera_ids[frame.sensor_id], frame.cam_from_world)
            for image_id, frame in zip(image_ids, frames, strict=False)
        ),
        points=exact_tracks(frames, depths_m, rng),
    )
    write_colmap_model(folder, model, text=False)


def _write_cameras(path: Path, frames: Sequence[Frame], *, last_line_ends: bool) -> None:
    """Write a camera list; numbers have the fewest digits that preserve their value."""
    lines = []
    for frame in frames:
        camera = frame.camera
        numbers = [str(int(v)) if v.is_integer() else repr(v) for v in camera.params]
        size = f"{camera.width} {camera.height}"
        lines.append(" ".join((frame.name, camera.model, size, *numbers)))
    write_lines(path, lines, last_line_ends=last_line_ends)
