"""Reader of COLMAP's sparse models, through pycolmap."""

from __future__ import annotations

import logging
import mmap
import re
import struct
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.colmap import load_pycolmap, quiet_stderr
from megloc_kapture.io.files import (
    TEMPORARY,
    check_relative,
    failed_download,
    named,
    read_text,
    reading,
)
from megloc_kapture.io.kapture.format import FLOAT_PATTERN
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.io.text_lines import numbers_of, read_camera_rows
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

_log = logging.getLogger(__name__)

TEXT_FILES = ("cameras.txt", "images.txt", "points3D.txt")
BINARY_FILES = ("cameras.bin", "images.bin", "points3D.bin")
IMAGE_COLUMNS = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
# an image size in cameras.txt, written as float by scripts: 1920.0 1080.0
_SIZE = re.compile(r"^(\s*\d+\s+\w+\s+\d+)\.0*(\s+\d+)\.0*(?=\s)", re.MULTILINE)
_NO_ID = 2**32 - 1  # COLMAP's value for a missing id
_RIG_FILES = ("rigs", "frames")  # since COLMAP 3.12
# models that kapture lacks: an equivalent with distortion, and the number of zeros to append
_SAME_AS = {"SIMPLE_FISHEYE": ("SIMPLE_RADIAL_FISHEYE", 1), "FISHEYE": ("OPENCV_FISHEYE", 4)}
# records of variable length: bytes before the item count, its type, bytes per item
_RECORDS = {
    "images.bin": (64, "<Q", 24),
    "points3D.bin": (43, "<Q", 8),
    "frames.bin": (64, "<I", 16),
}


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Points of a model and their observations.

    ``point_ids`` are ascending row numbers of ``xyz``, ``image_ids`` positions in the model's
    images. Not every feature of an image has an observation, and several may observe one point.
    ``xy_px`` has the first pixel's centre at (0.5, 0.5).
    """

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    point_ids: NDArray[np.int64]
    image_ids: NDArray[np.int32]
    feature_ids: NDArray[np.int32]
    xy_px: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.xyz)

    @classmethod
    def none(cls) -> SparsePoints:
        return cls.of_rows(np.empty((0, 6)), np.empty(0), np.empty((0, 4)))

    @classmethod
    def of_rows(
        cls, heads: NDArray[Any], lengths: NDArray[Any], observations: NDArray[Any]
    ) -> SparsePoints:
        """Build points from heads (X Y Z R G B), track lengths and rows of image, feature, x, y."""
        return cls(
            heads[:, :3].copy(),
            heads[:, 3:].astype(np.uint8),
            np.repeat(np.arange(len(heads), dtype=np.int64), lengths.astype(np.int64)),
            observations[:, 0].astype(np.int32),
            observations[:, 1].astype(np.int32),
            observations[:, 2:].astype(np.float32),
        )

    @classmethod
    def joined(cls, parts: Sequence[SparsePoints]) -> SparsePoints:
        """Concatenate the points of models that share one image list and numbering of features."""
        firsts = np.cumsum([0, *(len(part) for part in parts)])
        moved = [
            replace(part, point_ids=part.point_ids + first)
            for part, first in zip(parts, firsts[:-1], strict=True)
        ] or [cls.none()]
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, n) for part in moved]) for n in names))


@dataclass(frozen=True, slots=True)
class ColmapImage:
    image_id: int
    name: str
    camera_id: int
    cam_from_world: RigidTransform


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """One reconstruction, with images sorted by id.

    ``points.image_ids`` are positions in ``images``, not COLMAP's ids. The keys of
    ``cams_from_rig`` are rig ids, then camera ids; ``frames`` maps image ids to frame ids. A frame
    is the set of images that a rig takes at one time.
    """

    cameras: dict[int, Camera]
    images: tuple[ColmapImage, ...]
    points: SparsePoints
    cams_from_rig: Mapping[int, Mapping[int, RigidTransform]] = field(default_factory=dict)
    frames: Mapping[int, int] = field(default_factory=dict)


def colmap_model_files(folder: Path, *, with_points: bool = True) -> tuple[Path, ...]:
    """Return the files of a model, binary ones preferred; DataError if one is missing."""
    folder = Path(folder)
    names = next((n for n in (BINARY_FILES, TEXT_FILES) if (folder / n[1]).exists()), None)
    if names is None:
        raise DataError(
            f"no COLMAP model: neither {BINARY_FILES[1]} nor {TEXT_FILES[1]} is here", path=folder
        )
    paths = [folder / name for name in (names if with_points else names[:2])]
    for path in paths:
        reason = "; the points are read from it" if path.stem == "points3D" else ""
        remedy = " (add an empty one if it has no points)" if path.name == "points3D.txt" else ""
        require(path.is_file(), f"file is missing{reason}{remedy}", path=path)
    more = [folder / f"{name}{paths[0].suffix}" for name in _RIG_FILES]
    return (*paths, *(path for path in more if path.exists()))


def read_colmap_model(folder: Path, *, with_points: bool = True) -> ColmapModel:
    """Read the model of a folder; without points, their file need not exist.

    If tracks name images or features that the model lacks, all points are ignored with a warning.
    """
    paths = colmap_model_files(folder, with_points=with_points)
    for path in paths:
        if path.name != "points3D.txt" and (failed := failed_download(path)):
            raise DataError(failed, path=path)
        if path.name in _RECORDS:
            _check_complete(path)
    names: dict[int, str] = {}
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as links:
        for path in paths:
            link = Path(links) / path.name
            if path.name == TEXT_FILES[1]:
                text, names = _images_for_pycolmap(path, paths[0])
                link.write_text(text, encoding="utf-8")
            elif path.suffix == ".txt":
                text = read_text(path)  # without a byte order mark
                is_cameras = path.name == TEXT_FILES[0]
                link.write_text(_SIZE.sub(r"\1\2", text) if is_cameras else text, encoding="utf-8")
            else:
                link.symlink_to(path.resolve())
        if not with_points:
            no_points = bytes(8) if paths[0].suffix == ".bin" else b""
            (Path(links) / f"points3D{paths[0].suffix}").write_bytes(no_points)
        files = ", ".join(path.name for path in paths)
        with reading(folder, f"a model that COLMAP can read ({files})"), quiet_stderr():
            try:
                model = load_pycolmap().Reconstruction(links)
            except Exception as error:
                if names:
                    read_camera_rows(paths[0])  # names the line of a wrong camera
                if not with_points or not isinstance(error, IndexError):
                    raise
                model = None
    if model is None:
        message = "%s: ignored, as its tracks name images or features that %s lacks"
        _log.warning(message, paths[2], paths[1].name)
        return read_colmap_model(folder, with_points=False)
    cameras = {camera_id: _camera(camera, paths[0]) for camera_id, camera in model.cameras.items()}
    if paths[0].suffix == ".bin":
        size = 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
        if paths[0].stat().st_size != size:
            raise _incomplete(paths[0])
    images = _images(model, paths[1], names)
    return ColmapModel(
        cameras,
        images,
        _points(model, images),
        {rig_id: _cams_from_rig(rig) for rig_id, rig in sorted(model.rigs.items())},
        {image_id: image.frame_id for image_id, image in model.images.items()},
    )


def image_rows(text: str) -> Iterator[tuple[int, list[str], str]]:
    """Yield line number, :data:`IMAGE_COLUMNS` and features of each image of ``images.txt``.

    Names may have blanks. Tools that write only poses often omit the empty line of features.
    """
    lines = enumerate([*map(str.strip, text.split("\n")), ""], start=1)
    is_features = False
    for (number, line), (_, following) in pairwise(lines):
        if is_features or not line or line.startswith("#"):
            is_features = False
            continue
        is_features = not _is_image(following)
        yield number, line.split(maxsplit=9), following if is_features else ""


def _is_image(line: str) -> bool:
    """Return whether a line describes an image, not its features (triples of numbers)."""
    fields = line.split()
    return len(fields) >= 10 and (len(fields) % 3 != 0 or not FLOAT_PATTERN.fullmatch(fields[-1]))


def _images_for_pycolmap(path: Path, cameras: Path) -> tuple[str, dict[int, str]]:
    """Check ``images.txt``; return it with ids in place of names, and the names by id.

    pycolmap ends names at a blank and takes the next image for a missing line of features.
    """
    cameras_text = read_text(cameras).split("\n")
    camera_ids = {line.split(maxsplit=1)[0] for line in cameras_text if line.strip()}
    names: dict[int, str] = {}
    lines: list[str] = []
    for number, row, features in image_rows(read_text(path)):
        with named(path, number):
            require(len(row) == 10, f"{len(row)} columns instead of 10 ({IMAGE_COLUMNS})")
            image_id = int(numbers_of(row[:9], IMAGE_COLUMNS.removesuffix(" NAME"))[0])
            require(
                0 <= image_id < _NO_ID,
                f"image id {row[0]} is not from 0 to {_NO_ID - 1}; number the images instead",
            )
            require(image_id not in names, f"image id {image_id} is listed twice")
            require(row[8] in camera_ids, f"camera {row[8]} is not in {cameras.name}")
        names[image_id] = row[9]
        lines.append(f"{image_id} {' '.join(row[1:9])} {image_id}\n{features}\n")
    return "".join(lines), names


def _check_complete(path: Path) -> None:
    """Check a binary file's size: on a truncated one pycolmap 4 allocates memory without limit."""
    head, length_type, item = _RECORDS[path.name]
    length_size = struct.calcsize(length_type)
    try:
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            (count,), at = struct.unpack_from("<Q", data), 8
            for _ in range(count):
                at += head
                if path.name == BINARY_FILES[1]:
                    at = data.find(b"\0", at) + 1 or len(data)  # the image's name
                (length,) = struct.unpack_from(length_type, data, at)
                at += length_size + item * length
            if at != len(data):
                raise _incomplete(path)
    except (ValueError, struct.error, OverflowError) as error:
        raise _incomplete(path) from error


