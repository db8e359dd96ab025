"""RobotCar Seasons as kapture distributes it: a folder for each location, ``01/`` to ``49/``, with
``mapping/`` and, where there are queries, ``query/``."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from megloc_kapture.datasets.formats.robotcar_files import ImageKey, parse_image
from megloc_kapture.datasets.kapture_folders import MAPPING, QUERY
from megloc_kapture.datasets.kapture_form import (
    KaptureImage,
    input_files,
    is_kapture,
    parents,
    read_images,
)
from megloc_kapture.datasets.official import Missing
from megloc_kapture.datasets.robotcar.images import Car
from megloc_kapture.datasets.robotcar.layout import (
    REFERENCE_CONDITION,
    SCORED_CAMERA,
    Layout,
    Queries,
    Reference,
    note_time,
    read_test_names,
)
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import KaptureFolder, Sensor
from megloc_kapture.values import Camera, RigidTransform

_LOCATION = re.compile(r"[0-9]{2,3}")


@dataclass(frozen=True)
class LocationFolders:
    """The folders of the locations.

    Parameters
    ----------
    root : of the dataset; version 2's list of test images may lie in it.
    folders : location, as the official files call it (``001``) -> its folder, sorted.
    """

    root: Path
    folders: Mapping[str, Path]

    @classmethod
    def find(cls, root: Path) -> LocationFolders | None:
        """The folders below ``root``; None where there are none."""
        for parent in parents(root):
            found = {
                f"{int(folder.name):03d}": folder
                for folder in sorted(parent.glob("[0-9][0-9]*"))
                if _LOCATION.fullmatch(folder.name) and is_kapture(folder / MAPPING)
            }
            if found:
                return cls(Path(root), found)
        return None

    @property
    def test_list(self) -> Path:
        """Version 2: kapture leaves the list out, a user may put it there."""
        return Layout(self.root).test_list

    def parts(self) -> Iterator[tuple[str, Path]]:
        """Location and kapture folder, for those that are there."""
        for location, folder in self.folders.items():
            for part in (MAPPING, QUERY):
                if is_kapture(folder / part):
                    yield location, folder / part

    def input_files(self) -> Iterator[Path]:
        """Every file an import may depend on."""
        if self.test_list.is_file():
            yield self.test_list
        yield from input_files(folder for _, folder in self.parts())

    def read(self, missing: Missing) -> SeasonsImages:
        """Read all images.

        Raises
        ------
        DataError : broken tables, an image that is none of RobotCar's, cameras or rigs that are
            not the same everywhere.
        """
        found = SeasonsImages()
        for location, folder in self.parts():
            for image in read_images(folder, missing):
                found.add(image, location, folder)
            found.add_rigs(folder)
        return found


@dataclass
class SeasonsImages:
    """The images of all locations.

    Parameters
    ----------
    files : image -> what kapture says of it.
    locations : image -> the locations it is in.
    cameras : name -> intrinsics.
    rig : camera -> ``sensor_from_rig``.
    """

    files: dict[ImageKey, KaptureImage] = field(default_factory=dict)
    locations: dict[ImageKey, tuple[str, ...]] = field(default_factory=dict)
    cameras: dict[str, Camera] = field(default_factory=dict)
    rig: dict[str, RigidTransform] = field(default_factory=dict)
    _at_time: dict[tuple[str, int], ImageKey] = field(default_factory=dict)
    _sensors: dict[str, str] = field(default_factory=dict)

    def add(self, image: KaptureImage, location: str, folder: Path) -> None:
        """Add an image of a location; raises DataError, see :meth:`LocationFolders.read`."""
        key = parse_image(image.name)
        if key is None or not key.condition:
            raise DataError(
                f"image {image.name!r}; expected condition/camera/time.jpg", path=folder
            )
        note_time(key, self._at_time, partial(DataError, path=folder))
        if self.cameras.setdefault(key.camera, image.camera) != image.camera:
            raise DataError(
                f"camera {key.camera} of {image.name!r} is not that of other images; all of "
                "RobotCar's images are rectified to one for each side",
                path=folder,
            )
        self._sensors[image.sensor_id] = key.camera
        self.files.setdefault(key, image)
        others = self.locations.get(key, ())
        if location not in others:
            self.locations[key] = (*others, location)

    def add_rigs(self, folder: Path) -> None:
        """Add where cameras sit on the car; of several folders the first to say so counts."""
        for members in KaptureFolder(folder).read().rigs.values():
            for sensor_id, sensor_from_rig in members.items():
                if sensor_id in self._sensors:
                    self.rig.setdefault(self._sensors[sensor_id], sensor_from_rig)

    def find(self, image: ImageKey) -> str | None:
        """Path of an image; None where it is not there."""
        return self.files[image].name if image in self.files else None

    def car(self) -> Car:
        """The cameras on the car."""
        sensors = {n: Sensor.from_camera(c, name=n) for n, c in sorted(self.cameras.items())}
        return Car(sensors, dict(self.rig))

    def reference(self) -> Reference:
        """The images of the reference traversal that have a pose."""
        poses = {
            key: image.cam_from_world
            for key, image in self.files.items()
            if key.condition == REFERENCE_CONDITION and image.cam_from_world is not None
        }
        return Reference(poses, {key: self.locations[key][0] for key in poses}, merged=False)

    def num_reference(self) -> int:
        """The number of images of the reference traversal, with a pose or without."""
        return sum(key.condition == REFERENCE_CONDITION for key in self.files)

    def queries(self, version: int, test_list: Path, *, allow_missing: bool) -> Queries:
        """The images under other conditions, in the order of locations and times.

        Those of the rear camera that have a pose are version 2's training images. Without its
        test list all others of that camera are handed in.

        Raises
        ------
        DataError : a broken list, see :func:`.robotcar_queries.read_test_names`.
        """
        listed = sorted(
            (locations[0], key.timestamp, key.camera, key)
            for key, locations in self.locations.items()
            if key.condition != REFERENCE_CONDITION
        )
        keys = [key for *_, key in listed]
        train = {
            key: pose
            for key in keys
            if key.camera == SCORED_CAMERA and (pose := self.files[key].cam_from_world) is not None
        }
        test: dict[ImageKey, str] = {}
        unlisted = 0
        if version == 2 and test_list.is_file():
            listed_keys = set(keys)
            queries = {at: key for at, key in self._at_time.items() if key in listed_keys}
            test, unlisted = read_test_names(test_list, queries, train, allow_missing=allow_missing)
        elif version == 2:
            test = {
                key: f"{key.camera}/{key.stem}.png"
                for key in keys
                if key.camera == SCORED_CAMERA and key not in train
            }
        return Queries({key: self.locations[key] for key in keys}, train, test, unlisted)

    def has_training_images(self) -> bool:
        """True where queries have poses, as only version 2 publishes some."""
        return any(
            key.condition != REFERENCE_CONDITION and image.cam_from_world is not None
            for key, image in self.files.items()
        )
