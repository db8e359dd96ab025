"""Aachen Day-Night, versions 1.0 and 1.1: a city by day, queried by day and at night."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator

from megloc_kapture.datasets.aachen.kapture_form import KaptureLayout, map_images, query_images
from megloc_kapture.datasets.aachen.layout import (
    ADDITIONAL_NIGHT,
    DATABASE_FOLDER,
    DAY,
    NIGHT,
    NUM_CAMERAS,
    NUM_DATABASE,
    NUM_DAY,
    NUM_NIGHT,
    NUM_SEQUENCES,
    POSE_FILE_STEMS,
    SEQUENCES_FOLDER,
    Layout,
    MapImage,
    QueryImage,
    Version,
    read_map_images,
    read_points,
)
from megloc_kapture.datasets.formats.query_list import read_query_list
from megloc_kapture.datasets.kapture_form import image_files, without_model
from megloc_kapture.datasets.official import (
    Count,
    DatasetCard,
    Missing,
    OfficialDataset,
    ground_truth_files,
    last_part,
    read_ground_truth,
)
from megloc_kapture.datasets.reference_map import ReferenceModel
from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.dataset_tables import ImageGroup, World
from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.values import Options

# the first timestamp of each list; map images count from 0
_FIRST_TIMESTAMP = {DAY: 100_000, NIGHT: 200_000}
_WRONG_IMAGE = "db/1228.jpg"


class AachenOptions(Options):
    """The part of Aachen Day-Night to import."""

    version: Literal["auto", "1.0", "1.1"] = Field(
        default="auto", description="auto: 1.1 where 3D-models/aachen_v_1_1 is there"
    )
    reference_model: bool = Field(
        default=False, description="import the SIFT model too, as a kapture map in reference/"
    )

    @field_validator("version", mode="before")
    @classmethod
    def _as_text(cls, version: Any) -> Any:
        # on the command line and in TOML 1.1 is a number
        return str(version) if isinstance(version, float) else version


class Aachen:
    """Adapter of Aachen Day-Night.

    The queries are those of the lists: the folders hold more images. World and poses are the
    published ones.
    """

    name = "aachen"
    Options = AachenOptions
    card = DatasetCard(
        title="Aachen Day-Night",
        published_at="https://data.ciirc.cvut.cz/public/projects/2020VisualLocalization/"
        "Aachen-Day-Night/",
        size="several GB of images; aachen.db is wanted by reference_model only",
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
        """Raise MeglocError, quickly, when ``root`` cannot be what is wanted of Aachen."""
        if _kapture_of(root) is not None:
            if self.options.reference_model:
                raise without_model(root)
            return
        layout = Layout(root)
        absent = _absent(layout)
        if absent:
            raise self.card.without(root, absent)
        layout.model_files(layout.version(self.options.version), with_points=False)

    def input_files(self, root: Path) -> Iterator[Path]:
        """Every file an import may depend on, images included."""
        kapture = _kapture_of(root)
        if kapture is not None:
            yield from kapture.input_files()
            yield from ground_truth_files(Path(root))
            return
        layout = Layout(root)
        reference = self.options.reference_model
        version = layout.version(self.options.version)
        yield from layout.model_files(version, with_points=reference)
        single = [layout.query_list(DAY), layout.query_list(NIGHT)]
        if reference and version == "1.0":
            single.append(layout.feature_database)
        yield from (path for path in single if path.is_file())
        yield from layout.image_files()
        yield from ground_truth_files(layout.root)

    def read(self, root: Path, *, allow_missing: bool = False) -> OfficialDataset:
        """Read the dataset.

        Raises
        ------
        DataError : something is broken, or ``root`` is not the dataset; names file and line.
        OptionError : an option that kapture folders cannot fulfil.
        """
        self.check(root)
        kapture = _kapture_of(root)
        if kapture is not None:
            return self._read_kapture(kapture, Missing(Path(root)))
        layout = Layout(root)
        version = layout.version(self.options.version)
        missing = Missing(layout.root)
        images = read_map_images(layout, version, missing)
        queries, left_out = _read_queries(layout, version, missing)
        dataset = self._dataset(version, images, queries, layout.query_list, missing)
        return replace(
            dataset,
            links={"": layout.images},
            remarks=self._remarks(layout, version, dataset.mapping, left_out),
            reference=ReferenceModel(
                partial(read_points, layout, version), _descriptors(layout, version)
            )
            if self.options.reference_model
            else None,
        )

    def _read_kapture(self, layout: KaptureLayout, missing: Missing) -> OfficialDataset:
        version, mapping, query = layout.read(self.options.version, missing)
        queries = query_images(query, layout.root)
        images = map_images(mapping)
        dataset = self._dataset(version, images, queries, lambda _: layout.root, missing)
        return replace(
            dataset,
            image_files=image_files([*mapping, *query]),
            remarks=[
                *_about_wrong_image(dataset.mapping),
                f"Read from kapture folders, as v{version}.",
            ],
        )

    def _dataset(
        self,
        version: Version,
        images: Mapping[int, MapImage],
        queries: Sequence[QueryImage],
        lists: Callable[[str], Path],
        missing: Missing,
    ) -> OfficialDataset:
        """The part that does not depend on the layout of the images."""
        mapping, query = _mapping_data(images), _query_data(queries)
        truth, _ = read_ground_truth(missing.root, query, World())  # the names tell conditions
        return OfficialDataset(
            mapping=mapping,
            query=query,
            query_gt=truth,
            groups={query.name: ImageGroup(condition=query.condition) for query in queries},
            names=_pose_file_names(queries, lists),
            protocol=protocol_of(self.name).model_copy(
                update={"pose_file_stem": POSE_FILE_STEMS[version]}
            ),
            summary=_summary(version, mapping, queries),
            missing=missing,
        )

    def _remarks(
        self, layout: Layout, version: Version, mapping: KaptureData, left_out: int
    ) -> list[str]:
        """Sentences for the user about this import."""
        remarks = _about_wrong_image(mapping)
        if version == "1.0" and not layout.database_intrinsics.is_file():
            remarks.append(
                f"Without {layout.database_intrinsics.name} the map images' principal points are "
                "taken to be in the middle, and their sizes from the image files."
            )
        if left_out:
            remarks.append(
                f"{left_out} night queries of v1.1 ({ADDITIONAL_NIGHT}) are left out of v1.0."
            )
        if self.options.reference_model and _descriptors(layout, version) is None:
            where = (
                f"those of v1.0 are in {layout.feature_database.name}, which is not there"
                if version == "1.0"
                else "v1.1 publishes none"
            )
            remarks.append(
                f"The reference model comes without descriptors: {where}. "
                "With map = given they are extracted again from the images."
            )
        return remarks


def _kapture_of(root: Path) -> KaptureLayout | None:
    """The kapture folders that are there instead of the official files; None where these are."""
    return KaptureLayout.find(root) if _absent(Layout(root)) else None


def _absent(layout: Layout) -> list[str]:
    """Names of the official layout's folders that are not there."""
    wanted = (layout.images, layout.query_list(DAY).parent, layout.nvm.parent)
    return [folder.name for folder in wanted if not folder.is_dir()]


