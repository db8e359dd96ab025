"""RobotCar Seasons, versions 1 and 2: three cameras on a car, 49 locations, nine conditions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from megloc_kapture.datasets.formats.sparse_points import SparsePoints
from megloc_kapture.datasets.kapture_form import image_files, without_model
from megloc_kapture.datasets.official import (
    Count,
    DatasetCard,
    Missing,
    OfficialDataset,
    ground_truth_files,
    read_ground_truth,
)
from megloc_kapture.datasets.reference_map import ReferenceModel
from megloc_kapture.datasets.robotcar.images import (
    Car,
    RobotCarOptions,
    Selection,
    mapping_data,
    query_data,
    query_truth,
    read_car,
    select,
    with_rig_of_model,
)
from megloc_kapture.datasets.robotcar.kapture_form import LocationFolders
from megloc_kapture.datasets.robotcar.layout import (
    CAMERAS,
    NUM_LOCATIONS,
    NUM_QUERIES,
    NUM_REFERENCE_IMAGES,
    NUM_REGISTERED,
    NUM_TEST,
    NUM_TRAIN,
    QUERIES_PER_CAMERA,
    SCORED_CAMERA,
    ImageFiles,
    Layout,
    read_points,
    read_queries,
    read_reference,
)
from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.dataset_tables import ImageGroup, Protocol, World

__all__ = ["RobotCar", "RobotCarOptions"]


class RobotCar:
    """Adapter of RobotCar Seasons.

    All locations become one map in one metric frame; the side tables say which images belong to
    which location. ``names.csv`` holds what has to be handed in; scored are also the images whose
    poses version 2 publishes, so that recall can be measured with them.
    """

    name = "robotcar"
    Options = RobotCarOptions
    card = DatasetCard(
        title="RobotCar Seasons",
        published_at="https://data.ciirc.cvut.cz/public/projects/2020VisualLocalization/"
        "RobotCar-Seasons/",
        size="tens of GB, much of it a feature database that only the reference model needs",
        folders=(
            "RobotCar-Seasons",
            "RobotCar_Seasons",
            "robotcar_seasons",
            "RobotCar_Seasons-v2",
        ),
        layout="images/<condition>/{left,rear,right}/*.jpg (archives extracted in place), "
        "intrinsics/, extrinsics/, 3D-models/all-merged/all.nvm, "
        "3D-models/individual/{queries_per_location,colmap_reconstructions}/ and, for version 2, "
        "robotcar_v2_{train,test}.txt; or as kapture's downloader leaves it, 01/ to 49/ with "
        "mapping/ and query/ in each",
    )

    def __init__(self, options: RobotCarOptions | None = None) -> None:
        self.options = options or RobotCarOptions()

    def check(self, root: Path) -> None:
        """Raise MeglocError, quickly, when ``root`` cannot be what is wanted of RobotCar."""
        if _folders_of(root) is not None:
            if self.options.reference_model:
                raise without_model(root)
            return
        absent = _absent(Layout(root))
        if absent:
            raise self.card.without(root, absent)

    def input_files(self, root: Path) -> Iterator[Path]:
        """Every file an import may depend on, images included."""
        folders = _folders_of(root)
        if folders is not None:
            yield from folders.input_files()
            yield from ground_truth_files(Path(root))
            return
        layout = Layout(root)
        single = [of(camera) for of in (layout.intrinsics, layout.extrinsics) for camera in CAMERAS]
        single += [layout.train_list, layout.test_list, layout.merged_model]
        if self.options.reference_model:
            single.append(layout.feature_database)
        yield from (path for path in single if path.is_file())
        yield from layout.query_lists().values()
        for folder in layout.individual_models().values():
            yield from sorted(path for path in folder.iterdir() if path.is_file())
        yield from layout.image_files()
        yield from ground_truth_files(layout.root)

    def read(self, root: Path, *, allow_missing: bool = False) -> OfficialDataset:
        """Read the dataset.

        Raises
        ------
        DataError : something is broken, or ``root`` is not the dataset; names file and line.
        OptionError : an option of version 2 where version 1 is read.
        """
        self.check(root)
        folders = _folders_of(root)
        if folders is not None:
            return self._read_folders(folders, Missing(Path(root)), allow_missing=allow_missing)
        layout = Layout(root)
        version = self._version(is_second=layout.test_list.is_file())
        missing = Missing(layout.root)
        queries = read_queries(layout, version, missing, allow_missing=allow_missing)
        wanted = sorted({name for listed in queries.locations.values() for name in listed})
        reference = read_reference(layout, self.options.model, wanted, missing)
        selection = select(
            self.options,
            version,
            reference,
            queries,
            cameras={camera for camera in CAMERAS if missing.require(layout.intrinsics(camera))},
            find=ImageFiles(layout, missing).find,
        )
        car = read_car(layout, selection, missing)
        dataset = self._dataset(selection, car, missing, layout.num_reference_images())
        return replace(
            dataset,
            links={"": layout.images},
            remarks=[*dataset.remarks, *self._about_reference(layout)],
            reference=ReferenceModel(
                partial(_read_points, layout, selection),
                layout.feature_database if layout.feature_database.is_file() else None,
            )
            if self.options.reference_model
            else None,
        )

    def _read_folders(
        self, folders: LocationFolders, missing: Missing, *, allow_missing: bool
    ) -> OfficialDataset:
        images = folders.read(missing)
        listed = folders.test_list.is_file()
        version = self._version(is_second=listed or images.has_training_images())
        queries = images.queries(version, folders.test_list, allow_missing=allow_missing)
        selection = select(
            self.options,
            version,
            images.reference(),
            queries,
            cameras=images.cameras,
            find=images.find,
        )
        dataset = self._dataset(selection, images.car(), missing, images.num_reference())
        remarks = [f"Read from kapture folders, as version {version}."]
        if version == 2 and not listed:
            remarks.append(
                f"Without {folders.test_list.name}, which kapture leaves out, the pose file holds "
                "all rear images whose poses are not public; the list may be put into the root."
            )
        return replace(
            dataset,
            image_files=image_files(images.files.values()),
            remarks=[*dataset.remarks, *remarks],
        )

    def _dataset(
        self, selection: Selection, car: Car, missing: Missing, reference_images: int
    ) -> OfficialDataset:
        """The part that does not depend on the layout of the images."""
        car = with_rig_of_model(car, selection.reference)
        mapping, query = mapping_data(selection, car), query_data(selection, car)
        beside, _ = read_ground_truth(missing.root, query, World())  # names tell conditions
        groups = image_groups(selection)
        return OfficialDataset(
            mapping=mapping,
            query=query,
            query_gt=query_truth(selection, query, beside),
            groups=groups,
            priors=query_priors(selection, groups) if self.options.location_prior else {},
            names=pose_file_names(selection),
            protocol=protocol(self.name, selection.version),
            summary=summary(selection, reference_images=reference_images),
            remarks=remarks(selection),
            missing=missing,
        )

    def _about_reference(self, layout: Layout) -> list[str]:
        """Sentences for the user about the reference model."""
        database = layout.feature_database
        if not self.options.reference_model or database.is_file():
            return []
        return [
            "The reference model comes without descriptors: they are in "
            f"{database.relative_to(layout.root)}, which is not there. With map = given they are "
            "extracted again from the images."
        ]

    def _version(self, *, is_second: bool) -> int:
        """The version to read where the data look like the second's, or do not."""
        version = self.options.version
        if version == "auto":
            version = 2 if is_second else 1
        if version == 1 and (self.options.train_as_map or self.options.queries != "all"):
            raise OptionError(
                "train_as_map and queries are about version 2, whose lists are not there or not "
                "wanted (version=2)"
            )
        return version


