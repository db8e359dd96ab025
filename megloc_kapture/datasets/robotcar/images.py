"""The imported images of RobotCar Seasons as kapture: selection, cameras, rig, records, poses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from megloc_kapture.datasets.official import KaptureForm, KaptureImage, Missing, with_poses
from megloc_kapture.datasets.robotcar import (
    CAMERAS,
    REFERENCE_CONDITION,
    SCORED_CAMERA,
    ImageKey,
    Layout,
    Queries,
    known_queries,
    parse_image,
    read_intrinsics,
    read_test_list,
)
from megloc_kapture.errors import DataError, check_option, require
from megloc_kapture.geometry.poses import rotation_angles_deg, stack_poses
from megloc_kapture.io.files import named
from megloc_kapture.io.images import image_size
from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.io.text_lines import read_transform
from megloc_kapture.values import Camera, RigidTransform

RIG_ID = "car"
# size of all published images, for a download without images
_SIZE_PX = (1024, 1024)


@dataclass(frozen=True, eq=False)
class Selection:
    """The existing images, with paths below ``images/``; ``train_images`` are added to the map.

    ``map_poses`` are ``cam_from_world`` of all reference images, ``map_locations`` their locations
    where known.
    """

    version: int
    map_poses: Mapping[ImageKey, RigidTransform]
    map_locations: Mapping[ImageKey, str]
    queries: Queries
    map_images: Mapping[ImageKey, str]
    train_images: Mapping[ImageKey, str]
    query_images: Mapping[ImageKey, str]

    def is_scored(self, query: ImageKey) -> bool:
        """Return whether a query is evaluated: by the benchmark, or because its pose is public."""
        if self.version == 1:
            return query.camera == SCORED_CAMERA
        return query in self.queries.test or query in self.queries.train


def select(
    version: int,
    map_poses: Mapping[ImageKey, RigidTransform],
    map_locations: Mapping[ImageKey, str],
    queries: Queries,
    *,
    part: str,
    train_as_map: bool,
    cameras: Collection[str],
    find: Callable[[ImageKey], str | None],
) -> Selection:
    """Choose the images of these cameras.

    ``part`` limits the queries to moments (condition and time) of version 2's train or test list.
    """
    check_option(
        version == 2 or not (train_as_map or part != "all"),
        "the options `train_as_map` and `queries` need version 2, but version 1 is being imported; "
        "add robotcar_v2_test.txt, or set version=2",
    )
    wanted: Iterable[ImageKey] = queries.locations
    if part != "all":
        wanted = _of_moments(wanted, queries.train if part == "train" else queries.test)
    train: Iterable[ImageKey] = ()
    if train_as_map:
        train = queries.train
        # drop the other cameras of these moments too: the map reveals their poses
        taken = set(_of_moments(queries.locations, train))
        wanted = [image for image in wanted if image not in taken]

    def with_paths(images: Iterable[ImageKey]) -> dict[ImageKey, str]:
        paths = ((image, find(image)) for image in images if image.camera in cameras)
        return {image: path for image, path in paths if path is not None}

    return Selection(
        version,
        map_poses,
        map_locations,
        queries,
        map_images=with_paths(map_poses),
        train_images=with_paths(train),
        query_images=with_paths(wanted),
    )


def _of_moments(images: Iterable[ImageKey], others: Iterable[ImageKey]) -> list[ImageKey]:
    moments = {(other.condition, other.timestamp) for other in others}
    return [image for image in images if (image.condition, image.timestamp) in moments]


def with_rig_of_model(car: KaptureData, poses: Mapping[ImageKey, RigidTransform]) -> KaptureData:
    """Return the car with a rig estimated from the reference model's poses, if they suffice."""
    members = rig_of_model(poses)
    fits = members and set(members) <= set(car.sensors)
    return replace(car, rigs={RIG_ID: members}) if fits else car


def with_images(car: KaptureData, images: Mapping[ImageKey, str]) -> KaptureData:
    return replace(car, records_camera={_record(image): path for image, path in images.items()})


def _record(image: ImageKey) -> tuple[int, str]:
    return image.timestamp, image.camera


