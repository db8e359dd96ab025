"""RobotCar Seasons, versions 1 and 2: three cameras on a car, 49 locations, nine conditions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from megloc_kapture.datasets.official import (
    Count,
    DatasetCard,
    KaptureForm,
    Missing,
    OfficialDataset,
    read_ground_truth,
)
from megloc_kapture.datasets.reference_map import published_database
from megloc_kapture.datasets.robotcar import (
    CAMERAS,
    REFERENCE_CONDITION,
    SCORED_CAMERA,
    Layout,
    ModelChoice,
    image_finder,
    read_points,
    read_queries,
    read_reference,
)
from megloc_kapture.datasets.robotcar.images import (
    Selection,
    car_of_kapture,
    mapping_data,
    queries_of_kapture,
    query_truth,
    read_car,
    read_kapture_images,
    reference_of_kapture,
    select,
    with_images,
    with_rig_of_model,
)
from megloc_kapture.errors import require
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.colmap_model import SparsePoints
from megloc_kapture.io.dataset_tables import ImageGroup, World
from megloc_kapture.io.files import find_near
from megloc_kapture.io.kapture import KaptureData
from megloc_kapture.values import Options

# published counts, or counts of the published lists
_NUM_LOCATIONS = 49
_NUM_REFERENCE_IMAGES = 26_121
_NUM_REGISTERED = 20_862
_NUM_QUERIES = 11_934
_NUM_TRAIN, _NUM_TEST = 1_906, 1_872
_QUERIES_PER_CAMERA = {
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


class RobotCarOptions(Options):
    """The part of RobotCar Seasons to import, and the published model that provides its poses."""

    version: Literal["auto", 1, 2] = Field(
        default="auto",
        description="version of the benchmark; auto: 2 if its test list exists or, for kapture "
        "folders, if a rear query has a pose, else 1",
    )
    model: ModelChoice = Field(
        default="auto", description="source of the map's poses; auto prefers the merged model"
    )
    queries: Literal["all", "train", "test"] = Field(
        default="all",
        description="version 2: import only queries taken at the times of the images in this list",
    )
    train_as_map: bool = Field(
        default=False,
        description="version 2: use the training images as map images, not as queries",
    )
    reference_model: bool = Field(
        default=False, description="import the model's points as a kapture map of SIFT features"
    )
    location_prior: bool = Field(
        default=True,
        description="match a query only with map images of its location and camera, as the "
        "benchmark permits; false: with all map images",
    )


class RobotCar:
    """Adapter of RobotCar Seasons: all locations form one map in one metric frame.

    Queries of version 2 with public poses are scored too, so that recall can be measured.
    """

    name = "robotcar"
    Options = RobotCarOptions
    card = DatasetCard(
        title="RobotCar Seasons",
        published_at="https://data.ciirc.cvut.cz/public/projects/2020VisualLocalization/"
        "RobotCar-Seasons/",
        size="tens of GB, much of it a feature database that only the reference model needs",
        folders=("RobotCar-Seasons", "RobotCar_Seasons", "robotcar_seasons", "RobotCar_Seasons-v2"),
        layout="images/<condition>/{left,rear,right}/*.jpg (archives extracted in place), "
        "intrinsics/, extrinsics/, 3D-models/all-merged/all.nvm, "
        "3D-models/individual/{queries_per_location,colmap_reconstructions}/ and, for version 2, "
        "robotcar_v2_{train,test}.txt; or as kapture's downloader leaves it, 01/ to 49/ with "
        "mapping/ and query/ in each",
    )

    def __init__(self, options: RobotCarOptions | None = None) -> None:
        self.options = options or RobotCarOptions()

    def check(self, root: Path) -> None:
        if (form := _kapture_form(root)) is not None:
            if self.options.reference_model:
                raise form.without_model()
        elif absent := Layout(root).absent():
            raise self.card.without(root, absent, with_locations=True)
        elif self.options.reference_model:
            Layout(root).check_points(self.options.model)

    def read(self, root: Path, *, allow_missing: bool = False) -> OfficialDataset:
        self.check(root)
        missing = Missing(Path(root), allow_missing)
        if (form := _kapture_form(root)) is not None:
            return self._read_kapture(form, missing)
        layout = Layout(root)
        version = self.options.version
        if version == "auto":
            found = next(find_near(layout.root, layout.test_list.name), None)
            require(
                found in (None, layout.test_list),
                "this list of version 2 belongs in the root; to import version 1, set version=1",
                path=found,
            )
            version = 1 if found is None else 2
        queries = read_queries(layout, version, missing)
        wanted = sorted({name for listed in queries.locations.values() for name in listed})
        reference = read_reference(layout, self.options.model, wanted, missing)
        cameras = {camera for camera in CAMERAS if missing.require(layout.intrinsics(camera))}
        selection = select(
            version,
            *reference,
            queries,
            part=self.options.queries,
            train_as_map=self.options.train_as_map,
            cameras=cameras,
            find=image_finder(layout, missing),
        )
        remarks: list[str] = []
        model, database = None, None
        if self.options.reference_model:
            model = partial(_read_points, layout, selection, self.options.model)
            database = published_database(layout.feature_database, remarks)
        return self._dataset(
            selection,
            read_car(layout, selection, missing),
            missing,
            remarks,
            reference_images=layout.num_reference_images(),
            links={"": layout.images},
            reference=model,
            reference_database=database,
        )

    def _read_kapture(self, form: KaptureForm, missing: Missing) -> OfficialDataset:
        images = read_kapture_images(form, missing)
        test_list = Layout(missing.root).test_list
        wanted = None if self.options.version == "auto" else self.options.version
        version, queries = queries_of_kapture(images, wanted, test_list, missing)
        reference, car = reference_of_kapture(images), car_of_kapture(form, images)
        selection = select(
            version,
            *reference,
            queries,
            part=self.options.queries,
            train_as_map=self.options.train_as_map,
            cameras=car.sensors,
            find={key: image.name for key, image in images.items()}.get,
        )
        remarks = [f"Read from kapture folders, as version {version}."]
        if version == 2 and not test_list.is_file():
            remarks.append(
                f"Without {test_list.name}, which kapture leaves out, the pose file holds all rear "
                "images whose poses are not public; copy the list into the root to use it."
            )
        return self._dataset(
            selection,
            car,
            missing,
            remarks,
            reference_images=sum(key.condition == REFERENCE_CONDITION for key in images),
            image_files={image.name: image.file for image in images.values()},
        )

    def _dataset(
        self,
        selection: Selection,
        car: KaptureData,
        missing: Missing,
        remarks: list[str],
        *,
        reference_images: int,
        **more: Any,
    ) -> OfficialDataset:
        car = with_rig_of_model(car, selection.map_poses)
        mapping, query = mapping_data(selection, car), with_images(car, selection.query_images)
        published, _ = read_ground_truth(missing.root, query, World())  # groups are known
        groups = _image_groups(selection)
        others = "test images" if selection.version == 2 else "other queries"
        truth = (
            "The true poses of version 2's training images are public (robotcar_v2_train.txt); "
            f"those of the {others} are kept by visuallocalization.net, which scores the rear "
            "camera only."
        )
        return OfficialDataset(
            mapping=mapping,
            query=query,
            query_gt=query_truth(selection, query, published),
            groups=groups,
            priors=_query_priors(selection, groups) if self.options.location_prior else {},
            names=_pose_file_names(selection),
            protocol=protocol_of(self.name).model_copy(update={"truth": truth}),
            summary=_summary(selection, reference_images),
            remarks=[*_remarks(selection), *remarks],
            missing=missing,
            **more,
        )


def _kapture_form(root: Path) -> KaptureForm | None:
    return KaptureForm.find(root, with_locations=True) if Layout(root).absent() else None


def _read_points(
    layout: Layout, selection: Selection, model: ModelChoice
) -> tuple[list[str], SparsePoints]:
    images, points = read_points(layout, model)
    # missing images stay in the list: the points refer to positions in it
    return [selection.map_images.get(image, f"{image.path}.jpg") for image in images], points


def _image_groups(selection: Selection) -> dict[str, ImageGroup]:
    locations = selection.queries.locations
    groups = {}
    for image, path in selection.map_images.items():
        location = _location(image.camera, selection.map_locations.get(image))
        groups[path] = ImageGroup(condition=image.condition, location=location, scored=False)
    for image, path in (*selection.train_images.items(), *selection.query_images.items()):
        groups[path] = ImageGroup(
            condition=image.condition,
            location=_location(image.camera, locations[image][0]),
            scored=image in selection.query_images and selection.is_scored(image),
        )
    return groups


def _query_priors(
    selection: Selection, groups: Mapping[str, ImageGroup]
) -> dict[str, tuple[str, ...]]:
    """Return each query's permitted locations: its own, and its camera's images without one.

    A query without permitted map images keeps its locations as a prior, so that it is matched with
    no map image at all.
    """
    map_paths = (*selection.map_images.values(), *selection.train_images.values())
    known = {groups[path].location for path in map_paths}
    priors = {}
    for image, path in selection.query_images.items():
        locations = tuple(_location(image.camera, p) for p in selection.queries.locations[image])
        priors[path] = (
            tuple(name for name in (*locations, image.camera) if name in known) or locations
        )
    return priors


def _pose_file_names(selection: Selection) -> dict[str, str]:
    paths = selection.query_images
    if selection.version == 2:
        names = selection.queries.test
        return {paths[image]: name for image, name in names.items() if image in paths}
    return {
        path: f"{image.camera}/{image.stem}.jpg"
        for image, path in paths.items()
        if image.camera == SCORED_CAMERA
    }


def _summary(selection: Selection, reference_images: int) -> list[Count]:
    queries = selection.queries
    locations = {location for listed in queries.locations.values() for location in listed}
    counts = [
        Count("locations with queries", len(locations), _NUM_LOCATIONS),
        Count("reference images", reference_images, _NUM_REFERENCE_IMAGES),
        Count("reference images with a pose", len(selection.map_poses), _NUM_REGISTERED),
        Count("query images", len(queries.locations), _NUM_QUERIES),
    ]
    counted = Counter((image.condition, image.camera) for image in queries.locations)
    others = sorted({condition for condition, _ in counted} - set(_QUERIES_PER_CAMERA))
    for condition in (*_QUERIES_PER_CAMERA, *others):
        published = _QUERIES_PER_CAMERA.get(condition)
        for camera in CAMERAS:
            counts.append(Count(f"  {condition}, {camera}", counted[condition, camera], published))
    if selection.version == 2:
        counts.append(Count("training images with a pose", len(queries.train), _NUM_TRAIN))
        counts.append(Count("test images", len(queries.test), _NUM_TEST))
    map_images = len(selection.map_images) + len(selection.train_images)
    counts.append(Count("map images imported", map_images))
    counts.append(Count("query images imported", len(selection.query_images)))
    return counts


def _remarks(selection: Selection) -> list[str]:
    remarks = []
    unknown = sum(image not in selection.map_locations for image in selection.map_images)
    if unknown:
        folder = Layout(Path()).individual_model("NNN")
        remarks.append(
            f"The location of {unknown} map images is not known, because only the individual "
            f"models have it (extract {folder}). All queries of their camera may be matched with "
            "them."
        )
    if selection.queries.unlisted:
        remarks.append(
            f"{selection.queries.unlisted} images of version 2's lists are in no list of "
            "queries_per_location and are left out."
        )
    return remarks


def _location(camera: str, location: str | None) -> str:
    return camera if location is None else f"{location}/{camera}"
