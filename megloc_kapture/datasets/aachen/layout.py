"""Files of Aachen Day-Night, its reference models and the published counts.

v1.0 has an NVM with a list of cameras, v1.1 a COLMAP model.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from megloc_kapture.datasets.formats.colmap_reading import colmap_model_files, read_colmap_model
from megloc_kapture.datasets.formats.nvm import NvmModel, read_single_nvm
from megloc_kapture.datasets.formats.query_list import read_query_list
from megloc_kapture.datasets.formats.sparse_points import SparsePoints
from megloc_kapture.datasets.official import Missing
from megloc_kapture.errors import DataError
from megloc_kapture.io.images import image_size
from megloc_kapture.values import Camera, RigidTransform

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
# v1.1's night list replaces v1.0's and has these beside the old ones
ADDITIONAL_NIGHT = "query/night/nexus5x_additional_night/"

_IMAGE_FOLDERS = ("images_upright", "images/images_upright")
# the archive's name and the folder's swap an underscore; both are met
_MODEL_FOLDERS = ("aachen_v_1_1", "aachen_v1_1")


class Layout:
    """The dataset's files below ``root``.

    Attributes
    ----------
    images : the folder image names are relative to.
    nvm : the model of v1.0.
    database_intrinsics : the cameras of v1.0's database images.
    colmap_model : the folder of v1.1's model.
    feature_database : COLMAP's database with the features of v1.0's model; large, seldom there.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)
        models = self.root / "3D-models"
        self.images = _first(self.root / name for name in _IMAGE_FOLDERS)
        self.nvm = models / "aachen_cvpr2018_db.nvm"
        self.database_intrinsics = models / "database_intrinsics.txt"
        self.colmap_model = _first(models / name for name in _MODEL_FOLDERS)
        self.feature_database = self.root / "aachen.db"

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


def _first(folders: Iterable[Path]) -> Path:
    """The first folder that is there; else the first of all, where it should be."""
    candidates = list(folders)
    return next((folder for folder in candidates if folder.is_dir()), candidates[0])


@dataclass(frozen=True, slots=True)
class MapImage:
    """One image of a model.

    Parameters
    ----------
    camera_id : of the camera that took it, which may have taken others; the same in every import.
    """

    name: str
    camera_id: int
    camera: Camera
    cam_from_world: RigidTransform


@dataclass(frozen=True, slots=True)
class QueryImage:
    """A query, and its number among those of its condition, in the order of the official list."""

    name: str
    condition: str
    position: int
    camera: Camera


def read_map_images(layout: Layout, version: Version, missing: Missing) -> dict[int, MapImage]:
    """The images of a version's model that are on disk, by their positions in the model.

    ``missing`` is told of images, and of v1.0's list of cameras, that are not there.

    Raises
    ------
    DataError : a broken model or list, an image of the model without a camera.
    """
    if version == "1.1":
        return _of_colmap_model(layout, missing)
    return _of_nvm(layout, missing)


def read_points(layout: Layout, version: Version) -> tuple[tuple[str, ...], SparsePoints]:
    """Names of all images of a version's model, and its points.

    Raises
    ------
    DataError : a broken model.
    """
    if version == "1.1":
        model = read_colmap_model(layout.colmap_model)
        return tuple(image.name for image in model.images), model.points
    nvm = read_single_nvm(layout.nvm, with_points=True)
    return nvm.names, nvm.points


def _of_colmap_model(layout: Layout, missing: Missing) -> dict[int, MapImage]:
    model = read_colmap_model(layout.colmap_model, with_points=False)
    return {
        position: MapImage(
            image.name, image.camera_id, model.cameras[image.camera_id], image.cam_from_world
        )
        for position, image in enumerate(model.images)
        if missing.require(layout.images / image.name)
    }


def _of_nvm(layout: Layout, missing: Missing) -> dict[int, MapImage]:
    """Each image has a camera of its own, with the image's position as its id."""
    nvm = read_single_nvm(layout.nvm, with_points=False)
    listed = None
    if missing.require(layout.database_intrinsics):
        listed = read_query_list(layout.database_intrinsics)
    images = {}
    for position, name in enumerate(nvm.names):
        if listed is not None and name not in listed:
            raise DataError(
                f"no line for {name!r}, an image of {layout.nvm.name}",
                path=layout.database_intrinsics,
            )
        if not missing.require(layout.images / name):
            continue
        camera = _centred(layout, nvm, position) if listed is None else listed[name]
        images[position] = MapImage(name, position, camera, nvm.cam_from_world(position))
    return images


def _centred(layout: Layout, nvm: NvmModel, position: int) -> Camera:
    """The camera of the NVM, with the image's size and the principal point in its middle.

    The published list has the same cameras, as far as is known.
    """
    name = nvm.names[position]
    width, height = image_size(layout.images / name)
    focal, k = float(nvm.focal_px[position]), float(nvm.k_colmap[position])
    try:
        return Camera("SIMPLE_RADIAL", width, height, (focal, width / 2, height / 2, k))
    except DataError as error:
        raise DataError(f"image {name!r}: {error.message}", path=layout.nvm) from None
