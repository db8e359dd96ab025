"""A COLMAP model in memory, and its files: text (``cameras.txt``, ...) and binary."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.sparse_points import SparsePoints, Tracks, image_order
from megloc_kapture.errors import DataError
from megloc_kapture.io.files import atomic_write
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

# the ids of camera models, as binary models and databases have them
CAMERA_MODELS: tuple[str, ...] = tuple(CAMERA_MODEL_NUM_PARAMS)
# the models that follow them since version 4, which kapture does not have; number of parameters
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

# records of the binary files, all little-endian
BINARY_COUNT = struct.Struct("<Q")
BINARY_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
BINARY_IMAGE = struct.Struct("<I7dI")  # id, quaternion, translation, camera
BINARY_FEATURE = np.dtype([("xy", "<f8", (2,)), ("point", "<i8")])
BINARY_POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", (3,)), ("rgb", "u1", (3,)), ("error", "<f8"), ("length", "<u8")]
)

_NO_POINT = -1
_UNKNOWN_ERROR_PX = -1.0


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
    """Name and number of parameters of a camera model.

    Raises
    ------
    DataError : no model has this number; does not name the file.
    """
    counts = {**CAMERA_MODEL_NUM_PARAMS, **_LATER_MODELS}
    if not 0 <= model_id < len(counts):
        raise DataError(f"unknown camera model {model_id}")
    name = tuple(counts)[model_id]
    return name, counts[name]


def camera_of(model: str, width: int, height: int, params: Sequence[float]) -> Camera:
    """The camera of a model of COLMAP's, in one that kapture has.

    Raises
    ------
    DataError : kapture has none, or see :class:`Camera`; does not name the file.
    """
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
    tracks : as a points' file has them, with COLMAP's ids of the images; None: not read.
    """

    def __init__(self, cameras: dict[int, Camera], tracks: Tracks | None) -> None:
        self.cameras = cameras
        self.tracks = tracks
        self._images: dict[int, ColmapImage] = {}
        self._names: set[str] = set()
        # the observations of each image, found once
        image_ids = np.empty(0, np.int32) if tracks is None else tracks.image_ids
        self._order = image_order(image_ids)
        ids, starts = np.unique(image_ids[self._order], return_index=True)
        rows = np.split(self._order, starts[1:]) if len(ids) else []
        self._rows = dict(zip(ids.tolist(), rows, strict=True))
        self._xy_px = np.zeros((len(image_ids), 2), np.float32)

    def add(self, image: ColmapImage) -> None:
        """Take one more image.

        Raises
        ------
        DataError : its id or name is taken, or its camera unknown; does not name the file.
        """
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
        """Take what tracks need of all features (M, 2) of an image.

        Raises
        ------
        DataError : a track names a feature that the image does not have, or that is not finite;
            does not name the file.
        """
        if self.tracks is None or image_id not in self._rows:
            return
        rows = self._rows[image_id]
        ids = self.tracks.feature_ids[rows]
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
        """The model of all images, sorted by their ids.

        Raises
        ------
        DataError : a track names an image that there is not; names ``points_file``.
        """
        images = tuple(image for _, image in sorted(self._images.items()))
        if self.tracks is None:
            return ColmapModel(self.cameras, images, SparsePoints.none())
        known = {image.image_id: position for position, image in enumerate(images)}
        positions = np.zeros(len(self._order), np.int32)
        for image_id, rows in self._rows.items():
            if image_id not in known:
                raise DataError(
                    f"a track names image {image_id}, which is not there", path=points_file
                )
            positions[rows] = known[image_id]
        return ColmapModel(self.cameras, images, self.tracks.points(positions, self._xy_px))


