"""Files of RobotCar Seasons, with images named ``<condition>/<camera>/<microseconds>``."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from megloc_kapture.datasets.nvm import read_nvm
from megloc_kapture.datasets.official import Missing
from megloc_kapture.errors import DataError, require
from megloc_kapture.io.colmap_model import SparsePoints, colmap_model_files, read_colmap_model
from megloc_kapture.io.text_lines import reading_lines, transform_of
from megloc_kapture.values import RigidTransform

CAMERAS = ("left", "rear", "right")
SCORED_CAMERA = "rear"
REFERENCE_CONDITION = "overcast-reference"
_FILE_TYPES = (".jpg", ".png")
_MODEL = re.compile(r"([0-9]{1,6})_aligned")
_QUERY_LIST = re.compile(r"queries_location_([0-9]{1,6})\.txt")
INTRINSICS_KEYS = ("fx", "fy", "cx", "cy")

Value = TypeVar("Value")
ModelChoice = Literal["auto", "merged", "individual"]

_PART = r"[A-Za-z0-9][A-Za-z0-9_-]*"
_IMAGE = re.compile(
    rf"(?:(?P<condition>{_PART})/)?(?P<camera>{_PART})/(?P<stem>[0-9]{{1,19}})\.(?:jpg|png)"
)


@dataclass(frozen=True, slots=True)
class ImageKey:
    """An image of a condition (``""`` if the list omits it), a camera and a time."""

    condition: str
    camera: str
    stem: str

    @property
    def timestamp(self) -> int:
        return int(self.stem)

    @property
    def path(self) -> str:
        """Return the path below ``images/`` without the file suffix."""
        return f"{self.condition}/{self.camera}/{self.stem}"


def parse_image(text: str) -> ImageKey | None:
    """Parse an image name, with or without condition; return None for other names."""
    match = _IMAGE.fullmatch(text.removeprefix("./"))
    if match is None:
        return None
    return ImageKey(match["condition"] or "", match["camera"], match["stem"])


def read_intrinsics(path: Path) -> tuple[float, float, float, float]:
    """Read fx, fy, cx, cy in pixels from ``<camera>_intrinsics.txt``."""
    with reading_lines(path) as lines:
        values = {key: float(text) for key, text in map(str.split, lines)}
    if absent := [key for key in INTRINSICS_KEYS if key not in values]:
        raise DataError(f"{', '.join(absent)} missing", path=path)
    fx, fy, cx, cy = (values[key] for key in INTRINSICS_KEYS)
    return fx, fy, cx, cy


def read_query_location(path: Path) -> list[ImageKey]:
    """Read ``queries_location_NNN.txt``."""
    return list(_read_list(path, lambda fields: None))


def read_test_list(path: Path) -> dict[ImageKey, str]:
    """Read ``robotcar_v2_test.txt``; its names have no condition (``rear/1.png``)."""
    return _read_list(path, lambda fields: fields[0], conditions=False)


def read_train_poses(path: Path) -> dict[ImageKey, RigidTransform]:
    """Read ``robotcar_v2_train.txt``, ``world_from_cam``; return ``cam_from_world``.

    A line is a name and the 16 elements of a 4x4 matrix.
    """
    return _read_list(path, lambda fields: transform_of(fields[1:]).inverse())


def _read_list(
    path: Path, parse: Callable[[list[str]], Value], *, conditions: bool = True
) -> dict[ImageKey, Value]:
    form = "condition/camera/time.jpg" if conditions else "camera/time.png"
    values: dict[ImageKey, Value] = {}
    with reading_lines(path) as lines:
        for fields in map(str.split, lines):
            image = parse_image(fields[0])
            if image is None or (conditions and not image.condition):
                raise DataError(f"expected {form}, got {fields[0]!r}")
            values[image] = parse(fields)
    require(values, "the list has no images", path=path)
    return values


class Layout:
    def __init__(self, root: Path) -> None:
        self.root = Path(root)
        self.images = self.root / "images"
        self.models = self.root / "3D-models"
        self.merged_model = self.models / "all-merged" / "all.nvm"
        self.feature_database = self.models / "overcast-reference.db"
        # version 2: rear query images with public poses, and those with withheld poses
        self.train_list = self.root / "robotcar_v2_train.txt"
        self.test_list = self.root / "robotcar_v2_test.txt"

    def absent(self) -> list[str]:
        return [path.name for path in (self.images, self.models) if not path.is_dir()]

    def intrinsics(self, camera: str) -> Path:
        return self.root / "intrinsics" / f"{camera}_intrinsics.txt"

    def extrinsics(self, camera: str) -> Path:
        return self.root / "extrinsics" / f"{camera}_extrinsics.txt"

    def individual_model(self, location: str) -> Path:
        return self.models / "individual" / "colmap_reconstructions" / f"{location}_aligned"

    def query_list(self, location: str) -> Path:
        folder = self.models / "individual" / "queries_per_location"
        return folder / f"queries_location_{location}.txt"

    def individual_models(self) -> dict[str, Path]:
        return {
            match[1]: folder
            for folder in sorted(self.individual_model("").parent.glob("*_aligned"))
            if folder.is_dir() and (match := _MODEL.fullmatch(folder.name))
        }

    def query_lists(self) -> dict[str, Path]:
        return {
            match[1]: path
            for path in sorted(self.query_list("").parent.glob("queries_location_*.txt"))
            if (match := _QUERY_LIST.fullmatch(path.name))
        }

    def is_merged(self, model: ModelChoice) -> bool:
        return model == "merged" or (
            model == "auto" and (self.merged_model.is_file() or not self.individual_models())
        )

    def check_points(self, model: ModelChoice) -> None:
        """Raise DataError if a file of the model with its points is missing."""
        if self.is_merged(model):
            remedy = "file is missing; the reference model is read from it"
            require(self.merged_model.is_file(), remedy, path=self.merged_model)
        else:
            for folder in self.individual_models().values():
                colmap_model_files(folder)

    def num_reference_images(self) -> int:
        folders = (self.images / REFERENCE_CONDITION / camera for camera in CAMERAS)
        names = (name for folder in folders for name in _sorted_names(folder))
        return sum(name.endswith(_FILE_TYPES) for name in names)


def image_finder(layout: Layout, missing: Missing) -> Callable[[ImageKey], str | None]:
    """Return a function that finds an image's path below ``images/``, or records it as missing."""
    names = cache(lambda folder: frozenset(_sorted_names(folder)))

    def find(image: ImageKey) -> str | None:
        folder = layout.images / image.condition / image.camera
        for file_type in _FILE_TYPES:
            if image.stem + file_type in names(folder):
                return image.path + file_type
        missing.files.append(folder / f"{image.stem}{_FILE_TYPES[0]}")
        return None

    return find


