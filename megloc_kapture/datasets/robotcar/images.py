"""The imported images of RobotCar Seasons as kapture: choice, cameras, rig, records and poses; and
the images that kapture distributes, in a folder for each location, ``01/`` to ``49/``, with
``mapping/`` and, where there are queries, ``query/``."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from megloc_kapture.datasets.formats.text_lines import read_rigid_matrix
from megloc_kapture.datasets.kapture_folders import (
    MAPPING,
    QUERY,
    KaptureImage,
    is_kapture,
    parents,
    read_images,
    tables_and_images,
)
from megloc_kapture.datasets.official import Missing, with_poses
from megloc_kapture.datasets.robotcar import (
    CAMERAS,
    REFERENCE_CONDITION,
    SCORED_CAMERA,
    ImageKey,
    Layout,
    Queries,
    Reference,
    note_time,
    parse_image,
    read_intrinsics,
    read_test_names,
)
from megloc_kapture.errors import DataError
from megloc_kapture.geometry.poses import rotation_angles_deg, stack_poses
from megloc_kapture.io.files import named
from megloc_kapture.io.images import image_size
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor
from megloc_kapture.values import Camera, RigidTransform

RIG_ID = "car"
# all images are published in this size; for a download without any
_SIZE_PX = (1024, 1024)


@dataclass(frozen=True, eq=False)
class Selection:
    """The images of an import, as they are on disk.

    Parameters
    ----------
    version : of the benchmark, 1 or 2.
    reference, queries : all that the models and lists say.
    map_images, train_images, query_images : image -> its path below ``images/``: those of the
        reference traversal, version 2's training images where they join the map, the queries.
        They keep the order of the models and lists.
    """

    version: int
    reference: Reference
    queries: Queries
    map_images: Mapping[ImageKey, str]
    train_images: Mapping[ImageKey, str]
    query_images: Mapping[ImageKey, str]

    def is_scored(self, query: ImageKey) -> bool:
        """True where the benchmark, or its public half, asks for a query's pose."""
        if self.version == 1:
            return query.camera == SCORED_CAMERA
        return query in self.queries.test or query in self.queries.train


def select(
    version: int,
    reference: Reference,
    queries: Queries,
    *,
    part: str,
    train_as_map: bool,
    cameras: Collection[str],
    find: Callable[[ImageKey], str | None],
) -> Selection:
    """Choose the images of these cameras.

    Parameters
    ----------
    part : ``all``, or only the moments of version 2's list ``train`` or ``test``.
    train_as_map : version 2's training images are map images.
    find : path of an image below ``images/``; None where it is not there.
    """
    wanted: Iterable[ImageKey] = queries.locations
    if part != "all":
        wanted = _of_moments(wanted, queries.train if part == "train" else queries.test)
    train: Iterable[ImageKey] = ()
    if train_as_map:
        train = queries.train
        # neither are the other cameras of these moments queries: the map knows where they were
        taken = set(_of_moments(queries.locations, train))
        wanted = [image for image in wanted if image not in taken]

    def found(images: Iterable[ImageKey]) -> dict[ImageKey, str]:
        paths = ((image, find(image)) for image in images if image.camera in cameras)
        return {image: path for image, path in paths if path is not None}

    return Selection(
        version,
        reference,
        queries,
        map_images=found(reference.poses),
        train_images=found(train),
        query_images=found(wanted),
    )


def _of_moments(images: Iterable[ImageKey], others: Iterable[ImageKey]) -> list[ImageKey]:
    """Those of ``images`` that were taken at the moments of ``others``, by whichever camera."""
    moments = {(other.condition, other.timestamp) for other in others}
    return [image for image in images if (image.condition, image.timestamp) in moments]


