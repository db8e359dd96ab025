"""The tables below a kapture's ``sensors/``: sensors, rigs, trajectories and records.

Read strictly, written sorted. Floats are written with as many digits as bring back the same
float64 (up to 17).

Poses: kapture allows partial ones (blank fields). A row whose rotation or whose translation is
entirely blank is no pose, and is skipped; a row with only some of them blank is an error.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import (
    check_no_escape,
    check_output,
    check_relative,
    named,
    output_error,
    write_bytes,
)
from megloc_kapture.io.kapture.format import (
    CAMERA_SENSOR_TYPES,
    UNKNOWN_CAMERA,
    KaptureData,
    Sensor,
    check_columns,
    format_table,
    parse_float,
    parse_integer,
    read_rows,
)
from megloc_kapture.values import RigidTransform

# |q| may be off by this much (texts with few digits), and is then normalised
MAX_QUATERNION_ERROR = 1e-3
# below this |q| is one up to rounding: normalising again would only change the last bits
_QUATERNION_ROUNDING = 1e-14


# ------------------------------------------------------------------------------------ reading


def read_kapture_data(root: Path, *, allow_links_below: Sequence[Path] = ()) -> KaptureData:
    """Read and validate ``sensors/`` of the kapture at ``root``; only sensors.txt must exist.

    Parameters
    ----------
    allow_links_below : folders beside ``root`` that links may lead to.

    Raises
    ------
    DataError : names file and line.
    """
    if not root.exists():
        raise DataError("no such kapture folder", path=root)
    if not (root / "sensors").is_dir():
        raise DataError(
            "no kapture folder: sensors/sensors.txt is missing. Photographs? `megloc localize "
            "--images` localizes them, `megloc map` makes a map of them",
            path=root,
        )
    roots = (root, *allow_links_below)

    def read(name: str, reader: Callable[..., dict[Any, Any]], *known: Any) -> dict[Any, Any]:
        path = root / "sensors" / name
        if not (path.exists() or path.is_symlink() or name == "sensors.txt"):
            return {}
        return reader(check_no_escape(roots, path), *known)

    sensors = read("sensors.txt", read_sensors)
    rigs = read("rigs.txt", read_rigs, sensors)
    return KaptureData(
        sensors,
        rigs,
        read("trajectories.txt", read_trajectories, {*sensors, *rigs}),
        read("records_camera.txt", read_records, sensors, "camera"),
        read("records_depth.txt", read_records, sensors, "depth"),
    )


def read_sensors(path: Path) -> dict[str, Sensor]:
    """Read ``sensors.txt``; cameras' models and parameters are checked."""
    sensors: dict[str, Sensor] = {}
    with read_rows(path, version_required=True) as rows:
        for _, fields in rows:
            if len(fields) < 3:
                raise DataError(f"expected at least 3 columns, got {len(fields)}")
            sensor_id, name, sensor_type, *params = fields
            if not sensor_id:
                raise DataError("empty sensor id")
            if sensor_id in sensors:
                raise DataError(f"sensor {sensor_id!r} is listed twice")
            sensors[sensor_id] = Sensor(name, sensor_type, tuple(params))
            check_sensor(sensors[sensor_id])
    return sensors


def check_sensor(sensor: Sensor) -> None:
    """Refuse a camera or depth sensor whose intrinsics are wrong; ``UNKNOWN_CAMERA`` is fine."""
    if sensor.sensor_type not in CAMERA_SENSOR_TYPES:
        return
    if sensor.params[:1] != (UNKNOWN_CAMERA,):
        sensor.camera()
    elif len(sensor.params) != 3 or not all(re.fullmatch("[0-9]+", p) for p in sensor.params[1:]):
        raise DataError(f"{UNKNOWN_CAMERA} takes a width and a height in whole pixels")