def _sorted_names(folder: Path) -> list[str]:
    return sorted(os.listdir(folder)) if folder.is_dir() else []


def read_reference(
    layout: Layout, model: ModelChoice, wanted: Sequence[str], missing: Missing
) -> tuple[dict[ImageKey, RigidTransform], dict[ImageKey, str]]:
    """Read ``cam_from_world`` of the reference images, in model order, and known locations.

    The individual models share a world frame; an image in several models is read from the first.
    """
    individual = layout.individual_models()
    locations: dict[ImageKey, str] = {}
    located_poses: dict[ImageKey, RigidTransform] = {}
    for location, folder in individual.items():
        model_images = read_colmap_model(folder, with_points=False).images
        keys = _keys([image.name for image in model_images], folder)
        for key, image in zip(keys, model_images, strict=True):
            locations.setdefault(key, location)
            located_poses.setdefault(key, image.cam_from_world)
    if not layout.is_merged(model):
        for location in wanted:
            missing.require(layout.individual_model(location))
        return located_poses, locations
    poses: dict[ImageKey, RigidTransform] = {}
    if missing.require(layout.merged_model):
        nvm = read_nvm(layout.merged_model, with_points=False)
        for index, key in enumerate(_keys(nvm.names, layout.merged_model)):
            poses[key] = nvm.cam_from_world(index)
    return poses, locations


