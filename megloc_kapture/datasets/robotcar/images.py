"""The imported images of RobotCar Seasons as kapture: choice, cameras, rig, records and poses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from megloc_kapture.datasets.formats.robotcar_files import (
    ImageKey,
    read_intrinsics,
)
from megloc_kapture.datasets.formats.text_lines import read_rigid_matrix
from megloc_kapture.datasets.official import Missing, with_poses
from megloc_kapture.datasets.robotcar.layout import (
    CAMERAS,
    SCORED_CAMERA,
    Layout,
    ModelChoice,
    Queries,
    Reference,
)
from megloc_kapture.errors import DataError
from megloc_kapture.geometry.poses import rotation_angles_deg, stack_poses
from megloc_kapture.io.images import image_size
from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.values import Camera, Options, RigidTransform


class RobotCarOptions(Options):
    """The part of RobotCar Seasons to import, and the published model of its poses."""

    version: Literal["auto", 1, 2] = Field(
        default="auto", description="of the benchmark; auto is 2 where its test list is there"
    )
    model: ModelChoice = Field(
        default="auto", description="that the map's poses come from; auto prefers the merged one"
    )
    queries: Literal["all", "train", "test"] = Field(
        default="all", description="version 2: import only the moments of one of its lists"
    )
    train_as_map: bool = Field(
        default=False, description="version 2: its training images are map images, not queries"
    )
    reference_model: bool = Field(
        default=False, description="import the model's points as a kapture map of SIFT features"
    )
    location_prior: bool = Field(
        default=True,
        description="a query is matched with map images of its location and camera only, which "
        "the benchmark permits to know; false: with all",
    )

    @model_validator(mode="after")
    def _usable(self) -> RobotCarOptions:
        if self.train_as_map and self.queries == "train":
            raise ValueError("train_as_map leaves nothing for queries=train")
        return self


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

    def images(self) -> dict[ImageKey, str]:
        """All images."""
        return {**self.map_images, **self.train_images, **self.query_images}

    def is_scored(self, query: ImageKey) -> bool:
        """True where the benchmark, or its public half, asks for a query's pose."""
        if self.version == 1:
            return query.camera == SCORED_CAMERA
        return query in self.queries.test or query in self.queries.train


def select(
    options: RobotCarOptions,
    version: int,
    reference: Reference,
    queries: Queries,
    *,
    cameras: Collection[str],
    find: Callable[[ImageKey], str | None],
) -> Selection:
    """Choose the images of these cameras.

    Parameters
    ----------
    find : path of an image below ``images/``; None where it is not there.
    """
    wanted: Iterable[ImageKey] = queries.locations
    if options.queries != "all":
        listed = queries.train if options.queries == "train" else queries.test
        wanted = _of_moments(wanted, listed)
    train: Iterable[ImageKey] = ()
    if options.train_as_map:
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


RIG_ID = "car"
# all images are published in this size; for a download without any
_SIZE_PX = (1024, 1024)


@dataclass(frozen=True, eq=False)
class Car:
    """The cameras by name, and ``sensor_from_rig`` of those whose pose on the car is known."""

    sensors: Mapping[str, Sensor]
    members: Mapping[str, RigidTransform]


def read_car(layout: Layout, selection: Selection, missing: Missing) -> Car:
    """Read intrinsics and extrinsics; an image of each camera tells its size.

    Raises
    ------
    DataError : a broken file; names file and line.
    """
    example = {image.camera: path for image, path in reversed(selection.images().items())}
    sensors = {}
    members = {}
    for camera in CAMERAS:
        path = layout.intrinsics(camera)
        if path.exists():
            fx, fy, cx, cy = read_intrinsics(path)
            known = camera in example
            width, height = image_size(layout.images / example[camera]) if known else _SIZE_PX
            try:
                pinhole = Camera("PINHOLE", width, height, (fx, fy, cx, cy))
            except DataError as error:
                raise DataError(error.message, path=path) from error
            sensors[camera] = Sensor.from_camera(pinhole, name=camera)
        path = layout.extrinsics(camera)
        if missing.require(path) and camera in sensors:
            members[camera] = read_rigid_matrix(path).inverse()  # car_from_cam, metres
    return Car(sensors, members)


def with_rig_of_model(car: Car, reference: Reference) -> Car:
    """The car with the rig that the model's poses show.

    The published extrinsics stay where the model has too few moments of all cameras.
    """
    of_model = rig_of_model(reference.poses)
    return replace(car, members=of_model) if of_model and set(of_model) <= set(car.sensors) else car


def mapping_data(selection: Selection, car: Car) -> KaptureData:
    """The map's images; each camera has its own pose, which no rig fits exactly."""
    images = {**selection.map_images, **selection.train_images}
    poses = {**selection.reference.poses, **selection.queries.train}
    return with_poses(_data(images, car), {_record(image): poses[image] for image in images})


def query_data(selection: Selection, car: Car) -> KaptureData:
    """The queries, without poses."""
    return _data(selection.query_images, car)


def query_truth(
    selection: Selection, query: KaptureData, beside: KaptureData | None
) -> KaptureData:
    """Public poses of the queries: version 2's training images, and what lies beside the data."""
    poses = {} if beside is None else dict(beside.trajectories)
    for image, pose in selection.queries.train.items():
        if image in selection.query_images:
            poses[_record(image)] = pose
    return with_poses(query, poses)


def _data(images: Mapping[ImageKey, str], car: Car) -> KaptureData:
    return KaptureData(
        sensors=dict(car.sensors),
        rigs={RIG_ID: dict(car.members)} if car.members else {},
        records_camera={_record(image): path for image, path in images.items()},
    )


def _record(image: ImageKey) -> tuple[int, str]:
    return image.timestamp, image.camera


_ROOT = "rear"  # the rig's frame
_MIN_MOMENTS = 10
# poses of single images are wrong at times: farther than so many medians off has no say
_OUTLIER = 3.0
_ROUNDS = 3


def rig_of_model(poses: Mapping[ImageKey, RigidTransform]) -> dict[str, RigidTransform]:
    """``sensor_from_rig`` of every camera, the rear camera's frame being the rig's.

    Parameters
    ----------
    poses : ``cam_from_world`` of the model's images.

    Returns
    -------
    Empty where a camera shares too few moments with the rear one to tell.
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
