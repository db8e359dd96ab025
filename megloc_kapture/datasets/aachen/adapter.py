"""Aachen Day-Night, versions 1.0 and 1.1: a city by day, queried by day and at night."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator

from megloc_kapture.datasets.aachen import (
    ADDITIONAL_NIGHT,
    DATABASE_FOLDER,
    DAY,
    NIGHT,
    SEQUENCES_FOLDER,
    AachenImages,
    Layout,
    Version,
    from_kapture,
)
from megloc_kapture.datasets.kapture_form import KaptureForm
from megloc_kapture.datasets.official import (
    Count,
    DatasetCard,
    Missing,
    OfficialDataset,
    ground_truth_files,
    last_part,
    read_ground_truth,
)
from megloc_kapture.datasets.reference_map import ReferenceModel, check_model_files
from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.dataset_tables import ImageGroup, World
from megloc_kapture.values import Options

_NUM_DATABASE, _NUM_SEQUENCES = 4328, 2369
_NUM_DAY, _NUM_NIGHT = 824, {"1.0": 98, "1.1": 191}
# of v1.1's map images and night queries
_NUM_CAMERAS = 5234
# visuallocalization.net recognises versions by these file names
_POSE_FILE_STEMS = {"1.0": "Aachen", "1.1": "Aachen_v1_1"}


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
        if (form := _kapture_form(root)) is not None:
            if self.options.reference_model:
                raise form.without_model()
            return
        layout = Layout(root)
        if absent := layout.absent():
            raise self.card.without(root, absent)
        reference = self.options.reference_model
        files = layout.model_files(layout.version(self.options.version), with_points=reference)
        if reference:
            check_model_files(files)

    def input_files(self, root: Path) -> Iterator[Path]:
        if (form := _kapture_form(root)) is not None:
            yield from form.input_files()
        else:
            layout, reference = Layout(root), self.options.reference_model
            version = layout.version(self.options.version)
            yield from layout.model_files(version, with_points=reference)
            single = [layout.query_list(DAY), layout.query_list(NIGHT)]
            if reference and version == "1.0":
                single.append(layout.feature_database)
            yield from (path for path in single if path.is_file())
            yield from layout.image_files()
        yield from ground_truth_files(Path(root))

    def read(self, root: Path, *, allow_missing: bool = False) -> OfficialDataset:
        self.check(root)
        missing = Missing(Path(root))
        if (form := _kapture_form(root)) is not None:
            images, files = from_kapture(form, self.options.version, missing)
            remarks = [f"Read from kapture folders, as v{images.version}."]
            return self._dataset(images, lambda _: form.root, missing, remarks, image_files=files)
        layout = Layout(root)
        images, left_out = layout.read(layout.version(self.options.version), missing)
        reference = None
        if self.options.reference_model:
            points = partial(layout.read_points, images.version)
            reference = ReferenceModel(points, _descriptors(layout, images.version))
        return self._dataset(
            images,
            layout.query_list,
            missing,
            self._remarks(layout, images.version, left_out),
            links={"": layout.images},
            reference=reference,
        )

    def _dataset(
        self,
        images: AachenImages,
        lists: Callable[[str], Path],
        missing: Missing,
        remarks: list[str],
        **more: Any,
    ) -> OfficialDataset:
        truth, _ = read_ground_truth(missing.root, images.query, World())  # names tell conditions
        conditions = images.conditions.items()
        return OfficialDataset(
            mapping=images.mapping,
            query=images.query,
            query_gt=truth,
            groups={name: ImageGroup(condition=condition) for name, condition in conditions},
            names=_pose_file_names(images, lists),
            protocol=protocol_of(self.name).model_copy(
                update={"pose_file_stem": _POSE_FILE_STEMS[images.version]}
            ),
            summary=_summary(images),
            remarks=remarks,
            missing=missing,
            **more,
        )

    def _remarks(self, layout: Layout, version: Version, left_out: int) -> list[str]:
        remarks = []
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


def _kapture_form(root: Path) -> KaptureForm | None:
    return KaptureForm.find(root) if Layout(root).absent() else None


def _descriptors(layout: Layout, version: Version) -> Path | None:
    there = version == "1.0" and layout.feature_database.is_file()
    return layout.feature_database if there else None


def _pose_file_names(images: AachenImages, lists: Callable[[str], Path]) -> dict[str, str]:
    names: dict[str, str] = {}
    taken: dict[str, str] = {}
    for query, condition in images.conditions.items():
        name = names[query] = last_part(query)
        other = taken.setdefault(name, query)
        if other != query:
            raise DataError(
                f"{query} and {other} would both be {name} in the pose file", path=lists(condition)
            )
    return names


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