def read_points(layout: Layout, choice: ModelChoice) -> tuple[list[ImageKey], SparsePoints]:
    """Read images and points of the merged model, or of all individual models concatenated."""
    if layout.is_merged(choice):
        nvm = read_nvm(layout.merged_model, with_points=True)
        return _keys(nvm.names, layout.merged_model), nvm.points
    positions: dict[ImageKey, int] = {}
    parts = []
    for folder in layout.individual_models().values():
        model = read_colmap_model(folder)
        images = _keys([image.name for image in model.images], folder)
        for image in images:
            positions.setdefault(image, len(positions))
        common = np.array([positions[image] for image in images], np.int32)
        parts.append(replace(model.points, image_ids=common[model.points.image_ids]))
    return list(positions), SparsePoints.joined(parts)


def _keys(names: Sequence[str], path: Path) -> list[ImageKey]:
    keys: dict[ImageKey, str] = {}
    for name in names:  # the readers of models guarantee unique names
        image = parse_image(name)
        if image is None or not image.condition or image.camera not in CAMERAS:
            known = ", ".join(CAMERAS)
            raise DataError(
                f"image {name!r} is not named condition/camera/time.png, camera one of {known}",
                path=path,
            )
        if keys.setdefault(image, name) != name:
            raise DataError(f"{name!r} and {keys[image]!r} are the same image", path=path)
    return list(keys)


@dataclass(frozen=True, eq=False)
class Queries:
    """The lists of queries.

    ``train`` maps rear images to their public poses, ``test`` to their names in the pose file.
    ``unlisted`` counts entries of these lists that ``queries_per_location`` lacks.
    """

    locations: Mapping[ImageKey, tuple[str, ...]]
    train: Mapping[ImageKey, RigidTransform]
    test: Mapping[ImageKey, str]
    unlisted: int


def read_queries(layout: Layout, version: int, missing: Missing) -> Queries:
    """Read the lists of queries; public poses are read for both versions, if present."""
    lists = layout.query_lists()
    if not lists:
        missing.files.append(layout.query_list("001"))
    locations: dict[ImageKey, tuple[str, ...]] = {}
    at_time: dict[tuple[str, int], ImageKey] = {}
    for location, path in lists.items():
        for image in read_query_location(path):
            at_time[image.camera, image.timestamp] = image
            locations[image] = (*locations.get(image, ()), location)
    train: dict[ImageKey, RigidTransform] = {}
    test: dict[ImageKey, str] = {}
    unlisted = 0
    if version == 2:
        missing.require(layout.train_list)  # version 1 does not need it
    if (path := layout.train_list).is_file():
        train, unlisted = known_queries(path, read_train_poses(path), at_time, missing)
    if version == 2 and missing.require(path := layout.test_list):
        test, more = known_queries(path, read_test_list(path), at_time, missing)
        unlisted += more
    return Queries(locations, train, test, unlisted)


def known_queries(
    path: Path,
    entries: Mapping[ImageKey, Value],
    at_time: Mapping[tuple[str, int], ImageKey],
    missing: Missing,
) -> tuple[dict[ImageKey, Value], int]:
    """Return the entries of a version 2 list by query, and the number of those without a query.

    ``at_time`` are the queries of ``queries_per_location`` by camera and time.
    """
    values, unlisted = dict[ImageKey, Value](), 0
    for image, value in entries.items():
        query = at_time.get((image.camera, image.timestamp))
        if query is not None and image.condition in ("", query.condition):
            values[query] = value
        elif missing.allowed or not at_time:  # missing lists are reported elsewhere
            unlisted += 1
        else:
            raise DataError(
                f"{image.camera}/{image.stem} is in no list of queries_per_location; "
                "--allow-missing leaves it out",
                path=path,
            )
    return values, unlisted
