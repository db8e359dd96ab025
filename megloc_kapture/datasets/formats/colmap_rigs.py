"""Rigs and frames of COLMAP's models, which have them since version 4, as text or binary.

A frame is what the cameras of a rig took at one time. Its pose is left alone: the images have it.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from pathlib import Path

from megloc_kapture.datasets.formats.colmap_binary import BinaryFile
from megloc_kapture.datasets.formats.text_lines import Line, read_lines
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.values import RigidTransform

_FILES = ("rigs", "frames")
_CAMERA = "CAMERA"
# sensor types by number; what is none of these is no camera either
_SENSOR_TYPES = {0: _CAMERA, 1: "IMU"}
_ID_END = 2**32
_DATA_ID_END = 1 << 62
_NO_POSE = RigidTransform.identity()

# records of the binary files, all little-endian
_TWO_IDS = struct.Struct("<II")
_SENSOR = struct.Struct("<iI")  # type, id
_FLAG = struct.Struct("<B")
_POSE = struct.Struct("<7d")
_NUMBER = struct.Struct("<I")
_DATA = struct.Struct("<iIQ")  # sensor type, sensor, image


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

    def add_rig(self, rig_id: int) -> dict[int, RigidTransform]:
        """Take one more rig; its cameras go into what is returned."""
        if rig_id in self.cams_from_rig:
            raise DataError(f"rig {rig_id} is listed twice")
        return self.cams_from_rig.setdefault(rig_id, {})

    def add_image(self, frame_id: int, rig_id: int, image_id: int) -> None:
        """Take one more image of a frame."""
        if rig_id not in self.cams_from_rig:
            raise DataError(f"frame {frame_id} is of the unknown rig {rig_id}")
        if image_id in self.frames:
            raise DataError(f"image {image_id} is in two frames")
        self.frames[image_id] = frame_id


def rig_files(folder: Path, *, binary: bool) -> tuple[Path, ...]:
    """The files of a folder that hold rigs and frames; none where there is neither."""
    suffix = "bin" if binary else "txt"
    paths = tuple(Path(folder) / f"{name}.{suffix}" for name in _FILES)
    return paths if any(path.exists() for path in paths) else ()


def read_colmap_rigs(folder: Path, *, binary: bool) -> ColmapRigs:
    """Read the rigs and frames of a model, none of one before version 4.

    Raises
    ------
    DataError : one of the files is missing or broken; names it and the line or byte.
    """
    rigs = ColmapRigs()
    if paths := rig_files(folder, binary=binary):
        rigs_file, frames_file = paths
        if binary:
            _add_binary_rigs(rigs_file, rigs)
            _add_binary_frames(frames_file, rigs)
        else:
            _add_text_rigs(rigs_file, rigs)
            _add_text_frames(frames_file, rigs)
    return rigs


def _transform(values: tuple[float, ...]) -> RigidTransform:
    w, x, y, z, tx, ty, tz = values
    if not all(map(math.isfinite, values)):
        raise DataError("the pose of a sensor is not finite")
    return RigidTransform(unit_quaternion((w, x, y, z)), (tx, ty, tz))


# ---------------------------------------------------------------------------------- binary


def _add_binary_rigs(path: Path, rigs: ColmapRigs) -> None:
    with BinaryFile(path) as file:
        for _ in range(file.count("rigs", _TWO_IDS.size)):
            start = file.position
            rig_id, num_sensors = file.unpack(_TWO_IDS, "a rig")
            try:
                cameras = rigs.add_rig(rig_id)
                for row in range(num_sensors):
                    start = file.position
                    kind, sensor_id = file.unpack(_SENSOR, "a sensor of a rig")
                    # the first is the reference: its pose is not written
                    has_pose = row == 0 or file.unpack(_FLAG, "a sensor of a rig")[0]
                    pose = _NO_POSE
                    if row and has_pose:
                        pose = _transform(file.unpack(_POSE, "a sensor of a rig"))
                    if has_pose and _SENSOR_TYPES.get(kind) == _CAMERA:
                        cameras[sensor_id] = pose
            except DataError as error:
                raise error if error.path else file.error(error.message, start) from None
        file.finish("the rigs")


def _add_binary_frames(path: Path, rigs: ColmapRigs) -> None:
    with BinaryFile(path) as file:
        for _ in range(file.count("frames", _TWO_IDS.size + _POSE.size + _NUMBER.size)):
            start = file.position
            frame_id, rig_id = file.unpack(_TWO_IDS, "a frame")
            file.skip(_POSE.size, "a frame")
            for _ in range(file.unpack(_NUMBER, "a frame")[0]):
                kind, _, data_id = file.unpack(_DATA, "the data of a frame")
                if _SENSOR_TYPES.get(kind) == _CAMERA:
                    try:
                        rigs.add_image(frame_id, rig_id, data_id)
                    except DataError as error:
                        raise file.error(error.message, start) from None
        file.finish("the frames")


# ------------------------------------------------------------------------------------ text


def _add_text_rigs(path: Path, rigs: ColmapRigs) -> None:
    for line in read_lines(path, comments=True):
        rest = _Fields(line, "a rig (RIG_ID NUM_SENSORS, then sensors)")
        rig_id, num_sensors = rest.count("rig id"), rest.count("number of sensors")
        try:
            cameras = rigs.add_rig(rig_id)
            for row in range(num_sensors):
                kind, sensor_id = rest.take(1)[0], rest.count("sensor id")
                has_pose = row == 0 or rest.take(1)[0] == "1"
                pose = _NO_POSE
                if row and has_pose:
                    pose = _transform(tuple(line.numbers_of(rest.take(7), "pose")))
                if has_pose and kind == _CAMERA:
                    cameras[sensor_id] = pose
        except DataError as error:
            raise error if error.path else line.error(error.message) from None
        rest.finish()


def _add_text_frames(path: Path, rigs: ColmapRigs) -> None:
    for line in read_lines(path, comments=True):
        rest = _Fields(line, "a frame (FRAME_ID RIG_ID POSE NUM_DATA_IDS, then data)")
        frame_id, rig_id = rest.count("frame id"), rest.count("rig id")
        rest.take(7)
        for _ in range(rest.count("number of data ids")):
            kind = rest.take(2)[0]
            image_id = rest.count("image id", _DATA_ID_END)
            if kind == _CAMERA:
                try:
                    rigs.add_image(frame_id, rig_id, image_id)
                except DataError as error:
                    raise line.error(error.message) from None
        rest.finish()


class _Fields:
    """The fields of a line, taken from its beginning."""

    def __init__(self, line: Line, form: str) -> None:
        self._line, self._form, self._at = line, form, 0

    def take(self, number: int) -> list[str]:
        """The next fields; DataError where the line ends before."""
        taken = self._line.fields[self._at : self._at + number]
        if len(taken) < number:
            raise self._line.error(f"the line ends within {self._form}")
        self._at += number
        return taken

    def count(self, what: str, end: int = _ID_END) -> int:
        """The next field, a whole number."""
        return self._line.count_of(self.take(1)[0], what, end)

    def finish(self) -> None:
        """Raise DataError where fields are left."""
        left = len(self._line.fields) - self._at
        if left:
            raise self._line.error(f"{left} fields follow after {self._form}")