def write_colmap_text(folder: Path, model: ColmapModel) -> None:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt``; points get the ids 1, 2, ...

    Numbers are the shortest texts that read back the same.

    Raises
    ------
    ValueError : ids, names or tracks that a COLMAP model cannot hold.
    OutputError : cannot be written.
    """
    _check_writable(model)
    points = model.points.sorted_by_point()
    with atomic_write(folder / TEXT_FILES[0]) as file:
        file.write(b"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n")
        for camera_id, camera in sorted(model.cameras.items()):
            params = " ".join(map(repr, camera.params))
            row = f"{camera_id} {camera.model} {camera.width} {camera.height} {params}\n"
            file.write(row.encode())
    with atomic_write(folder / TEXT_FILES[1]) as file:
        file.write(
            b"# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# POINTS2D[] as X Y POINT3D_ID\n"
        )
        for image, xy_px, seen in _features(model):
            pose = (*image.cam_from_world.quat_wxyz, *image.cam_from_world.translation)
            numbers = " ".join(repr(float(value)) for value in pose)
            features = " ".join(
                f"{x} {y} {point + 1 if point >= 0 else -1}"
                for (x, y), point in zip(xy_px.astype(str).tolist(), seen.tolist(), strict=True)
            )
            row = f"{image.image_id} {numbers} {image.camera_id} {image.name}\n{features}\n"
            file.write(row.encode())
    ids = np.array([image.image_id for image in model.images], dtype=np.int64)
    image_ids = ids[points.image_ids].tolist() if len(ids) else []
    ends = np.searchsorted(points.point_ids, np.arange(len(points) + 1)).tolist()
    elements = [
        f" {image_id} {feature}"
        for image_id, feature in zip(image_ids, points.feature_ids.tolist(), strict=True)
    ]
    with atomic_write(folder / TEXT_FILES[2]) as file:
        file.write(b"# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX\n")
        for row_number, (xyz, rgb) in enumerate(
            zip(points.xyz.tolist(), points.rgb.tolist(), strict=True)
        ):
            numbers = " ".join([*map(repr, xyz), *map(str, rgb), repr(_UNKNOWN_ERROR_PX)])
            track = "".join(elements[ends[row_number] : ends[row_number + 1]])
            file.write(f"{row_number + 1} {numbers}{track}\n".encode())


def write_colmap_binary(folder: Path, model: ColmapModel) -> None:
    """Write ``cameras.bin``, ``images.bin`` and ``points3D.bin``; points get the ids 1, 2, ...

    Raises
    ------
    ValueError : ids, names or tracks that a COLMAP model cannot hold.
    OutputError : cannot be written.
    """
    _check_writable(model)
    points = model.points.sorted_by_point()
    with atomic_write(folder / BINARY_FILES[0]) as file:
        file.write(BINARY_COUNT.pack(len(model.cameras)))
        for camera_id, camera in sorted(model.cameras.items()):
            model_id = CAMERA_MODELS.index(camera.model)
            file.write(BINARY_CAMERA.pack(camera_id, model_id, camera.width, camera.height))
            file.write(struct.pack(f"<{len(camera.params)}d", *camera.params))
    with atomic_write(folder / BINARY_FILES[1]) as file:
        file.write(BINARY_COUNT.pack(len(model.images)))
        for image, xy_px, seen in _features(model):
            pose = (*image.cam_from_world.quat_wxyz, *image.cam_from_world.translation)
            file.write(BINARY_IMAGE.pack(image.image_id, *pose, image.camera_id))
            file.write(image.name.encode() + b"\0" + BINARY_COUNT.pack(len(seen)))
            features = np.empty(len(seen), BINARY_FEATURE)
            features["xy"] = xy_px
            features["point"] = np.where(seen >= 0, seen + 1, _NO_POINT)
            file.write(features.tobytes())
    ids = np.array([image.image_id for image in model.images], dtype="<i4")
    pairs = np.empty((len(points.image_ids), 2), "<i4")
    pairs[:, 0] = ids[points.image_ids] if len(ids) else 0
    pairs[:, 1] = points.feature_ids
    ends = np.searchsorted(points.point_ids, np.arange(len(points) + 1)).tolist()
    heads = np.empty(len(points), BINARY_POINT)
    heads["id"] = np.arange(1, len(points) + 1)
    heads["xyz"], heads["rgb"], heads["error"] = points.xyz, points.rgb, _UNKNOWN_ERROR_PX
    heads["length"] = np.diff(ends)
    with atomic_write(folder / BINARY_FILES[2]) as file:
        file.write(BINARY_COUNT.pack(len(points)))
        for row, head in enumerate(heads):
            file.write(head.tobytes() + pairs[ends[row] : ends[row + 1]].tobytes())


def _features(
    model: ColmapModel,
) -> Iterator[tuple[ColmapImage, NDArray[np.float32], NDArray[np.int64]]]:
    """Each image with the features a file lists: where (M, 2), and the row of the point or -1.

    Features that the model does not know, because no point needs them, stand at (0, 0): their
    rows keep the others' indices.

    Raises
    ------
    ValueError : a feature sees two points, which no COLMAP model can say.
    """
    points = model.points
    points.check_images(len(model.images))
    order = image_order(points.image_ids)
    ends = np.searchsorted(points.image_ids[order], np.arange(len(model.images) + 1)).tolist()
    for position, image in enumerate(model.images):
        rows = order[ends[position] : ends[position + 1]]
        ids = points.feature_ids[rows]
        if len(np.unique(ids)) != len(ids) or (len(ids) and ids.min() < 0):
            raise ValueError(f"a feature of image {image.name!r} is negative or in two tracks")
        size = int(ids.max()) + 1 if len(ids) else 0
        xy_px = np.zeros((size, 2), np.float32)
        seen = np.full(size, _NO_POINT, np.int64)
        xy_px[ids] = points.xy_px[rows]
        seen[ids] = points.point_ids[rows]
        yield image, xy_px, seen


def _check_writable(model: ColmapModel) -> None:
    """Raise ValueError where ids or names are not fit for a model's files."""
    ids = [image.image_id for image in model.images]
    if len(set(ids)) != len(ids) or not all(0 <= i <= MAX_IMAGE_ID for i in ids):
        raise ValueError("image ids are out of range or not unique")
    for image in model.images:
        if image.camera_id not in model.cameras:
            raise ValueError(f"image {image.name!r} has the unknown camera {image.camera_id}")
        if not image.name or image.name.split() != [image.name] or "\0" in image.name:
            raise ValueError(f"image name {image.name!r} has blanks, as COLMAP cannot read it")
