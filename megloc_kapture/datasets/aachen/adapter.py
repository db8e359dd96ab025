"""Aachen Day-Night, versions 1.0 and 1.1: a map of a city by day, queries by day and at night.

The official layout has an NVM model in version 1.0 and a COLMAP model in version 1.1; kapture's
downloader makes kapture folders.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator

from megloc_kapture.datasets.nvm import NvmModel, read_nvm
from megloc_kapture.datasets.official import (
    Count,
    DatasetCard,
    KaptureForm,
    KaptureImage,
    Missing,
    OfficialDataset,
    last_part,
    read_ground_truth,
)
from megloc_kapture.datasets.reference_map import published_database
from megloc_kapture.errors import OptionError, require
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.colmap_model import SparsePoints, colmap_model_files, read_colmap_model
from megloc_kapture.io.dataset_tables import ImageGroup, World
from megloc_kapture.io.files import find_near, named
from megloc_kapture.io.images import image_size
from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.io.text_lines import read_camera_rows
from megloc_kapture.values import Camera, Options, RigidTransform

Version = Literal["1.0", "1.1"]
Wanted = Literal["auto", "1.0", "1.1"]

DAY, NIGHT = "day", "night"
DATABASE_FOLDER, SEQUENCES_FOLDER = "db", "sequences"
# night queries that v1.1 adds to those of v1.0
ADDITIONAL_NIGHT = "query/night/nexus5x_additional_night/"

# first timestamp of the queries of each list; timestamps of map images start at 0
_FIRST_TIMESTAMP = {DAY: 100_000, NIGHT: 200_000}
_IMAGE_FOLDERS = ("images_upright", "images/images_upright")
# names of the archive and of the folder in it, which differ by an underscore
_MODEL_FOLDERS = ("aachen_v_1_1", "aachen_v1_1")

_NAME_OF_V1_1 = ("v1.1", "v1_1", "v11")
_NUM_DATABASE, _NUM_SEQUENCES = 4328, 2369
_NUM_DAY, _NUM_NIGHT = 824, {"1.0": 98, "1.1": 191}
# cameras of v1.1's map images and night queries
_NUM_CAMERAS = 5234
# visuallocalization.net recognises versions by these file names
_POSE_FILE_STEMS = {"1.0": "Aachen", "1.1": "Aachen_v1_1"}


@dataclass
class AachenImages:
    """The images of an import; ``conditions`` maps queries to day or night, in list order."""

    version: Version
    mapping: KaptureData = field(default_factory=KaptureData)
    query: KaptureData = field(default_factory=KaptureData)
    conditions: dict[str, str] = field(default_factory=dict)

    def add_map_image(
        self, name: str, position: int, camera_id: int, camera: Camera, pose: RigidTransform
    ) -> None:
        record = position, f"camera_{camera_id:05d}"
        self.mapping.sensors[record[1]] = Sensor.from_camera(camera)
        self.mapping.records_camera[record] = name
        self.mapping.trajectories[record] = pose

    def add_query(self, name: str, condition: str, position: int, camera: Camera) -> None:
        record = _FIRST_TIMESTAMP[condition] + position, f"{condition}_{position:05d}"
        self.query.sensors[record[1]] = Sensor.from_camera(camera)
        self.query.records_camera[record] = name
        self.conditions[name] = condition


class Layout:
    """Official files below ``root``; the feature database belongs to v1.0's model."""

    def __init__(self, root: Path) -> None:
        self.root = Path(root)
        models = self.root / "3D-models"
        self.images = _first(self.root / name for name in _IMAGE_FOLDERS)
        self.nvm = models / "aachen_cvpr2018_db.nvm"
        self.database_intrinsics = models / "database_intrinsics.txt"
        self.colmap_model = _first(models / name for name in _MODEL_FOLDERS)
        self.feature_database = self.root / "aachen.db"

    def query_list(self, condition: str) -> Path:
        return self.root / "queries" / f"{condition}_time_queries_with_intrinsics.txt"

    def absent(self) -> list[str]:
        wanted = (self.images, self.query_list(DAY).parent, self.nvm.parent)
        return [folder.name for folder in wanted if not folder.is_dir()]

    def version(self, wanted: Wanted) -> Version:
        """Return ``wanted``, or the latest version that has a model."""
        if wanted == "auto":
            wanted = "1.1" if self.colmap_model.is_dir() else "1.0"
            stray = next(find_near(self.root, "aachen_v*1_1*"), None) if wanted == "1.0" else None
            require(
                stray is None,
                f"v1.1's {stray} is not in place: its model belongs in {self.colmap_model}/, its "
                f"images in {self.images}/; version=1.0 imports v1.0",
                path=self.root,
            )
        model = self.nvm if wanted == "1.0" else self.colmap_model
        require(
            model.exists(),
            f"the model of Aachen Day-Night v{wanted} is missing: {model.relative_to(self.root)}",
            path=self.root,
        )
        return wanted

    def read(self, version: Version, missing: Missing) -> tuple[AachenImages, int]:
        """Read the existing images, and count the queries of v1.1 that are omitted for v1.0."""
        images = AachenImages(version)
        if version == "1.1":
            model = read_colmap_model(self.colmap_model, with_points=False)
            for position, image in enumerate(model.images):
                if missing.require(self.images / image.name):
                    camera = model.cameras[image.camera_id]
                    pose = image.cam_from_world
                    images.add_map_image(image.name, position, image.camera_id, camera, pose)
        else:
            self._add_nvm(images, missing)
        return images, self._add_queries(images, missing)

    def read_points(self, version: Version) -> tuple[tuple[str, ...], SparsePoints]:
        """Return the names of all images of a version's model, and its points."""
        if version == "1.1":
            model = read_colmap_model(self.colmap_model)
            return tuple(image.name for image in model.images), model.points
        nvm = read_nvm(self.nvm, with_points=True)
        return nvm.names, nvm.points

    def _add_nvm(self, images: AachenImages, missing: Missing) -> None:
        nvm = read_nvm(self.nvm, with_points=False)
        listed = None
        if missing.require(self.database_intrinsics):
            listed = read_camera_rows(self.database_intrinsics)
        for position, name in enumerate(nvm.names):
            require(
                listed is None or name in listed,
                f"no line for {name!r}, an image of {self.nvm.name}",
                path=self.database_intrinsics,
            )
            if missing.require(self.images / name):
                camera = self._centred(nvm, position) if listed is None else listed[name]
                pose = nvm.cam_from_world(position)
                images.add_map_image(name, position, position, camera, pose)

    def _centred(self, nvm: NvmModel, position: int) -> Camera:
        """Return the NVM's camera with a centred principal point.

        As far as we know, this holds for all published cameras.
        """
        name = nvm.names[position]
        width, height = image_size(self.images / name)
        focal, k = float(nvm.focal_px[position]), float(nvm.k_colmap[position])
        with named(self.nvm, about=f"image {name!r}"):
            return Camera("SIMPLE_RADIAL", width, height, (focal, width / 2, height / 2, k))

    def _add_queries(self, images: AachenImages, missing: Missing) -> int:
        left_out = 0
        for condition in (DAY, NIGHT):
            path = self.query_list(condition)
            if not missing.require(path):
                continue
            for position, (name, camera) in enumerate(read_camera_rows(path).items()):
                if images.version == "1.0" and name.startswith(ADDITIONAL_NIGHT):
                    left_out += 1
                elif missing.require(self.images / name):
                    images.add_query(name, condition, position, camera)
        return left_out