def _about_wrong_image(mapping: KaptureData) -> list[str]:
    if _WRONG_IMAGE not in mapping.records_camera.values():
        return []
    return [
        f"{_WRONG_IMAGE} has a wrong pose in the published model; its maintainer says that it may "
        "be dropped. It is imported as published."
    ]


def _read_queries(
    layout: Layout, version: Version, missing: Missing
) -> tuple[list[QueryImage], int]:
    """The listed queries whose images are there, day first, in the order of the lists; and how
    many of v1.1's a v1.0 leaves out."""
    queries: list[QueryImage] = []
    listed: dict[str, Path] = {}
    left_out = 0
    for condition in (DAY, NIGHT):
        path = layout.query_list(condition)
        if not missing.require(path):
            continue
        for position, (name, camera) in enumerate(read_query_list(path).items()):
            if listed.setdefault(name, path) != path:
                raise DataError(
                    f"image {name!r} is also in {listed[name].name}: a query by day or at night?",
                    path=path,
                )
            if version == "1.0" and name.startswith(ADDITIONAL_NIGHT):
                left_out += 1
            elif missing.require(layout.images / name):
                queries.append(QueryImage(name, condition, position, camera))
    return queries, left_out


def _mapping_data(images: Mapping[int, MapImage]) -> KaptureData:
    data = KaptureData()
    for position, image in images.items():
        sensor_id = f"camera_{image.camera_id:05d}"
        data.sensors[sensor_id] = Sensor.from_camera(image.camera)
        data.records_camera[position, sensor_id] = image.name
        data.trajectories[position, sensor_id] = image.cam_from_world
    return data


def _query_data(queries: Sequence[QueryImage]) -> KaptureData:
    data = KaptureData()
    for query in queries:
        sensor_id = f"{query.condition}_{query.position:05d}"
        timestamp = _FIRST_TIMESTAMP[query.condition] + query.position
        data.sensors[sensor_id] = Sensor.from_camera(query.camera)
        data.records_camera[timestamp, sensor_id] = query.name
    return data


def _pose_file_names(queries: Sequence[QueryImage], lists: Callable[[str], Path]) -> dict[str, str]:
    """Last parts of the names, in the order of the lists."""
    names: dict[str, str] = {}
    taken: dict[str, str] = {}
    for query in queries:
        name = names[query.name] = last_part(query.name)
        other = taken.setdefault(name, query.name)
        if other != query.name:
            raise DataError(
                f"{query.name} and {other} would both be {name} in the pose file",
                path=lists(query.condition),
            )
    return names


def _summary(version: Version, mapping: KaptureData, queries: Sequence[QueryImage]) -> list[Count]:
    folders = [name.split("/")[0] for name in mapping.records_camera.values()]
    conditions = [query.condition for query in queries]
    counts = [Count("database images", folders.count(DATABASE_FOLDER), NUM_DATABASE)]
    if version == "1.1":
        published = NUM_DATABASE + NUM_SEQUENCES
        counts += [
            Count("sequence images", folders.count(SEQUENCES_FOLDER), NUM_SEQUENCES),
            Count("map images", len(folders), published),
            Count(
                "cameras of map and night queries",
                len(mapping.sensors) + conditions.count(NIGHT),
                NUM_CAMERAS,
            ),
        ]
    counts += [
        Count("day queries", conditions.count(DAY), NUM_DAY),
        Count("night queries", conditions.count(NIGHT), NUM_NIGHT[version]),
    ]
    return counts


def _descriptors(layout: Layout, version: Version) -> Path | None:
    """The database with the descriptors of a version's model, if it is there."""
    there = version == "1.0" and layout.feature_database.is_file()
    return layout.feature_database if there else None
