"""kapture's records in memory (sensors, rigs, trajectories, images) and its text format.

Fields are separated by commas, with optional spaces; lines that start with ``#`` are comments.
Timestamps are integers of any length, never floats. kapture's own reader takes most of a second to
import and 100 MB per worker; this module takes 20 ms and names file and line in errors.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.files import has_control_characters, named
from megloc_kapture.io.text_lines import reading_lines
from megloc_kapture.values import Camera, RigidTransform

CAMERA_SENSOR_TYPES = ("camera", "depth")
UNKNOWN_CAMERA = "UNKNOWN_CAMERA"

FORMAT_VERSION = "1.1"
FORMAT_LINE = f"# kapture format: {FORMAT_VERSION}"
_READ_VERSIONS = ("1.0", FORMAT_VERSION)  # the tables are the same in both

# stricter than float(), which accepts "1_0", "nan" and digits of other scripts
FLOAT_PATTERN = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_VERSION_PATTERN = re.compile(r"# kapture format:\s*([0-9]+\.[0-9]+)")


@dataclass(frozen=True, slots=True)
class Sensor:
    """One row of ``sensors.txt``; for a camera ``params`` are model, width, height, parameters."""

    name: str
    sensor_type: str
    params: tuple[str, ...]

    @property
    def is_unknown(self) -> bool:
        """Whether this is a camera without intrinsics (``UNKNOWN_CAMERA``)."""
        return self.params[:1] == (UNKNOWN_CAMERA,)

    def camera(self) -> Camera:
        if self.sensor_type not in CAMERA_SENSOR_TYPES:
            raise DataError(f"a sensor of type {self.sensor_type!r} has no camera model")
        if self.is_unknown:
            raise DataError(
                "camera is not calibrated (UNKNOWN_CAMERA); give it intrinsics, or estimate them: "
                "`megloc localize --query` does so for queries, `megloc map` for map images"
            )
        require(len(self.params) > 2, "expected a camera model, width, height and parameters")
        model, *texts = self.params
        width, height, *params = map(float, texts)
        size = width, height
        require(size == (int(width), int(height)), f"image size {size} is not in whole pixels")
        return Camera(model, int(width), int(height), tuple(params))

    @classmethod
    def from_camera(cls, camera: Camera, *, name: str = "", sensor_type: str = "camera") -> Sensor:
        """Return the sensor whose :meth:`camera` is exactly ``camera``."""
        params = (camera.model, str(int(camera.width)), str(int(camera.height)))
        return cls(name, sensor_type, params + tuple(_shortest(p) for p in camera.params))


# numbers of records and rigs when it was made; records by image; rigs by member
_Index = tuple[tuple[int, int], dict[str, tuple[int, str]], dict[str, list[str]]]


@dataclass
class KaptureData:
    """Sensors, rigs, trajectories and image records of one kapture.

    After the first look-up of an image, ``records_camera`` and ``rigs`` may only get new entries.

    Attributes
    ----------
    rigs : rig id -> sensor or rig id -> ``sensor_from_rig``.
    trajectories : (timestamp, sensor or rig id) -> ``device_from_world``.
    records_camera, records_depth : (timestamp, sensor id) -> path below ``records_data``.
    """

    sensors: dict[str, Sensor] = field(default_factory=dict)
    rigs: dict[str, dict[str, RigidTransform]] = field(default_factory=dict)
    trajectories: dict[tuple[int, str], RigidTransform] = field(default_factory=dict)
    records_camera: dict[tuple[int, str], str] = field(default_factory=dict)
    records_depth: dict[tuple[int, str], str] = field(default_factory=dict)
    _index: _Index | None = field(default=None, init=False, repr=False, compare=False)

    def image_names(self) -> list[str]:
        return sorted(self.records_camera.values())

    def record_of(self, image: str) -> tuple[int, str]:
        """Return ``(timestamp, sensor id)`` of an image."""
        record = self._indexed()[1].get(image)
        if record is None:
            raise DataError(f"no image {image!r} in the camera records")
        return record

    def camera_of(self, image: str) -> Camera:
        sensor_id = self.record_of(image)[1]
        if sensor_id not in self.sensors:
            raise DataError(f"image {image!r} was taken by the unknown sensor {sensor_id!r}")
        with named(about=f"sensor {sensor_id!r} of image {image!r}"):
            return self.sensors[sensor_id].camera()

    def cam_from_world(self, image: str) -> RigidTransform | None:
        """Return the pose of an image, from its camera or from the first rig with a pose, or None.

        Rigs may be nested.
        """
        return self.device_from_world(*self.record_of(image))

    def device_from_world(self, timestamp: int, device_id: str) -> RigidTransform | None:
        """Return the pose of a sensor or rig at a time, directly or through its rigs, or None."""
        if (timestamp, device_id) in self.trajectories:
            return self.trajectories[timestamp, device_id]
        for rig_id in self._indexed()[2].get(device_id, ()):
            rig_from_world = self.device_from_world(timestamp, rig_id)
            if rig_from_world is not None:
                return self.rigs[rig_id][device_id] @ rig_from_world
        return None

    def poses(self) -> dict[str, RigidTransform]:
        """Return ``cam_from_world`` of every image that has one, sorted by image name."""
        poses = {image: self.cam_from_world(image) for image in self.image_names()}
        return {image: pose for image, pose in poses.items() if pose is not None}

    def _indexed(self) -> _Index:
        sizes = len(self.records_camera), len(self.rigs)
        if self._index is None or self._index[0] != sizes:
            records: dict[str, tuple[int, str]] = {}
            for record, image in self.records_camera.items():
                if image in records:
                    raise DataError(f"image {image!r} has two records: {records[image]}, {record}")
                records[image] = record
            rigs: dict[str, list[str]] = {}
            for rig_id in sorted(self.rigs):
                for member in self.rigs[rig_id]:
                    rigs.setdefault(member, []).append(rig_id)
            self._index = sizes, records, rigs
        return self._index


def _shortest(value: float) -> str:
    """Return the shortest text of a float64; whole numbers have no decimal point, as in kapture."""
    value = float(value)
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)


# --------------------------------------------------------------------------------------- text


@contextlib.contextmanager
def read_rows(path: Path, *, version_required: bool = False) -> Iterator[Iterator[list[str]]]:
    """Read rows of stripped fields, without comments; errors in the block name file and line."""
    with reading_lines(path) as lines:
        first = next(lines, "")
        check_version(path, first, required=version_required)
        rows = (line for line in chain([first], lines) if line and not line.startswith("#"))
        yield ([text.strip() for text in row.split(",")] for row in rows)


def check_version(path: Path, first_line: str, *, required: bool) -> None:
    match = _VERSION_PATTERN.search(first_line)
    if match is None:
        require(not required, f"the first line must be '{FORMAT_LINE}'", path=path, line=1)
    elif match[1] not in _READ_VERSIONS:
        message = f"kapture format {match[1]} is not supported; convert it to {FORMAT_VERSION}"
        raise DataError(message, path=path, line=1)


def check_columns(fields: Sequence[str], expected: int) -> None:
    if len(fields) != expected:
        raise DataError(f"expected {expected} columns, got {len(fields)}")


def writable_name(name: str) -> str:
    """Replace commas, outer spaces and a leading # by ``_``; :func:`format_table` rejects them."""
    return re.sub(r",|^#|^\s+|\s+$", lambda match: "_" * len(match[0]), name)


def format_table(header: str, rows: Iterable[Sequence[str]]) -> bytes:
    """Format a kapture CSV file: version line, column header, rows."""
    lines = [FORMAT_LINE, header]
    for row in rows:
        for text in row:
            if "," in text or text != text.strip() or has_control_characters(text):
                raise DataError(f"{text!r} is not allowed in a kapture text file")
        if row[0].startswith("#"):
            raise DataError(f"{row[0]!r} would be read as a comment")
        lines.append(", ".join(row))
    return ("\n".join(lines) + "\n").encode("utf-8")