def _folders_of(root: Path) -> LocationFolders | None:
    """The locations' kapture folders where they are there instead of the official files."""
    return LocationFolders.find(root) if _absent(Layout(root)) else None


def _absent(layout: Layout) -> list[str]:
    """Names of the official layout's folders that are not there."""
    return [path.name for path in (layout.images, layout.models) if not path.is_dir()]


def _read_points(layout: Layout, selection: Selection) -> tuple[list[str], SparsePoints]:
    """Names of the images of the dataset's own model, in its order, and its points."""
    images, points = read_points(layout, merged=selection.reference.merged)
    # an image that is not on disk keeps its position in the list
    return [selection.map_images.get(image, f"{image.path}.jpg") for image in images], points


def image_groups(selection: Selection) -> dict[str, ImageGroup]:
    """Condition and location of all images, and which queries are scored."""
    locations = selection.queries.locations
    groups = {}
    for image, path in selection.map_images.items():
        location = _location(image.camera, selection.reference.locations.get(image))
        groups[path] = ImageGroup(condition=image.condition, location=location, scored=False)
    for image, path in (*selection.train_images.items(), *selection.query_images.items()):
        groups[path] = ImageGroup(
            condition=image.condition,
            location=_location(image.camera, locations[image][0]),
            scored=image in selection.query_images and selection.is_scored(image),
        )
    return groups