@dataclass(frozen=True, eq=False)
class Car:
    """The cameras by name, and ``sensor_from_rig`` of those whose pose on the car is known."""

    sensors: Mapping[str, Sensor]
    members: Mapping[str, RigidTransform]

    def with_rig_of(self, reference: Reference) -> Car:
        """The car with the rig that the model's poses show, where they are enough to tell."""
        of_model = rig_of_model(reference.poses)
        return (
            replace(self, members=of_model)
            if of_model and set(of_model) <= set(self.sensors)
            else self
        )

    def data(self, images: Mapping[ImageKey, str]) -> KaptureData:
        """Its images, without poses."""
        return KaptureData(
            sensors=dict(self.sensors),
            rigs={RIG_ID: dict(self.members)} if self.members else {},
            records_camera={_record(image): path for image, path in images.items()},
        )


def _record(image: ImageKey) -> tuple[int, str]:
    return image.timestamp, image.camera


def read_car(layout: Layout, selection: Selection, missing: Missing) -> Car:
    """Read intrinsics and extrinsics; an image of each camera tells its size.

    Raises
    ------
    DataError : a broken file; names file and line.
    """
    images = {**selection.map_images, **selection.train_images, **selection.query_images}
    example = {image.camera: path for image, path in reversed(images.items())}
    sensors = {}
    members = {}
    for camera in CAMERAS:
        path = layout.intrinsics(camera)
        if path.exists():
            fx, fy, cx, cy = read_intrinsics(path)
            known = camera in example
            width, height = image_size(layout.images / example[camera]) if known else _SIZE_PX
            with named(path):
                pinhole = Camera("PINHOLE", width, height, (fx, fy, cx, cy))
            sensors[camera] = Sensor.from_camera(pinhole, name=camera)
        path = layout.extrinsics(camera)
        if missing.require(path) and camera in sensors:
            members[camera] = read_rigid_matrix(path).inverse()  # car_from_cam, metres
    return Car(sensors, members)


def mapping_data(selection: Selection, car: Car) -> KaptureData:
    """The map's images; each camera has its own pose, which no rig fits exactly."""
    images = {**selection.map_images, **selection.train_images}
    poses = {**selection.reference.poses, **selection.queries.train}
    return with_poses(car.data(images), {_record(image): poses[image] for image in images})


def query_truth(
    selection: Selection, query: KaptureData, beside: KaptureData | None
) -> KaptureData:
    """Public poses of the queries: version 2's training images, and what lies beside the data."""
    poses = {} if beside is None else dict(beside.trajectories)
    for image, pose in selection.queries.train.items():
        if image in selection.query_images:
            poses[_record(image)] = pose
    return with_poses(query, poses)


_ROOT = "rear"  # the rig's frame
_MIN_MOMENTS = 10
# poses of single images are wrong at times: farther than so many medians off has no say
_OUTLIER = 3.0
_ROUNDS = 3


def rig_of_model(poses: Mapping[ImageKey, RigidTransform]) -> dict[str, RigidTransform]:
    """``sensor_from_rig`` of every camera, the rear camera's frame being the rig's.

    Empty where a camera shares too few moments with the rear one to tell.

    Parameters
    ----------
    poses : ``cam_from_world`` of the model's images.
    """
    rear = {key.timestamp: pose for key, pose in poses.items() if key.camera == _ROOT}
    members = {_ROOT: RigidTransform.identity()}
    for camera in CAMERAS:
        if camera == _ROOT:
            continue
        relative = [
            pose @ rear[key.timestamp].inverse()
            for key, pose in sorted(poses.items(), key=lambda item: item[0].timestamp)
            if key.camera == camera and key.timestamp in rear
        ]
        if len(relative) < _MIN_MOMENTS:
            return {}
        members[camera] = middle_transform(relative)
    return members


