"""A COLMAP model in memory, and the reader of its binary files (``cameras.bin``, ...).

The reader is our own, as pycolmap's does not come back from damaged files.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.sparse_models import SparsePoints, image_order
from megloc_kapture.datasets.formats.text_lines import check_plain, image_name
from megloc_kapture.errors import DataError
from megloc_kapture.io.files import reading
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

# the models that follow kapture's since version 4; number of parameters
_LATER_MODELS = {
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}
# of those, the models that are others without distortion
_SAME_AS = {"SIMPLE_FISHEYE": "SIMPLE_RADIAL_FISHEYE", "FISHEYE": "OPENCV_FISHEYE"}
# COLMAP's own limit; its databases pack two ids into one number
MAX_IMAGE_ID = 2**31 - 2
MAX_SIZE = 2**31 - 1  # of images, in px
TEXT_FILES = ("cameras.txt", "images.txt", "points3D.txt")
BINARY_FILES = ("cameras.bin", "images.bin", "points3D.bin")

# rows of the binary files
BINARY_FEATURE = np.dtype([("xy", "<f8", (2,)), ("point", "<i8")])
BINARY_POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", (3,)), ("rgb", "u1", (3,)), ("error", "<f8"), ("length", "<u8")]
)
_MAX_NAME_BYTES = 4096


@dataclass(frozen=True, slots=True)
class ColmapImage:
    """One registered image of a model."""

    image_id: int
    name: str
    camera_id: int
    cam_from_world: RigidTransform


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """Cameras, images and points of one reconstruction.

    Parameters
    ----------
    cameras : by camera id; images may share one.
    images : those a reader returns are sorted by ``image_id``, and their names differ.
    points : ``image_ids`` are positions in ``images``, not COLMAP's ids.
    """

    cameras: dict[int, Camera]
    images: tuple[ColmapImage, ...]
    points: SparsePoints


def model_of_id(model_id: int) -> tuple[str, int]:
    """Name and number of parameters of a camera model; DataError where none has this number."""
    counts = {**CAMERA_MODEL_NUM_PARAMS, **_LATER_MODELS}
    if not 0 <= model_id < len(counts):
        raise DataError(f"unknown camera model {model_id}")
    name = tuple(counts)[model_id]
    return name, counts[name]


def camera_of(model: str, width: int, height: int, params: Sequence[float]) -> Camera:
    """The camera in a model that kapture has; DataError, without a file, where it has none."""
    if len(params) == _LATER_MODELS.get(model) and model in _SAME_AS:
        same = _SAME_AS[model]
        more = (0.0,) * (CAMERA_MODEL_NUM_PARAMS[same] - len(params))
        return Camera(same, width, height, (*params, *more))
    if model == "EQUIRECTANGULAR":
        raise DataError(
            f"cameras of the model {model} are no kapture cameras; cut the panoramas into "
            "perspective images (COLMAP's panorama_sfm.py does) and make the model of these"
        )
    if model in _LATER_MODELS and model not in _SAME_AS:
        raise DataError(
            f"cameras of the model {model} are no kapture cameras; `colmap image_undistorter` "
            "makes a model and images with PINHOLE cameras"
        )
    return Camera(model, width, height, tuple(params))


class ImageTable:
    """Images as a reader meets them, checked against cameras, each other and tracks.

    Parameters
    ----------
    points : as their file has them, with COLMAP's ids of the images; None: not read.
    """

    def __init__(self, cameras: dict[int, Camera], points: SparsePoints | None) -> None:
        self.cameras = cameras
        self.points = points
        self._images: dict[int, ColmapImage] = {}
        self._names: set[str] = set()
        # the observations of each image, found once
        image_ids = np.empty(0, np.int32) if points is None else points.image_ids
        self._order = image_order(image_ids)
        ids, starts = np.unique(image_ids[self._order], return_index=True)
        rows = np.split(self._order, starts[1:]) if len(ids) else []
        self._rows = dict(zip(ids.tolist(), rows, strict=True))
        self._xy_px = np.zeros((len(image_ids), 2), np.float32)

    def add(self, image: ColmapImage) -> None:
        """Take one more image; DataError where id or name are taken, or its camera is unknown."""
        if image.image_id in self._images:
            raise DataError(f"image id {image.image_id} is listed twice")
        if image.name in self._names:
            raise DataError(f"image {image.name!r} is listed twice")
        if image.camera_id not in self.cameras:
            raise DataError(
                f"image {image.name!r} was taken by the unknown camera {image.camera_id}"
            )
        self._images[image.image_id] = image
        self._names.add(image.name)

    def add_features(self, image_id: int, features_px: NDArray[np.floating[Any]]) -> None:
        """Take what tracks need of all features (M, 2) of an image; DataError where it is none."""
        if self.points is None or image_id not in self._rows:
            return
        rows = self._rows[image_id]
        ids = self.points.feature_ids[rows]
        last = int(ids.max())
        if last >= len(features_px):
            raise DataError(
                f"a track names feature {last} of image {image_id}, which has {len(features_px)}"
            )
        with np.errstate(over="ignore"):
            found = features_px[ids].astype(np.float32)
        if not np.isfinite(found).all():
            raise DataError(f"a feature of image {image_id} is not finite")
        self._xy_px[rows] = found

    def model(self, points_file: Path) -> ColmapModel:
        """The model of all images, sorted by their ids; DataError where a track needs more."""
        images = tuple(image for _, image in sorted(self._images.items()))
        if self.points is None:
            return ColmapModel(self.cameras, images, SparsePoints.none())
        known = {image.image_id: position for position, image in enumerate(images)}
        positions = np.zeros(len(self._order), np.int32)
        for image_id, rows in self._rows.items():
            if image_id not in known:
                raise DataError(
                    f"a track names image {image_id}, which is not there", path=points_file
                )
            positions[rows] = known[image_id]
        return ColmapModel(
            self.cameras, images, replace(self.points, image_ids=positions, xy_px=self._xy_px)
        )


# ---------------------------------------------------------------------------------- binary


class BinaryFile(AbstractContextManager["BinaryFile"]):
    """A little-endian file; every count is compared with the size before memory is taken."""

    def __init__(self, path: Path) -> None:
        self.path = path
        check_plain(path)
        with reading(path):
            self._file = open(path, "rb", buffering=1 << 20)  # noqa: SIM115
        self.size = os.fstat(self._file.fileno()).st_size
        self.position = 0

    def __exit__(self, *raised: object) -> None:
        self._file.close()

    def error(self, message: str, position: int) -> DataError:
        """The error for what stands at a position."""
        return DataError(f"{message} (byte {position} of {self.size})", path=self.path)

    @contextmanager
    def named(self, start: int) -> Iterator[None]:
        """Let DataErrors that name no file name this one and what begins at ``start``."""
        try:
            yield
        except DataError as error:
            raise (error if error.path else self.error(error.message, start)) from None

    def take(self, num_bytes: int, what: str) -> bytes:
        """The next bytes; DataError where the file ends before."""
        start = self.position
        self.skip(num_bytes, what)
        with reading(self.path):
            self._file.seek(start)
            content = self._file.read(num_bytes)
        if len(content) != num_bytes:  # it has become shorter
            raise self.error(f"the file ends within {what}", start)
        return content

    def skip(self, num_bytes: int, what: str) -> None:
        """Pass over the next bytes; DataError where the file ends before."""
        if num_bytes > self.size - self.position:
            raise self.error(f"the file ends within {what}", self.position)
        self.position += num_bytes

    def unpack(self, record: str, what: str) -> tuple[Any, ...]:
        """The values of the next record, in the letters of :mod:`struct`."""
        return struct.unpack(f"<{record}", self.take(struct.calcsize(f"<{record}"), what))

    def count(self, what: str, item_bytes: int) -> int:
        """The next uint64, a number of things that take ``item_bytes`` or more each."""
        start = self.position
        (number,) = self.unpack("Q", f"the number of {what}")
        if number * item_bytes > self.size - self.position:
            raise self.error(f"{number} {what} do not fit into the file", start)
        return int(number)

    def name(self, what: str) -> str:
        """The next bytes up to a NUL, which is taken too; DataError without one soon."""
        start = self.position
        content = self.take(min(_MAX_NAME_BYTES + 1, self.size - start), what)
        end = content.find(b"\0")
        if end < 0:
            raise self.error(f"{what} does not end", start)
        self.position = start + end + 1
        return content[:end].decode("utf-8", errors="surrogateescape")

    def finish(self, what: str) -> None:
        """Raise DataError where bytes follow after all that was to come."""
        if self.position != self.size:
            left = self.size - self.position
            raise self.error(f"{left} bytes follow after the last of {what}", self.position)


def read_binary_cameras(path: Path) -> dict[int, Camera]:
    """Cameras by id; DataError names the file and the byte."""
    cameras: dict[int, Camera] = {}
    with BinaryFile(path) as file:
        for _ in range(file.count("cameras", 40)):
            start = file.position
            with file.named(start):
                camera_id, model_id, width, height = file.unpack("IiQQ", "a camera")
                model, num_params = model_of_id(model_id)
                values = file.unpack(f"{num_params}d", "a camera")
                if camera_id in cameras:
                    raise DataError(f"camera {camera_id} is listed twice")
                if max(width, height) > MAX_SIZE:
                    raise DataError(f"image size {width}x{height} is out of range")
                cameras[camera_id] = camera_of(model, width, height, values)
        file.finish("the cameras")
    return cameras


def add_binary_images(path: Path, images: ImageTable) -> None:
    """Add the images and what tracks need of their features; DataError names file and byte."""
    with BinaryFile(path) as file:
        for _ in range(file.count("images", 73)):
            with file.named(file.position):
                image = _read_image(file)
                images.add(image)
                size = file.count("features", BINARY_FEATURE.itemsize) * BINARY_FEATURE.itemsize
                if images.points is None:
                    file.skip(size, "the features of an image")
                else:
                    content = file.take(size, "the features of an image")
                    features = np.frombuffer(content, BINARY_FEATURE)["xy"]
                    images.add_features(image.image_id, features)
        file.finish("the images")


def _read_image(file: BinaryFile) -> ColmapImage:
    image_id, *pose, camera_id = file.unpack("I7dI", "an image")
    name = image_name(file.name("an image's name"))
    if image_id > MAX_IMAGE_ID:
        raise DataError(f"image id {image_id} is out of range")
    return ColmapImage(image_id, name, camera_id, finite_pose(pose, f"image {name!r}"))


def finite_pose(values: Sequence[float], what: str) -> RigidTransform:
    """The transform of qw qx qy qz tx ty tz; DataError where they are none."""
    w, x, y, z, tx, ty, tz = values
    if not np.isfinite([tx, ty, tz]).all():
        raise DataError(f"the pose of {what} is not finite")
    return RigidTransform(unit_quaternion((w, x, y, z)), (tx, ty, tz))


def read_binary_points(path: Path) -> SparsePoints:
    """Points, with COLMAP's ids of images; DataError names the file and byte or point."""
    with BinaryFile(path) as file:
        head = BINARY_POINT.itemsize
        count = file.count("points", head)
        begin = file.position
        content = file.take(file.size - begin, "the points")
        starts = np.empty(count, np.int64)
        end = 0
        for row in range(count):
            starts[row] = end
            length = int.from_bytes(content[end + head - 8 : end + head], "little")
            end += head + 8 * length
            if end > len(content):
                raise file.error("the file ends within a point", begin + int(starts[row]))
        file.position = begin + end
        file.finish("the points")
    data = np.frombuffer(content, np.uint8)
    # byte by byte of the heads, as an index of all of them would take eight times the file
    head_bytes = np.empty((count, head), np.uint8)
    is_track = np.ones(len(data), np.bool_)
    for offset in range(head):
        head_bytes[:, offset] = data[starts + offset]
        is_track[starts + offset] = False
    heads = head_bytes.view(BINARY_POINT)[:, 0]
    track = data[is_track].view("<i4").reshape(-1, 2)
    finite = np.isfinite(heads["xyz"]).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise DataError(f"point {row + 1} of {count} is not finite", path=path)
    if len(track) and track.min() < 0:
        raise DataError("a track names an image or a feature that is out of range", path=path)
    return SparsePoints.of_rows(
        np.concatenate([heads["xyz"], heads["rgb"]], axis=1), heads["length"], track
    )
