"""Where Aachen Day-Night's files lie, and the published counts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from megloc_kapture.datasets.grammars.colmap_model import colmap_model_files
from megloc_kapture.errors import DataError

Version = Literal["1.0", "1.1"]

DAY, NIGHT = "day", "night"
NUM_DATABASE = 4328
NUM_SEQUENCES = 2369
NUM_DAY = 824
NUM_NIGHT = {"1.0": 98, "1.1": 191}
# of v1.1's map images and night queries together
NUM_CAMERAS = 5234
# the names by which visuallocalization.net tells the versions' pose files apart
POSE_FILE_STEMS = {"1.0": "Aachen", "1.1": "Aachen_v1_1"}

DATABASE_FOLDER, SEQUENCES_FOLDER, QUERY_FOLDER = "db", "sequences", "query"
# v1.1's night list stands in the place of v1.0's and has these beside the old ones
ADDITIONAL_NIGHT = "query/night/nexus5x_additional_night/"

_IMAGE_FOLDERS = ("images_upright", "images/images_upright")
# the archive's name and the folder's swap an underscore; both are met
_MODEL_FOLDERS = ("aachen_v_1_1", "aachen_v1_1")


@dataclass(frozen=True, slots=True)
class Layout:
    """The dataset's files below ``root``."""

    root: Path

    @property
    def images(self) -> Path:
        """The folder image names are relative to."""
        return _first(self.root / name for name in _IMAGE_FOLDERS)

    @property
    def nvm(self) -> Path:
        """The model of v1.0."""
        return self.root / "3D-models" / "aachen_cvpr2018_db.nvm"

    @property
    def database_intrinsics(self) -> Path:
        """The cameras of v1.0's database images."""
        return self.root / "3D-models" / "database_intrinsics.txt"

    @property
    def colmap_model(self) -> Path:
        """The folder of v1.1's model."""
        return _first(self.root / "3D-models" / name for name in _MODEL_FOLDERS)

    @property
    def feature_database(self) -> Path:
        """COLMAP's database with the features of v1.0's model; large, and seldom there."""
        return self.root / "aachen.db"

    def query_list(self, condition: str) -> Path:
        """The list of the queries of ``day`` or ``night``, with their cameras."""
        return self.root / "queries" / f"{condition}_time_queries_with_intrinsics.txt"

    def version(self, wanted: Literal["auto", "1.0", "1.1"]) -> Version:
        """``wanted``, or the latest whose model is there.

        Raises
        ------
        DataError : the model is not there.
        """
        if wanted == "auto":
            wanted = "1.1" if self.colmap_model.is_dir() else "1.0"
        model = self.nvm if wanted == "1.0" else self.colmap_model
        if not model.exists():
            raise DataError(
                f"the model of Aachen Day-Night v{wanted} is missing: "
                f"{model.relative_to(self.root)}",
                path=self.root,
            )
        return wanted

    def model_files(self, version: Version, *, with_points: bool) -> tuple[Path, ...]:
        """The files that poses and cameras of the map come from; those that are there."""
        if version == "1.1":
            return colmap_model_files(self.colmap_model, with_points=with_points)
        files = (self.nvm, self.database_intrinsics)
        return tuple(file for file in files if file.is_file())

    def image_files(self) -> Iterator[Path]:
        """Every file below the folders of images."""
        for folder in (DATABASE_FOLDER, SEQUENCES_FOLDER, QUERY_FOLDER):
            yield from sorted(path for path in (self.images / folder).rglob("*") if path.is_file())


def _first(places: Iterator[Path]) -> Path:
    """The first folder that is there; else the first of all, where it should be."""
    candidates = list(places)
    return next((place for place in candidates if place.is_dir()), candidates[0])
