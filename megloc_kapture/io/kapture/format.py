"""kapture's records in memory (sensors, rigs, trajectories, images), and its grammar of text files.

Fields of a text file are separated by commas, spaces around a field do not count, a line that
starts with ``#`` is a comment. Our own reader of these few tables takes 20 ms where importing
kapture's takes most of a second (and 100 MB in each worker), and its messages name file and line.
Timestamps and ids are integers of any length, never floats.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import check_relative, has_control_characters, named, read_text
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

CAMERA_SENSOR_TYPES = ("camera", "depth")
UNKNOWN_CAMERA = "UNKNOWN_CAMERA"

FORMAT_VERSION = "1.1"
FORMAT_LINE = f"# kapture format: {FORMAT_VERSION}"
_READ_VERSIONS = ("1.0", FORMAT_VERSION)  # the tables that are read here are the same in both
BYTE_ORDER_MARK = b"\xef\xbb\xbf"

# Python's float() takes more ("1_0", "nan", digits of other scripts) than the format allows
FLOAT_PATTERN = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_VERSION_PATTERN = re.compile(r"# kapture format:\s*([0-9]+\.[0-9]+)")
_INTEGER_PATTERN = re.compile(r"[+-]?[0-9]{1,40}")


@dataclass(frozen=True, slots=True)
class Sensor:
    """One row of ``sensors.txt``.

    Parameters
    ----------
    name : free text, may be empty.
    sensor_type : ``"camera"``, ``"depth"``, ``"gnss"``, ...
    params : the remaining fields as text; for cameras the model, width, height and the model's
        parameters.
    """

    name: str
    sensor_type: str
    params: tuple[str, ...]

    def camera(self) -> Camera:
        """The intrinsics of a sensor of type camera or depth; DataError where it has none."""
        if self.sensor_type not in CAMERA_SENSOR_TYPES:
            raise DataError(f"a sensor of type {self.sensor_type!r} has no camera model")
        if not self.params:
            raise DataError("camera without a model")
        model = self.params[0]
        if model == UNKNOWN_CAMERA:
            raise DataError("camera is not calibrated (UNKNOWN_CAMERA); give it intrinsics first")
        if model not in CAMERA_MODEL_NUM_PARAMS:
            known = ", ".join([*CAMERA_MODEL_NUM_PARAMS, UNKNOWN_CAMERA])
            raise DataError(f"unknown camera model {model!r}; known: {known}")
        expected = CAMERA_MODEL_NUM_PARAMS[model] + 2
        if len(self.params) != expected + 1:
            raise DataError(
                f"camera model {model} takes {expected} parameters "
                f"(width and height included), got {len(self.params) - 1}"
            )
        width, height = (_pixels(text) for text in self.params[1:3])
        params = tuple(parse_float(text, "camera parameter") for text in self.params[3:])
        return Camera(model, width, height, params)

    @classmethod
    def from_camera(cls, camera: Camera, *, name: str = "", sensor_type: str = "camera") -> Sensor:
        """The sensor whose :meth:`camera` is exactly ``camera``."""
        params = (camera.model, str(int(camera.width)), str(int(camera.height)))
        return cls(name, sensor_type, params + tuple(_shortest(p) for p in camera.params))


@dataclass
class KaptureData:
    """Sensors, rigs, trajectories and image records of one kapture.

    The dicts may be changed freely until poses are asked for; then, members of a rig that is there
    already stay.

    Parameters
    ----------
    sensors : by sensor id.
    rigs : rig id -> sensor id (or the id of another rig) -> ``sensor_from_rig``.
    trajectories : (timestamp, device id) -> ``device_from_world``; a device is a sensor or a rig.
    records_camera, records_depth : (timestamp, sensor id) -> path below ``records_data``.
    """

    sensors: dict[str, Sensor] = field(default_factory=dict)
    rigs: dict[str, dict[str, RigidTransform]] = field(default_factory=dict)
    trajectories: dict[tuple[int, str], RigidTransform] = field(default_factory=dict)
    records_camera: dict[tuple[int, str], str] = field(default_factory=dict)
    records_depth: dict[tuple[int, str], str] = field(default_factory=dict)
    _record_by_image: dict[str, tuple[int, str]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _rigs_of: dict[str, list[str]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _num_rigs: int = field(default=0, init=False, repr=False, compare=False)

    def image_names(self) -> list[str]:
        """Paths of all camera images, sorted."""
        return sorted(self.records_camera.values())

    def record_of(self, image: str) -> tuple[int, str]:
        """``(timestamp, sensor id)`` of an image; DataError: none, or two of that name."""
        index = self._record_by_image
        key = index.get(image)
        # the entry proves itself; the index is built again after any change that matters
        if (
            key is None
            or len(index) != len(self.records_camera)
            or self.records_camera.get(key) != image
        ):
            index = {}
            for record, name in self.records_camera.items():
                if name in index:
                    raise DataError(f"image {name!r} has two records: {index[name]} and {record}")
                index[name] = record
            self._record_by_image = index
            key = index.get(image)
        if key is None:
            raise DataError(f"no image {image!r} in the camera records")
        return key

    def camera_of(self, image: str) -> Camera:
        """Intrinsics of the camera that took an image; see :meth:`Sensor.camera`."""
        sensor_id = self.record_of(image)[1]
        if sensor_id not in self.sensors:
            raise DataError(f"image {image!r} was taken by the unknown sensor {sensor_id!r}")
        with named(about=f"sensor {sensor_id!r} of image {image!r}"):
            return self.sensors[sensor_id].camera()

    def cam_from_world(self, image: str) -> RigidTransform | None:
        """Pose of an image: its camera's own, else through the (nested) rigs that carry it.

        None without a pose. Of several rigs with a pose at that time, the first by id counts.
        """
        return self.device_from_world(*self.record_of(image))

    def device_from_world(self, timestamp: int, device_id: str) -> RigidTransform | None:
        """Pose of a sensor or rig at a time, own or through rigs; None where there is none."""
        return self._device_from_world(timestamp, device_id, frozenset())

    def poses(self) -> dict[str, RigidTransform]:
        """``cam_from_world`` of every image that has one, by image name, sorted."""
        poses = {image: self.cam_from_world(image) for image in self.image_names()}
        return {image: pose for image, pose in poses.items() if pose is not None}

    def _device_from_world(
        self, timestamp: int, device_id: str, seen: frozenset[str]
    ) -> RigidTransform | None:
        own = self.trajectories.get((timestamp, device_id))
        if own is not None:
            return own
        for rig_id in self._parents().get(device_id, ()):
            if rig_id in seen:
                raise DataError(f"rig {rig_id!r} contains itself")
            rig_from_world = self._device_from_world(timestamp, rig_id, seen | {rig_id})
            if rig_from_world is not None:
                return self.rigs[rig_id][device_id] @ rig_from_world
        return None

    def _parents(self) -> dict[str, list[str]]:
        if self._num_rigs != len(self.rigs):
            self._rigs_of = {}
            self._num_rigs = len(self.rigs)
            for rig_id in sorted(self.rigs):
                for sensor_id in self.rigs[rig_id]:
                    self._rigs_of.setdefault(sensor_id, []).append(rig_id)
        return self._rigs_of


def _pixels(text: str) -> int:
    value = parse_float(text, "camera parameter")
    if value != int(value):
        raise DataError(f"image size {text!r} is not a whole number of pixels")
    return int(value)


def _shortest(value: float) -> str:
    """Shortest text that reads back as the same float64; whole numbers as kapture has them."""
    value = float(value)
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)


# --------------------------------------------------------------------------------------- text


@contextlib.contextmanager
def read_rows(path: Path, *, version_required: bool = False) -> Iterator[Iterator[list[str]]]:
    """Rows of a kapture CSV file as stripped fields; comments left out.

    A DataError of the block that names no file gets the path and the line of the row read last.
    """
    lines = read_text(path).split("\n")
    check_version(path, lines[0], required=version_required)
    number = 0

    def rows() -> Iterator[list[str]]:
        nonlocal number
        for number, line in enumerate(lines, start=1):  # noqa: B007  of the message below
            if line.strip() and not line.startswith("#"):
                yield [text.strip() for text in line.split(",")]

    try:
        yield rows()
    except DataError as error:
        if error.path is not None:
            raise
        raise DataError(error.message, path=path, line=number) from error.__cause__


def check_version(path: Path, first_line: str, *, required: bool) -> None:
    """Refuse a file whose first line names a format version that is not read."""
    found = _VERSION_PATTERN.search(first_line)
    if found is None:
        if required:
            raise DataError(f"the first line must be '{FORMAT_LINE}'", path=path, line=1)
    elif found[1] not in _READ_VERSIONS:
        message = f"kapture format {found[1]} is not supported; convert it to {FORMAT_VERSION}"
        raise DataError(message, path=path, line=1)


def check_columns(fields: Sequence[str], expected: int) -> None:
    """Raise DataError unless there are so many fields."""
    if len(fields) != expected:
        raise DataError(f"expected {expected} columns, got {len(fields)}")


def parse_integer(text: str, what: str) -> int:
    """A decimal integer, exactly; never through float."""
    if not _INTEGER_PATTERN.fullmatch(text):
        raise DataError(f"{what} {text!r} is not an integer")
    return int(text)


def parse_float(text: str, what: str) -> float:
    """A finite decimal number."""
    try:
        value = float(text)
    except ValueError as error:
        raise DataError(f"{what} {text!r} is not a number") from error
    if not math.isfinite(value):
        raise DataError(f"{what} {text!r} is not finite")
    return value


def writable_name(name: str) -> str:
    """A name in which ``_`` replaces what :func:`format_table` refuses: a comma, a space at an
    end, and # at the beginning."""
    name = name.replace(",", "_")
    middle = name.strip()
    left = len(name) - len(name.lstrip())
    name = "_" * left + middle + "_" * (len(name) - left - len(middle))
    return f"_{name[1:]}" if name.startswith("#") else name


def check_field(name: str) -> str:
    """Return an image name that is a plain path and can stand in a CSV field, else raise."""
    check_relative(name)
    if "," in name or name != name.strip():
        raise DataError(f"image name {name!r} has a comma or a space at its end")
    return name


def format_table(header: str, rows: Iterable[Sequence[str]]) -> bytes:
    """A kapture CSV file: the version line, the column header, the rows.

    Raises DataError: a field that would not be read back as it is (comma, line break, outer
    spaces).
    """
    lines = [FORMAT_LINE, header]
    for row in rows:
        for text in row:
            if "," in text or text != text.strip() or has_control_characters(text):
                raise DataError(f"{text!r} cannot stand in a kapture text file")
        if row[0].startswith("#"):
            raise DataError(f"{row[0]!r} would be read as a comment")
        lines.append(", ".join(row))
    return ("\n".join(lines) + "\n").encode("utf-8")