def read_rigs(path: Path, sensors: Iterable[str]) -> dict[str, dict[str, RigidTransform]]:
    """Read ``rigs.txt``: rig id -> sensor or rig id -> ``sensor_from_rig``.

    Rows of sensors that ``sensors.txt`` does not know are left out, as kapture does: who takes
    some cameras of a rig out of a dataset leaves rigs.txt as it was. A rig that contains itself is
    refused.
    """
    known = set(sensors)
    rigs: dict[str, dict[str, RigidTransform]] = {}
    lines: dict[tuple[str, str], int] = {}
    with read_rows(path) as rows:
        for line, fields in rows:
            check_columns(fields, 9)
            rig_id, sensor_id = fields[:2]
            if not rig_id or not sensor_id:
                raise DataError("empty rig or sensor id")
            if rig_id in known:
                raise DataError(f"rig id {rig_id!r} is also a sensor id")
            if (rig_id, sensor_id) in lines:
                raise DataError(f"sensor {sensor_id!r} is in rig {rig_id!r} twice")
            lines[rig_id, sensor_id] = line
            pose = _pose(fields[2:])
            rig = rigs.setdefault(rig_id, {})
            if pose is not None:
                rig[sensor_id] = pose
    for members in rigs.values():
        for sensor_id in [s for s in members if s not in known and s not in rigs]:
            del members[sensor_id]
    _check_no_cycle(rigs, lines, path)
    return rigs


def read_trajectories(path: Path, devices: Iterable[str]) -> dict[tuple[int, str], RigidTransform]:
    """Read ``trajectories.txt``: (timestamp, device id) -> ``device_from_world``."""
    known = set(devices)
    poses: dict[tuple[int, str], RigidTransform] = {}
    lines: dict[tuple[int, str], int] = {}
    with read_rows(path) as rows:
        for line, fields in rows:
            check_columns(fields, 9)
            key = _record_key(fields, known, lines)
            lines[key] = line
            pose = _pose(fields[2:])
            if pose is not None:
                poses[key] = pose
    return poses


def read_records(
    path: Path, sensors: dict[str, Sensor], sensor_type: str
) -> dict[tuple[int, str], str]:
    """Read ``records_camera.txt`` or ``records_depth.txt``.

    A path that is listed twice is refused (an image name is the identity of its features), and so
    is a sensor of another type.
    """
    known = set(sensors)
    records: dict[tuple[int, str], str] = {}
    lines: dict[tuple[int, str], int] = {}
    lines_of_names: dict[str, int] = {}
    with read_rows(path) as rows:
        for line, fields in rows:
            check_columns(fields, 3)
            key = _record_key(fields, known, lines)
            lines[key] = line
            found_type = sensors[key[1]].sensor_type
            if found_type != sensor_type:
                raise DataError(f"sensor {key[1]!r} is of type {found_type!r}, not {sensor_type!r}")
            name = check_relative(fields[2])
            if name in lines_of_names:
                raise DataError(f"{name!r} is listed twice, first in line {lines_of_names[name]}")
            lines_of_names[name] = line
            records[key] = name
    return records


def _record_key(
    fields: Sequence[str], known: set[str], lines: dict[tuple[int, str], int]
) -> tuple[int, str]:
    """Timestamp and device of a row, of which there is none in ``lines``."""
    key = (parse_integer(fields[0], "timestamp"), fields[1])
    if key[1] not in known:
        raise DataError(f"unknown sensor or rig {key[1]!r}")
    if key in lines:
        raise DataError(
            f"timestamp {key[0]} of {key[1]!r} is listed twice, first in line {lines[key]}"
        )
    return key


def _pose(fields: Sequence[str]) -> RigidTransform | None:
    rotation, translation = fields[:4], fields[4:]
    if not any(rotation) or not any(translation):
        return None
    if not all(fields):
        raise DataError("some but not all fields of a pose are blank")
    qw, qx, qy, qz = (parse_float(text, "rotation") for text in rotation)
    tx, ty, tz = (parse_float(text, "translation") for text in translation)
    return RigidTransform(unit_quaternion((qw, qx, qy, qz)), (tx, ty, tz))


def unit_quaternion(
    quat_wxyz: tuple[float, float, float, float],
) -> tuple[float, float, float, float]:
    """The quaternion with length one; unchanged where it is one up to rounding.

    Raises DataError: its length is off by 1e-3 or more.
    """
    norm = math.hypot(*quat_wxyz)
    if not abs(norm - 1.0) < MAX_QUATERNION_ERROR:
        raise DataError(f"rotation is not a unit quaternion (length {norm:.6g})")
    if abs(norm - 1.0) <= _QUATERNION_ROUNDING:
        return quat_wxyz
    w, x, y, z = quat_wxyz
    return (w / norm, x / norm, y / norm, z / norm)