def _first(folders: Iterable[Path]) -> Path:
    candidates = list(folders)
    return next((folder for folder in candidates if folder.is_dir()), candidates[0])


def from_kapture(
    form: KaptureForm, wanted: Wanted, missing: Missing
) -> tuple[AachenImages, dict[str, Path]]:
    """Return the images of kapture folders, numbered like official ones, and their files."""
    kapture_images = form.read(missing)
    images = AachenImages(_version_of(form, wanted, kapture_images))
    cameras: dict[str, int] = {}
    for image in kapture_images:
        if not image.is_query and image.cam_from_world is not None:
            position = len(images.mapping.records_camera)
            camera_id = cameras.setdefault(image.sensor_id, len(cameras))
            images.add_map_image(
                image.name, position, camera_id, image.camera, image.cam_from_world
            )
    for condition in (DAY, NIGHT):
        queries = [i for i in kapture_images if i.is_query and condition in i.name.split("/")[:-1]]
        for position, image in enumerate(queries):
            images.add_query(image.name, condition, position, image.camera)
    for image in kapture_images:
        require(
            not image.is_query or image.name in images.conditions,
            f"query {image.name!r} has neither {DAY}/ nor {NIGHT}/ in its name; `megloc eval "
            "kapture` is for datasets other than Aachen",
            path=form.root,
        )
    return images, {image.name: image.file for image in kapture_images}


def _version_of(form: KaptureForm, wanted: Wanted, images: Sequence[KaptureImage]) -> Version:
    is_newer = any(
        image.name.startswith((f"{SEQUENCES_FOLDER}/", ADDITIONAL_NIGHT)) for image in images
    )
    if wanted == "1.0" and is_newer:
        raise OptionError(f"version=1.0, but {form.root} is v1.1, whose poses are different")
    if wanted != "auto":
        return wanted
    path = form.root.resolve()
    folders = (path.name.lower(), path.parent.name.lower())
    named = any(text in name for text in _NAME_OF_V1_1 for name in folders)
    return "1.1" if is_newer or named else "1.0"


# --------------------------------------------------------------------------------- adapter


