"""RobotCar Seasons as kapture: cameras, rig, records and poses of the chosen images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from megloc_kapture.datasets.grammars.robotcar_files import (
    ImageKey,
    read_extrinsics,
    read_intrinsics,
)
from megloc_kapture.datasets.official import Missing, with_poses
from megloc_kapture.datasets.robotcar_layout import CAMERAS, Layout
from megloc_kapture.datasets.robotcar_reference import Reference
from megloc_kapture.datasets.robotcar_rig import rig_of_model
from megloc_kapture.datasets.robotcar_selection import Selection
from megloc_kapture.errors import DataError
from megloc_kapture.io.images import image_size
from megloc_kapture.io.kapture_store import KaptureData, Sensor
from megloc_kapture.values import Camera, RigidTransform

RIG_ID = "car"
# all images are published in this size; for a download without any
_SIZE_PX = (1024, 1024)


@dataclass(frozen=True, eq=False)
class Car:
    """The cameras by name, and ``sensor_from_rig`` of those whose place on the car is known."""

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
            members[camera] = read_extrinsics(path).inverse()
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