def _incomplete(path: Path) -> DataError:
    return DataError("the file is damaged or was cut short; copy it again", path=path)


def _camera(camera: Any, path: Path) -> Camera:
    model, params = camera.model.name, tuple(camera.params)
    if model in _SAME_AS:
        model, zeros = _SAME_AS[model]
        params += (0.0,) * zeros
    require(
        model in CAMERA_MODEL_NUM_PARAMS,
        f"kapture has no camera model {model}; `colmap image_undistorter` makes a model and "
        "images with PINHOLE cameras (for panoramas, COLMAP's panorama_sfm.py)",
        path=path,
    )
    with named(path, about=f"camera {camera.camera_id}"):
        return Camera(model, camera.width, camera.height, params)


def _images(model: Any, path: Path, names: Mapping[int, str]) -> tuple[ColmapImage, ...]:
    images: dict[str, ColmapImage] = {}
    for image_id, image in sorted(model.images.items()):
        if not image.has_pose:
            continue
        given = names.get(image_id, image.name)
        with named(path, about=f"image {given!r}"):
            name = check_relative(given.replace("\\", "/").removeprefix("./"))
            require(name not in images, "is listed twice")
            pose = _transform(image.cam_from_world())
        images[name] = ColmapImage(image_id, name, image.camera_id, pose)
    return tuple(images.values())