class AachenOptions(Options):
    """The part of Aachen Day-Night to import."""

    version: Wanted = Field(
        default="auto",
        description="version; auto: 1.1 if its model exists or, for kapture folders, if their "
        "images or folder names show it, else 1.0",
    )
    reference_model: bool = Field(
        default=False, description="import the SIFT model too, as a kapture map in reference/"
    )

    @field_validator("version", mode="before")
    @classmethod
    def _as_text(cls, version: Any) -> Any:
        # the command line and TOML read 1.1 as a number
        return str(version) if isinstance(version, float) else version


class Aachen:
    """Adapter of Aachen Day-Night; queries are the listed images only."""

    name = "aachen"
    Options = AachenOptions
    card = DatasetCard(
        title="Aachen Day-Night",
        published_at="https://data.ciirc.cvut.cz/public/projects/2020VisualLocalization/"
        "Aachen-Day-Night/",
        size="several GB of images; aachen.db is for reference_model only",
        folders=("Aachen-Day-Night", "Aachen-Day-Night-v1.1", "aachen_v1.1"),
        layout="images_upright/{db,query[,sequences]}/ (archives extracted in place), "
        "queries/{day,night}_time_queries_with_intrinsics.txt and 3D-models/ with "
        "aachen_cvpr2018_db.nvm and database_intrinsics.txt (v1.0) or "
        "aachen_v_1_1/{cameras,images,points3D}.bin (v1.1); or as kapture's downloader leaves it, "
        "mapping/ and query/ (or query_day/ and query_night/)",
    )

    def __init__(self, options: AachenOptions | None = None) -> None:
        self.options = options or AachenOptions()

    def check(self, root: Path) -> None:
        if (form := _kapture_form(root)) is not None:
            if self.options.reference_model:
                raise form.without_model()
            return
        layout = Layout(root)
        if absent := layout.absent():
            raise self.card.without(root, absent)
        if layout.version(self.options.version) == "1.1":
            colmap_model_files(layout.colmap_model, with_points=self.options.reference_model)

    def read(self, root: Path, *, allow_missing: bool = False) -> OfficialDataset:
        self.check(root)
        missing = Missing(Path(root))
        if (form := _kapture_form(root)) is not None:
            images, files = from_kapture(form, self.options.version, missing)
            remarks = [f"Read from kapture folders, as v{images.version}."]
            return self._dataset(images, missing, remarks, image_files=files)
        layout = Layout(root)
        images, left_out = layout.read(layout.version(self.options.version), missing)
        remarks, reference, database = [], None, None
        if images.version == "1.0" and not layout.database_intrinsics.is_file():
            remarks.append(
                f"Without {layout.database_intrinsics.name}, the principal points of map images "
                "are assumed to be the image centres, and the image sizes are read from the files."
            )
        if left_out:
            remarks.append(
                f"{left_out} night queries of v1.1 ({ADDITIONAL_NIGHT}) are left out of v1.0."
            )
        if self.options.reference_model:
            reference = partial(layout.read_points, images.version)
            published = layout.feature_database if images.version == "1.0" else None
            database = published_database(published, remarks)
        return self._dataset(
            images,
            missing,
            remarks,
            links={"": layout.images},
            reference=reference,
            reference_database=database,
        )

    def _dataset(
        self,
        images: AachenImages,
        missing: Missing,
        remarks: list[str],
        **more: Any,
    ) -> OfficialDataset:
        truth, _ = read_ground_truth(missing.root, images.query, World())  # groups are known
        conditions = images.conditions.items()
        return OfficialDataset(
            mapping=images.mapping,
            query=images.query,
            query_gt=truth,
            groups={name: ImageGroup(condition=condition) for name, condition in conditions},
            names={query: last_part(query) for query in images.conditions},
            protocol=protocol_of(self.name).model_copy(
                update={"pose_file_stem": _POSE_FILE_STEMS[images.version]}
            ),
            summary=_summary(images),
            remarks=remarks,
            missing=missing,
            **more,
        )


def _kapture_form(root: Path) -> KaptureForm | None:
    return KaptureForm.find(root) if Layout(root).absent() else None


def _summary(images: AachenImages) -> list[Count]:
    folders = [name.split("/")[0] for name in images.mapping.records_camera.values()]
    conditions = list(images.conditions.values())
    counts = [Count("database images", folders.count(DATABASE_FOLDER), _NUM_DATABASE)]
    if images.version == "1.1":
        cameras = len(images.mapping.sensors) + conditions.count(NIGHT)
        counts += [
            Count("sequence images", folders.count(SEQUENCES_FOLDER), _NUM_SEQUENCES),
            Count("map images", len(folders), _NUM_DATABASE + _NUM_SEQUENCES),
            Count("cameras of map and night queries", cameras, _NUM_CAMERAS),
        ]
    counts += [
        Count("day queries", conditions.count(DAY), _NUM_DAY),
        Count("night queries", conditions.count(NIGHT), _NUM_NIGHT[images.version]),
    ]
    return counts
