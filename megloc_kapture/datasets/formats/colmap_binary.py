"""Reader of COLMAP's binary models: ``cameras.bin``, ``images.bin``, ``points3D.bin``.

It is our own, as pycolmap's does not come back from damaged files.
"""

from __future__ import annotations

import os
import struct
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from megloc_kapture.datasets.formats.colmap_model import (
    BINARY_CAMERA,
    BINARY_COUNT,
    BINARY_FEATURE,
    BINARY_IMAGE,
    BINARY_POINT,
    MAX_IMAGE_ID,
    MAX_SIZE,
    ColmapImage,
    ImageTable,
    camera_of,
    model_of_id,
)
from megloc_kapture.datasets.formats.sparse_points import Tracks
from megloc_kapture.datasets.formats.text_lines import check_plain, image_name
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.values import Camera, RigidTransform

_MAX_NAME_BYTES = 4096


class BinaryFile(AbstractContextManager["BinaryFile"]):
    """A little-endian file; every count is compared with the size before memory is taken."""

    def __init__(self, path: Path) -> None:
        self.path = path
        check_plain(path)
        try:
            self._file = open(path, "rb", buffering=1 << 20)  # noqa: SIM115
        except OSError as error:
            raise DataError(f"cannot read: {error.strerror}", path=path) from error
        self.size = os.fstat(self._file.fileno()).st_size
        self.position = 0

    def __exit__(self, *raised: object) -> None:
        self._file.close()

    def error(self, message: str, position: int) -> DataError:
        """The error for what stands at a position."""
        return DataError(f"{message} (byte {position} of {self.size})", path=self.path)

    def take(self, num_bytes: int, what: str) -> bytes:
        """The next bytes; DataError where the file ends before."""
        start = self.position
        self.skip(num_bytes, what)
        try:
            self._file.seek(start)
            content = self._file.read(num_bytes)
        except OSError as error:
            raise DataError(f"cannot read: {error.strerror}", path=self.path) from error
        if len(content) != num_bytes:  # it has become shorter
            raise self.error(f"the file ends within {what}", start)
        return content

    def skip(self, num_bytes: int, what: str) -> None:
        """Pass over the next bytes; DataError where the file ends before."""
        if num_bytes > self.size - self.position:
            raise self.error(f"the file ends within {what}", self.position)
        self.position += num_bytes

    def unpack(self, record: struct.Struct, what: str) -> tuple[Any, ...]:
        """The values of the next record."""
        return record.unpack(self.take(record.size, what))

    def count(self, what: str, item_bytes: int) -> int:
        """The next uint64, a number of things that take at least ``item_bytes`` each.

        Raises
        ------
        DataError : the rest of the file cannot hold that many.
        """
        start = self.position
        (number,) = self.unpack(BINARY_COUNT, f"the number of {what}")
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
        for _ in range(file.count("cameras", BINARY_CAMERA.size + 2 * 8)):
            start = file.position
            camera_id, model_id, width, height = file.unpack(BINARY_CAMERA, "a camera")
            try:
                model, num_params = model_of_id(model_id)
            except DataError as error:
                raise file.error(error.message, start) from None
            values = file.unpack(struct.Struct(f"<{num_params}d"), "a camera")
            if camera_id in cameras:
                raise file.error(f"camera {camera_id} is listed twice", start)
            if max(width, height) > MAX_SIZE:
                raise file.error(f"image size {width}x{height} is out of range", start)
            try:
                cameras[camera_id] = camera_of(model, width, height, values)
            except DataError as error:
                raise file.error(error.message, start) from None
        file.finish("the cameras")
    return cameras


def add_binary_images(path: Path, images: ImageTable) -> None:
    """Add the images and what tracks need of their features; DataError names file and byte."""
    with BinaryFile(path) as file:
        for _ in range(file.count("images", BINARY_IMAGE.size + 1 + BINARY_COUNT.size)):
            start = file.position
            try:
                image = _read_image(file)
                images.add(image)
                size = file.count("features", BINARY_FEATURE.itemsize) * BINARY_FEATURE.itemsize
                if images.tracks is None:
                    file.skip(size, "the features of an image")
                else:
                    content = file.take(size, "the features of an image")
                    features = np.frombuffer(content, BINARY_FEATURE)["xy"]
                    images.add_features(image.image_id, features)
            except DataError as error:
                if error.path is not None:
                    raise
                raise file.error(error.message, start) from None
        file.finish("the images")


def _read_image(file: BinaryFile) -> ColmapImage:
    image_id, w, x, y, z, tx, ty, tz, camera_id = file.unpack(BINARY_IMAGE, "an image")
    name = image_name(file.name("an image's name"))
    if image_id > MAX_IMAGE_ID:
        raise DataError(f"image id {image_id} is out of range")
    if not np.isfinite([tx, ty, tz]).all():
        raise DataError(f"the pose of image {name!r} is not finite")
    pose = RigidTransform(unit_quaternion((w, x, y, z)), (tx, ty, tz))
    return ColmapImage(image_id, name, camera_id, pose)


def read_binary_points(path: Path) -> Tracks:
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
    return Tracks(
        np.ascontiguousarray(heads["xyz"]),
        np.ascontiguousarray(heads["rgb"]),
        heads["length"].astype(np.int32),
        track[:, 0].astype(np.int32),
        track[:, 1].astype(np.int32),
        np.zeros((len(track), 2), np.float32),
    )