def query_priors(
    selection: Selection, groups: Mapping[str, ImageGroup]
) -> dict[str, tuple[str, ...]]:
    """The permitted map images of each query: those of its location and camera.

    Map images whose location is not known are permitted to all queries of their camera. Where
    the map has nothing of the kind, the query's own location stands there all the same: it may
    not be matched with others.
    """
    map_paths = (*selection.map_images.values(), *selection.train_images.values())
    known = {groups[path].location for path in map_paths}
    priors = {}
    for image, path in selection.query_images.items():
        own = tuple(_location(image.camera, p) for p in selection.queries.locations[image])
        priors[path] = tuple(name for name in (*own, image.camera) if name in known) or own
    return priors


def pose_file_names(selection: Selection) -> dict[str, str]:
    """Rows of the pose file, in the order of the list: the images the server scores."""
    paths = selection.query_images
    if selection.version == 2:
        names = selection.queries.test
        return {paths[image]: name for image, name in names.items() if image in paths}
    return {
        path: f"{image.camera}/{image.stem}.jpg"
        for image, path in paths.items()
        if image.camera == SCORED_CAMERA
    }


def protocol(dataset: str, version: int) -> Protocol:
    """The scoring rules of the benchmark."""
    public = "The true poses of version 2's training images are public (robotcar_v2_train.txt)"
    others = "test images" if version == 2 else "other queries"
    return protocol_of(dataset).model_copy(
        update={
            "truth": f"{public}; those of the {others} are kept by visuallocalization.net, which "
            "scores the rear camera only."
        }
    )


def summary(selection: Selection, *, reference_images: int) -> list[Count]:
    """Counts of models and lists, beside those published, and of what is imported.

    Parameters
    ----------
    reference_images : how many are on disk, with a pose or without.
    """
    queries, reference = selection.queries, selection.reference
    locations = {location for listed in queries.locations.values() for location in listed}
    counts = [
        Count("locations with queries", len(locations), NUM_LOCATIONS),
        Count("reference images", reference_images, NUM_REFERENCE_IMAGES),
        Count("reference images with a pose", len(reference.poses), NUM_REGISTERED),
        Count("query images", len(queries.locations), NUM_QUERIES),
    ]
    found = Counter((image.condition, image.camera) for image in queries.locations)
    others = sorted({condition for condition, _ in found} - set(QUERIES_PER_CAMERA))
    for condition in (*QUERIES_PER_CAMERA, *others):
        published = QUERIES_PER_CAMERA.get(condition)
        for camera in CAMERAS:
            counts.append(Count(f"  {condition}, {camera}", found[condition, camera], published))
    if selection.version == 2:
        counts.append(Count("training images with a pose", len(queries.train), NUM_TRAIN))
        counts.append(Count("test images", len(queries.test), NUM_TEST))
    map_images = len(selection.map_images) + len(selection.train_images)
    counts.append(Count("map images imported", map_images))
    counts.append(Count("query images imported", len(selection.query_images)))
    return counts


def remarks(selection: Selection) -> list[str]:
    """Sentences for the user about this import."""
    said = [
        "The rig is the one that the reference model's poses show, as extrinsics/ does not agree "
        "well with them; where the model has fewer than ten moments of all cameras, it is that of "
        "extrinsics/. Every map image has the model's pose, none goes through the rig."
    ]
    unknown = sum(image not in selection.reference.locations for image in selection.map_images)
    if unknown:
        folder = Layout(Path()).individual_model("NNN")
        said.append(
            f"The location of {unknown} map images is not known: only the individual models tell "
            f"it ({folder}, extracted). All queries of their camera may be matched with them."
        )
    if selection.queries.unlisted:
        said.append(
            f"{selection.queries.unlisted} images of version 2's lists are in no list of "
            "queries_per_location and are left out."
        )
    return said


def _location(camera: str, location: str | None) -> str:
    return camera if location is None else f"{location}/{camera}"
