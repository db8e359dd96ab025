"""Readers of COLMAP's sparse models: cameras, images, points3D; since version 4 rigs and frames.

Of a folder the binary files count where there are any; here are the readers of text. In
``images.txt`` an image has two lines, of which the second, its features, may be empty. A frame is
what the cameras of a rig took at one time; its pose is left alone, for the images have it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.colmap_model import (
    BINARY_FILES,
    MAX_IMAGE_ID,
    MAX_SIZE,
    TEXT_FILES,
    BinaryFile,
    ColmapImage,
    ColmapModel,
    ImageTable,
    add_binary_images,
    camera_of,
    finite_pose,
    read_binary_cameras,
    read_binary_points,
)
from megloc_kapture.datasets.formats.sparse_models import (
    MAX_FEATURE_ID,
    PIXEL_END,
    SparsePoints,
    are_counts,
    check_pixel,
    read_points,
)
from megloc_kapture.datasets.formats.text_lines import (
    Block,
    Line,
    NumberRows,
    TextFile,
    read_lines,
)
from megloc_kapture.errors import DataError
from megloc_kapture.values import Camera, RigidTransform

_ID_END = 2**32 - 1
_ALL_ROWS = 1 << 62
_HEAD = 8  # numbers of a point's line before its track


def colmap_model_files(folder: Path, *, with_points: bool = True) -> tuple[Path, ...]:
    """The files of a folder that hold its model; DataError where it holds none."""
    names = BINARY_FILES if is_binary(folder) else TEXT_FILES
    return tuple(Path(folder) / name for name in (names if with_points else names[:2]))


def read_colmap_model(folder: Path, *, with_points: bool = True) -> ColmapModel:
    """Read the model of a folder; the binary files count where there are both.

    Parameters
    ----------
    with_points : False reads cameras and poses only; the points' file need not exist.

    Raises
    ------
    DataError : no model, or a broken one; names the file and the line or byte.
    """
    binary = is_binary(folder)
    cameras_file, images_file, points_file = (
        Path(folder) / name for name in (BINARY_FILES if binary else TEXT_FILES)
    )
    cameras = read_binary_cameras(cameras_file) if binary else _text_cameras(cameras_file)
    points = None
    if with_points:
        points = read_binary_points(points_file) if binary else _text_points(points_file)
    images = ImageTable(cameras, points)
    (add_binary_images if binary else _add_text_images)(images_file, images)
    return images.model(points_file)


def is_binary(folder: Path) -> bool:
    """Whether the binary files of a folder count; raises DataError where it holds no model."""
    if (Path(folder) / BINARY_FILES[1]).exists():
        return True
    if (Path(folder) / TEXT_FILES[1]).exists():
        return False
    raise DataError(
        f"no COLMAP model: neither {BINARY_FILES[1]} nor {TEXT_FILES[1]} is here", path=folder
    )


# ------------------------------------------------------------------------------------ text


def _text_cameras(path: Path) -> dict[int, Camera]:
    cameras: dict[int, Camera] = {}
    for line in read_lines(path, comments=True):
        fields = line.fields
        if len(fields) < 5:
            raise line.error(
                f"expected a camera (CAMERA_ID MODEL WIDTH HEIGHT PARAMS), got {len(fields)} fields"
            )
        camera_id = line.count_of(fields[0], "camera id", _ID_END)
        if camera_id in cameras:
            raise line.error(f"camera {camera_id} is listed twice")
        width = line.count_of(fields[2], "width", MAX_SIZE + 1)
        height = line.count_of(fields[3], "height", MAX_SIZE + 1)
        params = line.numbers_of(fields[4:], "camera parameter")
        with line.named():
            cameras[camera_id] = camera_of(fields[1], width, height, params)
    return cameras


def _add_text_images(path: Path, images: ImageTable) -> None:
    with TextFile(path) as file:
        while (line := file.row(comments=True)) is not None:
            image = _parse_image(line)
            with line.named():
                images.add(image)
            # the last one may be missing: then it is empty
            features = file.line() or Line(path, line.number, "")
            if images.points is not None:
                with features.named():
                    images.add_features(image.image_id, _parse_features(features))


def _parse_image(line: Line) -> ColmapImage:
    fields = line.fields
    if len(fields) < 10:
        raise line.error(
            "expected an image (IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME), "
            f"got {len(fields)} fields"
        )
    pose = line.pose_of(fields[1:8])
    return ColmapImage(
        line.count_of(fields[0], "image id", MAX_IMAGE_ID + 1),
        # a name may have blanks in it
        line.name_of(line.rest(9)),
        line.count_of(fields[8], "camera id", _ID_END),
        pose,
    )


def _parse_features(line: Line) -> NDArray[np.float64]:
    """Positions of the features of an image, (M, 2)."""
    content = line.text.encode(errors="surrogateescape") + b"\n"
    rows = Block(line.path, line.number, content).numbers()
    if rows is not None and (rows.lengths % 3 == 0).all():
        features = rows.tails(0).reshape(-1, 3)
        if (np.abs(features[:, :2]) < PIXEL_END).all() and are_counts(features[:, 2] + 1, 2**62):
            return features[:, :2]
    fields = line.fields
    if len(fields) % 3:
        raise line.error(
            "expected features (X Y POINT3D_ID, repeated) or a blank line, "
            f"got {len(fields)} fields"
        )
    for start in range(0, len(fields), 3):
        check_pixel(line, fields[start : start + 2])
        if fields[start + 2] != "-1":
            line.count_of(fields[start + 2], "point id")
    raise line.error("not made of features")


def _text_points(path: Path) -> SparsePoints:
    with TextFile(path) as file:
        return read_points(_blocks(file), _parse_points, _check_point)


def _blocks(file: TextFile) -> Iterator[Block]:
    while (block := file.block(_ALL_ROWS)) is not None:
        yield block.without_comments()


def _parse_points(rows: NumberRows) -> SparsePoints | None:
    """The points of rows of numbers; None where one is no point."""
    if (rows.lengths < _HEAD).any() or (rows.lengths % 2).any():
        return None
    heads, track = rows.heads(_HEAD), rows.tails(_HEAD).reshape(-1, 2)
    good = (
        are_counts(heads[:, 0], 2**62)
        and are_counts(heads[:, 4:7], 256)
        and are_counts(track[:, 0], MAX_IMAGE_ID + 1)
        and are_counts(track[:, 1], MAX_FEATURE_ID + 1)
    )
    lengths = (rows.lengths - _HEAD) // 2
    return SparsePoints.of_rows(heads[:, 1:7], lengths, track) if good else None


def _check_point(line: Line) -> None:
    fields = line.fields
    if len(fields) < _HEAD or len(fields) % 2:
        raise line.error(
            "expected a point (POINT3D_ID X Y Z R G B ERROR and pairs of IMAGE_ID POINT2D_IDX), "
            f"got {len(fields)} fields"
        )
    line.count_of(fields[0], "point id")
    line.numbers_of(fields[1:4], "coordinate")
    line.colour_of(fields[4:7])
    line.number_of(fields[7], "reprojection error")
    for start in range(_HEAD, len(fields), 2):
        line.count_of(fields[start], "image id", MAX_IMAGE_ID + 1)
        line.count_of(fields[start + 1], "feature index", MAX_FEATURE_ID + 1)


# ------------------------------------------------------------------------- rigs and frames


_CAMERA = "CAMERA"
# sensor types by number; what is none of these is no camera either
_SENSOR_TYPES = {0: _CAMERA, 1: "IMU"}
_RIG = "a rig (RIG_ID NUM_SENSORS, then sensors)"
_FRAME = "a frame (FRAME_ID RIG_ID POSE NUM_DATA_IDS, then data)"


@dataclass
class ColmapRigs:
    """The rigs of a model, and which of their frames an image belongs to.

    Attributes
    ----------
    cams_from_rig : rig id -> camera id -> ``cam_from_rig``; cameras without a known one, and
        sensors that are none, are left out.
    frames : image id -> id of its frame.
    """

    cams_from_rig: dict[int, dict[int, RigidTransform]] = field(default_factory=dict)
    frames: dict[int, int] = field(default_factory=dict)


def rig_files(folder: Path, *, binary: bool) -> tuple[Path, ...]:
    """The files of a folder that hold rigs and frames; none where there is neither."""
    suffix = "bin" if binary else "txt"
    paths = tuple(Path(folder) / f"{name}.{suffix}" for name in ("rigs", "frames"))
    return paths if any(path.exists() for path in paths) else ()


def read_colmap_rigs(folder: Path, *, binary: bool) -> ColmapRigs:
    """Read the rigs and frames of a model, none of one before version 4.

    Raises
    ------
    DataError : one of the files is missing or broken; names it and the line or byte.
    """
    rigs = ColmapRigs()
    if paths := rig_files(folder, binary=binary):
        for record in _records(paths[0], _RIG, 8):
            _add_rig(record, rigs)
        for record in _records(paths[1], _FRAME, 68):
            _add_frame(record, rigs)
    return rigs


def _add_rig(record: _TextRecord | _BinaryRecord, rigs: ColmapRigs) -> None:
    rig_id, num_sensors = record.number("rig id"), record.number("number of sensors")
    with record.named():
        if rig_id in rigs.cams_from_rig:
            raise DataError(f"rig {rig_id} is listed twice")
        cameras = rigs.cams_from_rig.setdefault(rig_id, {})
        for row in range(num_sensors):
            kind, sensor_id = record.sensor()
            # the first is the reference: its pose is not written
            has_pose = row == 0 or record.flag()
            pose = record.pose() if row and has_pose else RigidTransform.identity()
            if has_pose and kind == _CAMERA:
                cameras[sensor_id] = pose


def _add_frame(record: _TextRecord | _BinaryRecord, rigs: ColmapRigs) -> None:
    frame_id, rig_id = record.number("frame id"), record.number("rig id")
    record.skip_pose()
    for _ in range(record.number("number of data ids")):
        kind, image_id = record.data()
        if kind != _CAMERA:
            continue
        with record.named():
            if rig_id not in rigs.cams_from_rig:
                raise DataError(f"frame {frame_id} is of the unknown rig {rig_id}")
            if image_id in rigs.frames:
                raise DataError(f"image {image_id} is in two frames")
        rigs.frames[image_id] = frame_id


def _records(path: Path, form: str, min_bytes: int) -> Iterator[_TextRecord | _BinaryRecord]:
    if path.suffix == ".txt":
        for line in read_lines(path, comments=True):
            record = _TextRecord(line, form)
            yield record
            record.finish()
        return
    with BinaryFile(path) as file:
        for _ in range(file.count(path.stem, min_bytes)):
            yield _BinaryRecord(file, form.partition(" (")[0])
        file.finish(f"the {path.stem}")


class _TextRecord:
    """A rig or a frame in a line of text, taken field by field."""

    def __init__(self, line: Line, form: str) -> None:
        self._line, self._form, self._at = line, form, 0

    def named(self) -> AbstractContextManager[None]:
        return self._line.named()

    def number(self, what: str, end: int = 2**32) -> int:
        return self._line.count_of(self._take(1)[0], what, end)

    def sensor(self) -> tuple[str | None, int]:
        return self._take(1)[0], self.number("sensor id")

    def data(self) -> tuple[str | None, int]:
        return self._take(2)[0], self.number("image id", 1 << 62)

    def flag(self) -> bool:
        return self._take(1)[0] == "1"

    def pose(self) -> RigidTransform:
        return self._line.pose_of(self._take(7))

    def skip_pose(self) -> None:
        self._take(7)

    def finish(self) -> None:
        left = len(self._line.fields) - self._at
        if left:
            raise self._line.error(f"{left} fields follow after {self._form}")

    def _take(self, number: int) -> list[str]:
        taken = self._line.fields[self._at : self._at + number]
        if len(taken) < number:
            raise self._line.error(f"the line ends within {self._form}")
        self._at += number
        return taken


class _BinaryRecord:
    """A rig or a frame in a binary file, taken value by value."""

    def __init__(self, file: BinaryFile, what: str) -> None:
        self._file, self._what, self._start = file, what, file.position

    def named(self) -> AbstractContextManager[None]:
        return self._file.named(self._start)

    def number(self, what: str) -> int:
        return int(self._file.unpack("I", self._what)[0])

    def sensor(self) -> tuple[str | None, int]:
        self._sensor_start = self._file.position
        kind, sensor_id = self._file.unpack("iI", f"a sensor of {self._what}")
        return _SENSOR_TYPES.get(kind), sensor_id

    def data(self) -> tuple[str | None, int]:
        kind, _, image_id = self._file.unpack("iIQ", f"the data of {self._what}")
        return _SENSOR_TYPES.get(kind), image_id

    def flag(self) -> bool:
        return bool(self._file.unpack("B", f"a sensor of {self._what}")[0])

    def pose(self) -> RigidTransform:
        with self._file.named(self._sensor_start):
            return finite_pose(self._file.unpack("7d", f"a sensor of {self._what}"), "a sensor")

    def skip_pose(self) -> None:
        self._file.skip(7 * 8, self._what)