def _transform(transform: Any) -> RigidTransform:
    x, y, z, w = transform.rotation.quat.tolist()
    tx, ty, tz = transform.translation.tolist()
    require(np.isfinite([tx, ty, tz]).all(), "the pose is not finite")
    return RigidTransform(unit_quaternion((w, x, y, z)), (tx, ty, tz))


def _cams_from_rig(rig: Any) -> dict[int, RigidTransform]:
    camera_type = load_pycolmap().SensorType.CAMERA
    poses = {rig.ref_sensor_id: RigidTransform.identity()}
    poses |= {
        sensor: _transform(pose) for sensor, pose in rig.non_ref_sensors.items() if pose is not None
    }
    return {sensor.id: pose for sensor, pose in poses.items() if sensor.type == camera_type}


def _points(model: Any, images: Sequence[ColmapImage]) -> SparsePoints:
    positions = {image.image_id: position for position, image in enumerate(images)}
    heads, lengths, observations = [], [], []
    features = {image.image_id: model.images[image.image_id].points2D for image in images}
    for _, point in sorted(model.points3D.items()):
        track = [(element.image_id, element.point2D_idx) for element in point.track.elements]
        heads.append((*point.xyz, *point.color))
        lengths.append(len(track))
        observations += [
            (positions[image_id], index, *features[image_id][index].xy) for image_id, index in track
        ]
    return SparsePoints.of_rows(
        np.array(heads, np.float64).reshape(-1, 6),
        np.array(lengths, np.int64),
        np.array(observations, np.float64).reshape(-1, 4),
    )
