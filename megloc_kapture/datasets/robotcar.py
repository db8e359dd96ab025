"""RobotCar Seasons, versions 1 and 2: three cameras on a car, 49 locations, nine conditions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from megloc_kapture.datasets.kapture_form import image_files, without_model
from megloc_kapture.datasets.official import (
    REFERENCE,
    DatasetCard,
    Missing,
    OfficialDataset,
    ground_truth_files,
    read_ground_truth,
)
from megloc_kapture.datasets.reference_map import write_reference_map
from megloc_kapture.datasets.robotcar_folders import LocationFolders
from megloc_kapture.datasets.robotcar_kapture import (
    Car,
    mapping_data,
    query_data,
    query_truth,
    read_car,
    with_rig_of_model,
)
from megloc_kapture.datasets.robotcar_layout import CAMERAS, ImageFiles, Layout
from megloc_kapture.datasets.robotcar_queries import read_queries
from megloc_kapture.datasets.robotcar_reference import read_points, read_reference
from megloc_kapture.datasets.robotcar_selection import RobotCarOptions, Selection, select
from megloc_kapture.datasets.robotcar_tables import (
    image_groups,
    pose_file_names,
    protocol,
    query_priors,
    remarks,
    summary,
)
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.kapture_store import KaptureData
from megloc_kapture.io.side_tables import World

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
        absent = _absent(Layout(Path(root)))
        if absent:
            raise DataError(
                f"not {self.card.title}, no folder {' and '.join(absent)}; it has to lie as "
                f"{self.card.layout}",
                path=root,
            )

    def input_files(self, root: Path) -> Iterator[Path]:
        """Every file an import may depend on, images included."""
        folders = _folders_of(root)
        if folders is not None:
            yield from folders.input_files()
            yield from ground_truth_files(Path(root))
            return
        layout = Layout(Path(root))
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
        layout = Layout(Path(root))
        version = self._version(is_second=layout.test_list.is_file())
        missing = Missing(layout.root)
        queries = read_queries(layout, version, missing, allow_missing=allow_missing)
        places = sorted({place for listed in queries.locations.values() for place in listed})
        reference = read_reference(layout, self.options.model, places, missing)
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
        links = {"": layout.images}
        return replace(
            dataset,
            links=links,
            remarks=[*dataset.remarks, *self._about_reference(layout)],
            write_more=partial(_write_reference, layout, selection, dataset.mapping, links)
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
        """What does not depend on how the images lie."""
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
        """What a user should know about the reference model."""
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
    """The locations' kapture folders that lie in the place of the official files, if they do."""
    return LocationFolders.find(root) if _absent(Layout(Path(root))) else None


def _absent(layout: Layout) -> list[str]:
    """Names of the official layout's folders that are not there."""
    return [path.name for path in (layout.images, layout.models) if not path.is_dir()]


def _write_reference(
    layout: Layout,
    selection: Selection,
    mapping: KaptureData,
    links: Mapping[str, Path],
    output: Path,
) -> None:
    """Write the dataset's own model as a kapture map."""
    images, points = read_points(layout, merged=selection.reference.merged)
    # an image that is not on disk keeps its place in the list
    names = [selection.map_images.get(image, f"{image.path}.jpg") for image in images]
    database = layout.feature_database
    write_reference_map(
        output / REFERENCE,
        mapping,
        links,
        names,
        points,
        database=database if database.is_file() else None,
    )