def middle_transform(transforms: Sequence[RigidTransform]) -> RigidTransform:
    """The middle of transforms that should be one: mean rotation, median translation.

    The mean quaternion is Markley's (Averaging Quaternions, J. Guidance 2007), of the transforms
    whose rotation is not far off.
    """
    quats, translations = stack_poses(transforms)
    kept = np.ones(len(quats), bool)
    mean = quats[0]
    for _ in range(_ROUNDS):
        _, vectors = np.linalg.eigh(quats[kept].T @ quats[kept])
        mean = vectors[:, -1]
        off = rotation_angles_deg(quats, np.broadcast_to(mean, quats.shape))
        kept = off <= max(_OUTLIER * float(np.median(off)), 1e-9)
    w, x, y, z = (mean if mean[0] >= 0 else -mean).tolist()
    tx, ty, tz = np.median(translations[kept], axis=0).tolist()
    return RigidTransform((w, x, y, z), (tx, ty, tz))


# ------------------------------------------------------------------------- kapture folders


@dataclass(frozen=True)
class LocationFolders:
    """The kapture folders of the locations.

    Parameters
    ----------
    test_list : of version 2, which kapture leaves out; a user may put it into the root.
    folders : location, as the official files call it (``001``) -> its folder, sorted.
    """

    test_list: Path
    folders: Mapping[str, Path]

    @classmethod
    def find(cls, root: Path) -> LocationFolders | None:
        """The folders that are there instead of the official files; None where these are."""
        layout = Layout(root)
        for parent in parents(root) if layout.absent() else ():
            found = {
                f"{int(folder.name):03d}": folder
                for folder in sorted(parent.glob("[0-9][0-9]*"))
                if re.fullmatch("[0-9]{2,3}", folder.name) and is_kapture(folder / MAPPING)
            }
            if found:
                return cls(layout.test_list, found)
        return None

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
        yield from tables_and_images(folder for _, folder in self.parts())

    def read(self, missing: Missing) -> SeasonsImages:
        """Read all images.

        Raises
        ------
        DataError : broken tables, an image that is none of RobotCar's, cameras or rigs that are
            not the same everywhere.
        """
        found = SeasonsImages()
        for location, folder in self.parts():
            for image in read_images(folder, missing.require):
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

    def car(self) -> Car:
        """The cameras on the car."""
        sensors = {n: Sensor.from_camera(c, name=n) for n, c in sorted(self.cameras.items())}
        return Car(sensors, dict(self.rig))

    def poses(self, *, reference: bool) -> dict[ImageKey, RigidTransform]:
        """The poses that are known of images of the reference traversal, or of the others."""
        return {
            key: image.cam_from_world
            for key, image in self.files.items()
            if (key.condition == REFERENCE_CONDITION) == reference
            and image.cam_from_world is not None
        }

    def reference(self) -> Reference:
        """The images of the reference traversal that have a pose."""
        poses = self.poses(reference=True)
        return Reference(poses, {key: self.locations[key][0] for key in poses}, merged=False)

    def queries(self, version: int, test_list: Path, *, allow_missing: bool) -> Queries:
        """The images under other conditions, in the order of locations and times.

        Those of the rear camera that have a pose are version 2's training images. Without its
        test list all others of that camera are handed in. DataError names a broken list, see
        :func:`.read_test_names`.
        """
        listed = sorted(
            (locations[0], key.timestamp, key.camera, key)
            for key, locations in self.locations.items()
            if key.condition != REFERENCE_CONDITION
        )
        keys = [key for *_, key in listed]
        poses = self.poses(reference=False)
        scored = [key for key in keys if key.camera == SCORED_CAMERA]
        train = {key: poses[key] for key in scored if key in poses}
        test: dict[ImageKey, str] = {}
        unlisted = 0
        if version == 2 and test_list.is_file():
            listed_keys = set(keys)
            queries = {at: key for at, key in self._at_time.items() if key in listed_keys}
            test, unlisted = read_test_names(test_list, queries, train, allow_missing=allow_missing)
        elif version == 2:
            test = {key: f"{key.camera}/{key.stem}.png" for key in scored if key not in train}
        return Queries({key: self.locations[key] for key in keys}, train, test, unlisted)