def _check_no_cycle(
    rigs: dict[str, dict[str, RigidTransform]], lines: dict[tuple[str, str], int], path: Path
) -> None:
    members: dict[str, list[str]] = {rig: [] for rig in rigs}
    for rig, sensor_id in lines:
        if sensor_id in rigs:
            members[rig].append(sensor_id)
    try:
        TopologicalSorter(members).prepare()
    except CycleError as error:
        member, rig = error.args[1][:2]
        line = lines[rig, member]
        raise DataError(f"rig {member!r} contains itself", path=path, line=line) from None


# ------------------------------------------------------------------------------------ writing


def write_sensors(root: Path, data: KaptureData) -> None:
    """Write ``sensors/*.txt`` of the kapture at ``root``; images and features are not touched.

    Rows are sorted; a table without rows has no file, and an older file of it is removed.

    Raises
    ------
    DataError : the data is not valid kapture (ids, names, poses).
    OutputError : a file cannot be written.
    """
    root = Path(root)
    folder = check_output(root, root / "sensors")
    pose = "qw, qx, qy, qz, tx, ty, tz"
    tables = {
        "sensors": ("sensor_id, name, sensor_type, [sensor_params]+", _sensor_rows(data)),
        "rigs": (f"rig_id, sensor_id, {pose}", _rig_rows(data)),
        "trajectories": (f"timestamp, device_id, {pose}", _trajectory_rows(data)),
        "records_camera": ("timestamp, device_id, image_path", _record_rows(data, "camera")),
        "records_depth": ("timestamp, device_id, depth_map_path", _record_rows(data, "depth")),
    }
    for name, (header, rows) in tables.items():
        path = folder / f"{name}.txt"
        if rows or name == "sensors":
            write_bytes(path, format_table(f"# {header}", rows))
        else:
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                raise output_error(path, error) from error


def _sensor_rows(data: KaptureData) -> list[list[str]]:
    rows = []
    for sensor_id in sorted(data.sensors):
        sensor = data.sensors[sensor_id]
        if not sensor_id:
            raise DataError("empty sensor id")
        with named(about=f"sensor {sensor_id!r}"):
            check_sensor(sensor)
        rows.append([sensor_id, sensor.name, sensor.sensor_type, *sensor.params])
    return rows


def _rig_rows(data: KaptureData) -> list[list[str]]:
    rows = []
    for rig_id in sorted(data.rigs):
        if rig_id in data.sensors or not rig_id:
            raise DataError(f"rig id {rig_id!r} is empty or also a sensor id")
        for sensor_id in sorted(data.rigs[rig_id]):
            if sensor_id not in data.sensors and sensor_id not in data.rigs:
                raise DataError(f"rig {rig_id!r} holds the unknown sensor {sensor_id!r}")
            pose = data.rigs[rig_id][sensor_id]
            rows.append([rig_id, sensor_id, *_pose_fields(pose, f"rig {rig_id!r}")])
    return rows


def _trajectory_rows(data: KaptureData) -> list[list[str]]:
    rows = []
    for timestamp, device_id in sorted(data.trajectories):
        # a rig without sensors has no row in rigs.txt, and so would be unknown to readers
        if device_id not in data.sensors and not data.rigs.get(device_id):
            raise DataError(f"trajectories name the unknown device {device_id!r}")
        pose = data.trajectories[timestamp, device_id]
        where = f"trajectory of {device_id!r} at {timestamp}"
        rows.append([str(int(timestamp)), device_id, *_pose_fields(pose, where)])
    return rows


def _record_rows(data: KaptureData, sensor_type: str) -> list[list[str]]:
    records = data.records_camera if sensor_type == "camera" else data.records_depth
    rows = []
    names: set[str] = set()
    for timestamp, sensor_id in sorted(records):
        name = records[timestamp, sensor_id]
        sensor = data.sensors.get(sensor_id)
        if sensor is None or sensor.sensor_type != sensor_type:
            raise DataError(f"{name!r} is recorded by {sensor_id!r}, not a {sensor_type} sensor")
        if check_relative(name) in names:
            raise DataError(f"{name!r} is recorded twice")
        names.add(name)
        rows.append([str(int(timestamp)), sensor_id, name])
    return rows


def _pose_fields(pose: RigidTransform, where: str) -> list[str]:
    values = [float(v) for v in (*pose.quat_wxyz, *pose.translation)]
    if not all(map(math.isfinite, values)):
        raise DataError(f"{where}: the pose is not finite")
    with named(about=where):
        quat = unit_quaternion((values[0], values[1], values[2], values[3]))
    return [repr(v) for v in (*quat, *values[4:])]
