"""Records of a kapture (sensors, rigs, trajectories, images) and their tables in ``sensors/``.

Floats are written with the fewest digits (up to 17) that restore the same float64. kapture allows
partial poses: rows whose whole rotation or whole translation is blank are skipped; other blanks are
errors.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.files import check_relative, find_near, named, remove, write_bytes
from megloc_kapture.io.kapture.format import check_columns, format_table, read_rows
from megloc_kapture.io.text_lines import camera_of, numbers_of
from megloc_kapture.values import Camera, RigidTransform

# files may have few digits: a quaternion is normalised if its length is within this of 1
MAX_QUATERNION_ERROR = 1e-3
# a length within this of 1 is due to rounding; normalising would only change the last bits
_QUATERNION_ROUNDING = 1e-14

CAMERA_SENSOR_TYPES = ("camera", "depth")
UNKNOWN_CAMERA = "UNKNOWN_CAMERA"
_POSE_COLUMNS = "qw, qx, qy, qz, tx, ty, tz"
_HEADERS = {
    "sensors": "# sensor_id, name, sensor_type, [sensor_params]+",
    "rigs": f"# rig_id, sensor_id, {_POSE_COLUMNS}",
    "trajectories": f"# timestamp, device_id, {_POSE_COLUMNS}",
    "records_camera": "# timestamp, device_id, image_path",
    "records_depth": "# timestamp, device_id, depth_map_path",
}


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
        return camera_of(self.params[0], self.params[1:])

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

    After the first look-up of an image, entries of ``records_camera`` and ``rigs`` may be added,
    but not changed or removed.

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


# ------------------------------------------------------------------------------------ reading


def is_kapture(folder: Path) -> bool:
    return (folder / "sensors" / "sensors.txt").is_file()


def read_kapture_data(root: Path) -> KaptureData:
    """Read and check ``sensors/`` of a kapture; only sensors.txt must exist."""
    folder = root / "sensors"
    require(root.exists(), "no such kapture folder", path=root)
    require(root.is_dir(), "this is a file; give a kapture folder", path=root)
    if not folder.is_dir():
        inner = ", ".join(sorted(p.parents[1].name for p in root.glob("*/sensors/sensors.txt")))
        if inner:
            raise DataError(f"not a kapture folder; it has {inner}: give one of them", path=root)
        # nerfstudio has colmap/sparse/0, COLMAP's dense reconstruction dense/0/sparse
        if models := sorted(path.parent for path in find_near(root, "points3D.*")):
            raise DataError(
                f"not a kapture folder; {models[0]} has a COLMAP model, from which `megloc import "
                "colmap` makes a map",
                path=root,
            )
        raise DataError(
            "not a kapture folder: sensors/sensors.txt is missing. For photographs, use `megloc "
            "localize --images` or `megloc map`; for a COLMAP model, `megloc import colmap`; for "
            "poses, `megloc evaluate`, which takes a model or a text file of cam_from_world with "
            "lines 'name qw qx qy qz tx ty tz'",
            path=root,
        )
    paths = {
        name: folder / f"{name}.txt"
        for name in _HEADERS
        if name == "sensors" or (folder / f"{name}.txt").exists()
    }
    data = KaptureData(read_sensors(paths["sensors"]))
    if "rigs" in paths:
        data.rigs = read_rigs(paths["rigs"], data.sensors)
    if "trajectories" in paths:
        data.trajectories = read_trajectories(paths["trajectories"], {*data.sensors, *data.rigs})
    if "records_camera" in paths:
        data.records_camera = read_records(paths["records_camera"], data.sensors, "camera")
    if "records_depth" in paths:
        data.records_depth = read_records(paths["records_depth"], data.sensors, "depth")
    return data


def read_sensors(path: Path) -> dict[str, Sensor]:
    """Read ``sensors.txt`` and check the camera parameters."""
    sensors: dict[str, Sensor] = {}
    with read_rows(path, version_required=True) as rows:
        for fields in rows:
            if len(fields) < 3:
                raise DataError(f"expected at least 3 columns, got {len(fields)}")
            sensor_id, name, sensor_type, *params = fields
            if not sensor_id or sensor_id in sensors:
                raise DataError(f"sensor id {sensor_id!r} is empty or listed twice")
            sensor = sensors[sensor_id] = Sensor(name, sensor_type, tuple(params))
            if sensor_type in CAMERA_SENSOR_TYPES and not sensor.is_unknown:
                sensor.camera()  # checks the parameters
            elif sensor_type in CAMERA_SENSOR_TYPES:
                is_size = len(params) == 3 and all(re.fullmatch("[0-9]+", p) for p in params[1:])
                require(is_size, f"{UNKNOWN_CAMERA} takes a width and a height in whole pixels")
    return sensors


def read_rigs(path: Path, sensors: Collection[str]) -> dict[str, dict[str, RigidTransform]]:
    """Read ``rigs.txt``: rig id -> sensor or rig id -> ``sensor_from_rig``.

    Sensors missing from ``sensors.txt`` are skipped, as in kapture.
    """
    rigs: dict[str, dict[str, RigidTransform]] = {}
    with read_rows(path) as rows:
        for fields in rows:
            check_columns(fields, 9)
            rig_id, sensor_id = fields[:2]
            if not rig_id or rig_id in sensors:
                raise DataError(f"rig id {rig_id!r} is empty or also a sensor id")
            rig = rigs.setdefault(rig_id, {})
            require(sensor_id not in rig, f"sensor {sensor_id!r} is in rig {rig_id!r} twice")
            pose = _pose(fields[2:])
            if pose is not None:
                rig[sensor_id] = pose
            if sensor_id in rigs:
                try:
                    TopologicalSorter(rigs).prepare()
                except CycleError as error:
                    raise DataError(f"rig {rig_id!r} contains itself") from error
    return {
        rig_id: {s: pose for s, pose in members.items() if s in sensors or s in rigs}
        for rig_id, members in rigs.items()
    }


def read_trajectories(
    path: Path, devices: Collection[str]
) -> dict[tuple[int, str], RigidTransform]:
    """Read ``trajectories.txt``: (timestamp, device id) -> ``device_from_world``."""
    poses: dict[tuple[int, str], RigidTransform] = {}
    with read_rows(path) as rows:
        for fields in rows:
            check_columns(fields, 9)
            key = _record_key(fields, devices, poses)
            pose = _pose(fields[2:])
            if pose is not None:
                poses[key] = pose
    return poses


def read_records(
    path: Path, sensors: dict[str, Sensor], sensor_type: str
) -> dict[tuple[int, str], str]:
    """Read ``records_camera.txt`` or ``records_depth.txt``; DataError for a repeated path."""
    records: dict[tuple[int, str], str] = {}
    names: set[str] = set()
    with read_rows(path) as rows:
        for fields in rows:
            check_columns(fields, 3)
            key = _record_key(fields, sensors, records)
            found_type = sensors[key[1]].sensor_type
            if found_type != sensor_type:
                raise DataError(f"sensor {key[1]!r} is of type {found_type!r}, not {sensor_type!r}")
            name = check_relative(fields[2])
            require(name not in names, f"{name!r} is listed twice")
            names.add(name)
            records[key] = name
    return records


def _record_key(
    fields: Sequence[str], devices: Collection[str], known: Collection[tuple[int, str]]
) -> tuple[int, str]:
    require(re.fullmatch("[+-]?[0-9]+", fields[0]), f"timestamp {fields[0]!r} is not an integer")
    key = (int(fields[0]), fields[1])
    if key[1] not in devices:
        raise DataError(f"unknown sensor or rig {key[1]!r}: define it, or delete its rows")
    if key in known:
        raise DataError(f"timestamp {key[0]} of {key[1]!r} is listed twice")
    return key


def _pose(fields: Sequence[str]) -> RigidTransform | None:
    rotation, translation = fields[:4], fields[4:]
    if not any(rotation) or not any(translation):
        return None
    require(all(fields), "some but not all fields of a pose are blank")
    qw, qx, qy, qz, tx, ty, tz = numbers_of(fields, "qw qx qy qz tx ty tz")
    return RigidTransform(unit_quaternion((qw, qx, qy, qz)), (tx, ty, tz))


def unit_quaternion(
    quat_wxyz: tuple[float, float, float, float],
) -> tuple[float, float, float, float]:
    """Normalise a quaternion; DataError if its length differs from 1 by 1e-3 or more."""
    norm = math.hypot(*quat_wxyz)
    if not abs(norm - 1.0) < MAX_QUATERNION_ERROR:
        raise DataError(f"rotation is not a unit quaternion (length {norm:.6g})")
    if abs(norm - 1.0) <= _QUATERNION_ROUNDING:
        return quat_wxyz
    w, x, y, z = quat_wxyz
    return (w / norm, x / norm, y / norm, z / norm)


# ------------------------------------------------------------------------------------ writing


def write_sensors(root: Path, data: KaptureData) -> None:
    """Write the tables of the kapture at ``root``, sorted, and remove old files of empty tables."""
    tables = {
        "sensors": [
            [sensor_id, sensor.name, sensor.sensor_type, *sensor.params]
            for sensor_id, sensor in sorted(data.sensors.items())
        ],
        "rigs": [
            [rig_id, sensor_id, *_pose_fields(pose)]
            for rig_id, members in sorted(data.rigs.items())
            for sensor_id, pose in sorted(members.items())
        ],
        "trajectories": [
            [str(int(time)), device, *_pose_fields(pose)]
            for (time, device), pose in sorted(data.trajectories.items())
        ],
        "records_camera": _record_rows(data.records_camera),
        "records_depth": _record_rows(data.records_depth),
    }
    for name, rows in tables.items():
        path = Path(root) / "sensors" / f"{name}.txt"
        if rows or name == "sensors":
            write_bytes(path, format_table(_HEADERS[name], rows))
        else:
            remove(path)


def _record_rows(records: dict[tuple[int, str], str]) -> list[list[str]]:
    return [
        [str(int(time)), sensor_id, check_relative(name)]
        for (time, sensor_id), name in sorted(records.items())
    ]


def _pose_fields(pose: RigidTransform) -> list[str]:
    w, x, y, z = map(float, pose.quat_wxyz)
    return [repr(float(v)) for v in (*unit_quaternion((w, x, y, z)), *pose.translation)]