def read_car(layout: Layout, selection: Selection, missing: Missing) -> KaptureData:
    """Read intrinsics and extrinsics; the image size of a camera comes from one of its images."""
    images = {**selection.map_images, **selection.train_images, **selection.query_images}
    example = {image.camera: path for image, path in reversed(images.items())}
    sensors: dict[str, Sensor] = {}
    members: dict[str, RigidTransform] = {}
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
            members[camera] = read_transform(path).inverse()  # car_from_cam, metres
    return KaptureData(sensors, {RIG_ID: members} if members else {})


def mapping_data(selection: Selection, car: KaptureData) -> KaptureData:
    """Return the map's images; each has a separate pose, because no rig fits the poses exactly."""
    images = {**selection.map_images, **selection.train_images}
    poses = {**selection.map_poses, **selection.queries.train}
    return with_poses(with_images(car, images), {_record(image): poses[image] for image in images})


def query_truth(
    selection: Selection, query: KaptureData, published: KaptureData | None
) -> KaptureData:
    poses = {} if published is None else dict(published.trajectories)
    for image, pose in selection.queries.train.items():
        if image in selection.query_images:
            poses[_record(image)] = pose
    return with_poses(query, poses)


_ROOT = "rear"  # the rig's frame
_MIN_MOMENTS = 10
# some poses are wrong: rotations are ignored if they deviate by more than this times the median
_OUTLIER = 3.0
_ROUNDS = 3


def rig_of_model(poses: Mapping[ImageKey, RigidTransform]) -> dict[str, RigidTransform]:
    """Estimate ``sensor_from_rig`` with the rear camera as rig frame; empty for too few moments."""
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
    """Return a robust mean rotation (Markley, J. Guidance 2007) and median translation."""
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


def read_kapture_images(form: KaptureForm, missing: Missing) -> dict[ImageKey, KaptureImage]:
    by_key: dict[ImageKey, KaptureImage] = {}
    cameras: dict[str, Camera] = {}
    for image in form.read(missing):
        key = parse_image(image.name)
        if key is None or not key.condition:
            raise DataError(
                f"image {image.name!r}; expected condition/camera/time.jpg", path=image.file
            )
        require(
            cameras.setdefault(key.camera, image.camera) == image.camera,
            f"camera {key.camera} has other intrinsics than in other images; the dataset's images "
            "are rectified to one camera model per camera",
            path=image.file,
        )
        by_key[key] = image
    return by_key


def car_of_kapture(form: KaptureForm, images: Mapping[ImageKey, KaptureImage]) -> KaptureData:
    cameras = {key.camera: image.camera for key, image in images.items()}
    names = {image.sensor_id: key.camera for key, image in images.items()}
    sensors = {name: Sensor.from_camera(cameras[name], name=name) for name in sorted(cameras)}
    members = {names[sensor]: pose for sensor, pose in form.rig().items() if sensor in names}
    return KaptureData(sensors, {RIG_ID: members} if members else {})


def reference_of_kapture(
    images: Mapping[ImageKey, KaptureImage],
) -> tuple[dict[ImageKey, RigidTransform], dict[ImageKey, str]]:
    """Return ``cam_from_world`` and locations of the reference images."""
    poses = {
        key: image.cam_from_world
        for key, image in images.items()
        if key.condition == REFERENCE_CONDITION and image.cam_from_world is not None
    }
    return poses, {key: images[key].locations[0] for key in poses}


def queries_of_kapture(
    images: Mapping[ImageKey, KaptureImage], version: int | None, test_list: Path, missing: Missing
) -> tuple[int, Queries]:
    """Return the version, detected if None, and the images of all but the reference condition.

    Rear images with a pose are version 2's training images. Without a test list, all other rear
    images are test images.
    """
    keys = sorted(
        (key for key in images if key.condition != REFERENCE_CONDITION),
        key=lambda key: (images[key].locations[0], key.timestamp, key.camera),
    )
    poses = {key: images[key].cam_from_world for key in keys if key.camera == SCORED_CAMERA}
    train = {key: pose for key, pose in poses.items() if pose is not None}
    version = version or (2 if train or test_list.is_file() else 1)
    test: dict[ImageKey, str] = {}
    unlisted = 0
    if version == 2 and test_list.is_file():
        at_time = {(key.camera, key.timestamp): key for key in keys}
        test, unlisted = known_queries(test_list, read_test_list(test_list), at_time, missing)
    elif version == 2:
        test = {key: f"{key.camera}/{key.stem}.png" for key in poses if key not in train}
    return version, Queries({key: images[key].locations for key in keys}, train, test, unlisted)
