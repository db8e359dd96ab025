"""Where RobotCar Seasons has its files, and what is published about them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from megloc_kapture.datasets.grammars.robotcar_files import ImageKey
from megloc_kapture.datasets.official import Missing

CAMERAS = ("left", "rear", "right")
SCORED_CAMERA = "rear"
REFERENCE_CONDITION = "overcast-reference"
DAY = ("dawn", "dusk", "overcast-summer", "overcast-winter", "rain", "snow", "sun")
NIGHT = ("night", "night-rain")

# what is published, or was counted by others in the published lists
NUM_LOCATIONS = 49
NUM_REFERENCE_IMAGES = 26_121
NUM_REGISTERED = 20_862
NUM_QUERIES = 11_934
NUM_TRAIN, NUM_TEST = 1_906, 1_872
QUERIES_PER_CAMERA = {
    "dawn": 483,
    "dusk": 394,
    "overcast-summer": 463,
    "overcast-winter": 390,
    "rain": 421,
    "snow": 489,
    "sun": 460,
    "night": 438,
    "night-rain": 440,
}

_FILE_TYPES = (".jpg", ".png")
_MODEL = re.compile(r"([0-9]{1,6})_aligned")
_QUERY_LIST = re.compile(r"queries_location_([0-9]{1,6})\.txt")


@dataclass(frozen=True, slots=True)
class Layout:
    """The official layout below ``root``."""

    root: Path

    @property
    def images(self) -> Path:
        """``<condition>/<camera>/<time>.jpg`` lie below it."""
        return self.root / "images"

    @property
    def models(self) -> Path:
        """The folder of all models."""
        return self.root / "3D-models"

    @property
    def merged_model(self) -> Path:
        """One model of all locations."""
        return self.models / "all-merged" / "all.nvm"

    @property
    def feature_database(self) -> Path:
        """COLMAP database with the models' features."""
        return self.models / "overcast-reference.db"

    @property
    def train_list(self) -> Path:
        """Version 2: the rear query images whose poses are public."""
        return self.root / "robotcar_v2_train.txt"

    @property
    def test_list(self) -> Path:
        """Version 2: the rear query images whose poses have to be found."""
        return self.root / "robotcar_v2_test.txt"

    def intrinsics(self, camera: str) -> Path:
        """Intrinsics of a camera."""
        return self.root / "intrinsics" / f"{camera}_intrinsics.txt"

    def extrinsics(self, camera: str) -> Path:
        """Place of a camera on the car."""
        return self.root / "extrinsics" / f"{camera}_extrinsics.txt"

    def individual_model(self, location: str) -> Path:
        """Folder of the COLMAP model of one location."""
        return self.models / "individual" / "colmap_reconstructions" / f"{location}_aligned"

    def query_list(self, location: str) -> Path:
        """List of the queries of one location."""
        folder = self.models / "individual" / "queries_per_location"
        return folder / f"queries_location_{location}.txt"

    def individual_models(self) -> dict[str, Path]:
        """Folders of the COLMAP models that are there, by location, sorted."""
        found = _numbered(self.individual_model("").parent, _MODEL)
        return {location: folder for location, folder in found.items() if folder.is_dir()}

    def query_lists(self) -> dict[str, Path]:
        """Lists of queries that are there, by location, sorted."""
        return _numbered(self.query_list("").parent, _QUERY_LIST)

    def num_reference_images(self) -> int:
        """How many images of the reference traversal are there."""
        files = self.image_files()
        return sum(path.parent.parent.name == REFERENCE_CONDITION for path in files)

    def image_files(self) -> Iterator[Path]:
        """Every image that is there, sorted folder by folder."""
        for condition in _sorted_names(self.images):
            for camera in CAMERAS:
                folder = self.images / condition / camera
                for name in _sorted_names(folder):
                    if name.endswith(_FILE_TYPES):
                        yield folder / name


@dataclass
class ImageFiles:
    """Finds an image under the file type it has on disk; remembers those that are not there."""

    layout: Layout
    missing: Missing
    _names: dict[Path, frozenset[str]] = field(default_factory=dict)

    def find(self, image: ImageKey) -> str | None:
        """Path of an image below ``images/``; None, and noted as missing, where there is none."""
        folder = self.layout.images / image.condition / image.camera
        if folder not in self._names:
            self._names[folder] = frozenset(_sorted_names(folder))
        for file_type in _FILE_TYPES:
            if image.stem + file_type in self._names[folder]:
                return image.path + file_type
        self.missing.files.append(folder / f"{image.stem}{_FILE_TYPES[0]}")
        return None


def _numbered(folder: Path, pattern: re.Pattern[str]) -> dict[str, Path]:
    found = {}
    for name in _sorted_names(folder):
        number = pattern.fullmatch(name)
        if number is not None:
            found[number[1]] = folder / name
    return found


def _sorted_names(folder: Path) -> list[str]:
    try:
        return sorted(os.listdir(folder))
    except OSError:  # not there, or no folder: what should be in it is then missing
        return []
