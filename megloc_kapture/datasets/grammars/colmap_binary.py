"""COLMAP's binary models: cameras.bin, images.bin and points3D.bin."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from megloc_kapture.datasets.grammars.binary_file import BinaryFile
from megloc_kapture.datasets.grammars.colmap_values import (
    CAMERA_MODELS,
    MAX_IMAGE_ID,
    NO_POINT,
    UNKNOWN_ERROR_PX,
    ColmapImage,
    ColmapModel,
    ImageTable,
    TrackedFeatures,
    check_writable,
    features_for_writing,
)
from megloc_kapture.datasets.grammars.fields import image_name
from megloc_kapture.datasets.grammars.sparse_points import SparsePoints
from megloc_kapture.datasets.grammars.track_rows import TrackArrays
from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import atomic_write
from megloc_kapture.io.kapture_sensors import unit_quaternion
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

CAMERAS, IMAGES, POINTS = "cameras.bin", "images.bin", "points3D.bin"
FILES = (CAMERAS, IMAGES, POINTS)
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3Bd")
_COUNT = struct.Struct("<Q")
_FEATURE = np.dtype([("xy", "<f8", (2,)), ("point", "<i8")])
_POINT_BYTES, _OBSERVATION_BYTES = _POINT.size + 8, 8
_SIZE_END = 2**31


def read_colmap_binary(folder: Path, *, with_points: bool = True) -> ColmapModel:
    """Read a binary model; see :func:`~megloc_kapture.datasets.grammars.colmap_model`.

    Raises
    ------
    DataError : a file is missing or broken; names the file and the byte.
    """
    cameras = _read_cameras(folder / CAMERAS)
    if not with_points:
        images = _read_images(folder / IMAGES, cameras, None)
        return ColmapModel(cameras, images, SparsePoints.none())
    features = TrackedFeatures(_read_points(folder / POINTS))
    images = _read_images(folder / IMAGES, cameras, features)
    features.resolve(images, folder / POINTS)
    return ColmapModel(cameras, images, features.points())


def _read_cameras(path: Path) -> dict[int, Camera]:
    cameras: dict[int, Camera] = {}
    with BinaryFile(path) as file:
        for _ in range(file.count("cameras", _CAMERA.size + 3 * 8)):
            start = file.position
            camera_id, model_id, width, height = file.unpack(_CAMERA, "a camera")
            if not 0 <= model_id < len(CAMERA_MODELS):
                raise file.error(f"unknown camera model {model_id}", start)
            model = CAMERA_MODELS[model_id]
            params = struct.Struct(f"<{CAMERA_MODEL_NUM_PARAMS[model]}d")
            values = file.unpack(params, "a camera")
            if camera_id in cameras:
                raise file.error(f"camera {camera_id} is listed twice", start)
            if max(width, height) >= _SIZE_END:
                raise file.error(f"image size {width}x{height} is out of range", start)
            try:
                cameras[camera_id] = Camera(model, width, height, values)
            except DataError as error:
                raise file.error(error.message, start) from None
        file.finish("the cameras")
    return cameras


def _read_images(
    path: Path, cameras: dict[int, Camera], features: TrackedFeatures | None
) -> tuple[ColmapImage, ...]:
    table = ImageTable(cameras)
    with BinaryFile(path) as file:
        for _ in range(file.count("images", _IMAGE.size + 1 + 8)):
            start = file.position
            try:
                image = _read_image(file)
                table.add(image)
                size = file.count("features", _FEATURE.itemsize) * _FEATURE.itemsize
                if features is None:
                    file.skip(size, "the features of an image")
                else:
                    content = file.take(size, "the features of an image")
                    features.place(image.image_id, np.frombuffer(content, _FEATURE)["xy"])
            except DataError as error:
                if error.path is not None:
                    raise
                raise file.error(error.message, start) from None
        file.finish("the images")
    return table.sorted()


def _read_image(file: BinaryFile) -> ColmapImage:
    image_id, w, x, y, z, tx, ty, tz, camera_id = file.unpack(_IMAGE, "an image")
    name = image_name(file.name("an image's name"))
    if image_id > MAX_IMAGE_ID:
        raise DataError(f"image id {image_id} is out of range")
    if not np.isfinite([tx, ty, tz]).all():
        raise DataError(f"the pose of image {name!r} is not finite")
    return ColmapImage(
        image_id, name, camera_id, RigidTransform(unit_quaternion((w, x, y, z)), (tx, ty, tz))
    )


def _read_points(path: Path) -> TrackArrays:
    from megloc_kapture.datasets.grammars import track_kernels as kernels

    with BinaryFile(path) as file:
        count = file.count("points", _POINT_BYTES)
        content = file.rest()
        done, end, num_observations = kernels.measure_binary_points(content, 0, count)
        file.position = _COUNT.size + int(end)
        if not done:
            raise file.error("the file ends within a point")
        file.finish("the points")
        xyz, rgb = np.empty((count, 3)), np.empty((count, 3), np.uint8)
        lengths = np.empty(count, np.int32)
        pairs = np.empty((int(num_observations), 2), np.int32)
        kernels.copy_binary_points(
            content, 0, xyz.view(np.uint8), rgb, lengths, pairs.view(np.uint8)
        )
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.all():
        row = int(np.flatnonzero(~finite)[0])
        raise DataError(f"point {row + 1} of {count} is not finite", path=path)
    if len(pairs) and pairs.min() < 0:
        raise DataError("a track names an image or a feature that is out of range", path=path)
    nowhere = np.empty((0, 2), np.float32)
    return TrackArrays(xyz, rgb, lengths, pairs[:, 0].copy(), pairs[:, 1].copy(), nowhere)


# ------------------------------------------------------------------------------------ writing


def write_colmap_binary(folder: Path, model: ColmapModel) -> None:
    """Write ``cameras.bin``, ``images.bin`` and ``points3D.bin``; points get the ids 1, 2, ...

    Raises
    ------
    ValueError : ids, names or tracks that a COLMAP model cannot hold.
    OutputError : cannot be written.
    """
    check_writable(model)
    points = model.points.sorted_by_point()
    with atomic_write(folder / CAMERAS) as file:
        file.write(_COUNT.pack(len(model.cameras)))
        for camera_id, camera in sorted(model.cameras.items()):
            model_id = CAMERA_MODELS.index(camera.model)
            file.write(_CAMERA.pack(camera_id, model_id, camera.width, camera.height))
            file.write(struct.pack(f"<{len(camera.params)}d", *camera.params))
    with atomic_write(folder / IMAGES) as file:
        file.write(_COUNT.pack(len(model.images)))
        for image, xy_px, seen in features_for_writing(model):
            pose = (*image.cam_from_world.quat_wxyz, *image.cam_from_world.translation)
            file.write(_IMAGE.pack(image.image_id, *pose, image.camera_id))
            file.write(image.name.encode() + b"\0" + _COUNT.pack(len(seen)))
            features = np.empty(len(seen), _FEATURE)
            features["xy"] = xy_px
            features["point"] = np.where(seen >= 0, seen + 1, NO_POINT)
            file.write(features.tobytes())
    ids = np.array([image.image_id for image in model.images], dtype="<i4")
    pairs = np.empty((len(points.image_ids), 2), "<i4")
    pairs[:, 0] = ids[points.image_ids] if len(ids) else 0
    pairs[:, 1] = points.feature_ids
    ends = np.searchsorted(points.point_ids, np.arange(len(points) + 1)).tolist()
    with atomic_write(folder / POINTS) as file:
        file.write(_COUNT.pack(len(points)))
        for row, (xyz, rgb) in enumerate(
            zip(points.xyz.tolist(), points.rgb.tolist(), strict=True)
        ):
            track = pairs[ends[row] : ends[row + 1]]
            file.write(_POINT.pack(row + 1, *xyz, *rgb, UNKNOWN_ERROR_PX))
            file.write(_COUNT.pack(len(track)) + track.tobytes())
