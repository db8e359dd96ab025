"""The text files below sensors/: strict reading, exact writing."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.data import KaptureData, Sensor
from megloc_kapture.io.kapture.sensors import read_kapture_data, write_sensors
from megloc_kapture.values import Camera, RigidTransform

VERSION = "# kapture format: 1.1\n"
SENSORS = VERSION + (
    "# sensor_id, name, sensor_type, [sensor_params]+\n"
    "cam, , camera, PINHOLE, 640, 480, 500, 500, 320, 240\n"
    "cam2, right, camera, SIMPLE_RADIAL, 640, 480, 500, 320, 240, 0.1\n"
    "deep, , depth, SIMPLE_PINHOLE, 320, 240, 250, 160, 120\n"
    "gps, , gnss, EPSG:4326\n"
)
IDENTITY = "1, 0, 0, 0, 0, 0, 0"


def make(root: Path, **files: str | bytes) -> Path:
    """A kapture with a good sensors.txt and the given other files."""
    folder = root / "sensors"
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in {"sensors": SENSORS, **files}.items():
        data = content.encode() if isinstance(content, str) else content
        (folder / f"{name}.txt").write_bytes(data)
    return root


def refuse(root: Path, where: str, *, match: str) -> None:
    """The kapture is refused with an error that names ``file:line``."""
    with pytest.raises(DataError, match=match) as caught:
        read_kapture_data(root)
    assert f"{root}/sensors/{where}: " in str(caught.value)


def test_everything_is_read(tmp_path: Path) -> None:
    root = make(
        tmp_path,
        rigs=VERSION + f"rig, cam, {IDENTITY}\nrig, cam2, 0.5, 0.5, 0.5, 0.5, 1, 2, 3\n",
        trajectories=VERSION + f"  -7, rig, {IDENTITY}\n1602074877390449152,cam2,{IDENTITY}\n",
        records_camera=VERSION + "1602074877390449152, cam, a b/c.jpg\n\n# x\n3, cam2, d.jpg",
        records_depth=VERSION + "3, deep, d.depth\n",
    )
    data = read_kapture_data(root)
    assert data.sensors["cam"].camera() == Camera("PINHOLE", 640, 480, (500, 500, 320, 240))
    assert data.sensors["cam2"].name == "right"
    assert data.sensors["gps"].params == ("EPSG:4326",)
    assert data.rigs["rig"]["cam2"] == RigidTransform((0.5, 0.5, 0.5, 0.5), (1, 2, 3))
    assert set(data.trajectories) == {(-7, "rig"), (1602074877390449152, "cam2")}
    assert data.records_camera == {(1602074877390449152, "cam"): "a b/c.jpg", (3, "cam2"): "d.jpg"}
    assert data.records_depth == {(3, "deep"): "d.depth"}


def test_windows_line_ends_and_byte_order_marks_are_read(tmp_path: Path) -> None:
    text = (VERSION + "3, cam, a.jpg\n").replace("\n", "\r\n").encode()
    root = make(tmp_path, sensors=b"\xef\xbb\xbf" + SENSORS.encode(), records_camera=text)
    assert read_kapture_data(root).records_camera == {(3, "cam"): "a.jpg"}


@pytest.mark.parametrize(
    ("row", "match"),
    [
        ("1, cam", "expected 3 columns, got 2"),
        ("1, cam, a.jpg, b", "expected 3 columns, got 4"),
        ("1.0, cam, a.jpg", "timestamp '1.0' is not an integer"),
        (", cam, a.jpg", "not an integer"),
        ("1_0, cam, a.jpg", "not an integer"),
        ("1e3, cam, a.jpg", "not an integer"),
        ("9, nocam, a.jpg", "unknown sensor or rig 'nocam'"),
        ("9, deep, a.jpg", "of type 'depth', not 'camera'"),
        ("0, cam, b.jpg", "timestamp 0 of 'cam' is listed twice, first in line 2"),
        ("9, cam, ok.jpg", "'ok.jpg' is listed twice, first in line 2"),
        ("9, cam, ../a.jpg", "leads out"),
        ("9, cam, a/../../b.jpg", "leads out"),
        ("9, cam, /etc/passwd", "absolute"),
        ("9, cam, a\\b.jpg", "backslash"),
        ("9, cam, a\x1f.jpg", "control character"),
        ("9, cam, ", "empty path"),
    ],
)
def test_bad_records_name_file_and_line(tmp_path: Path, row: str, match: str) -> None:
    root = make(tmp_path, records_camera=VERSION + f"0, cam, ok.jpg\n# note\n{row}\n")
    refuse(root, "records_camera.txt:4", match=match)


@pytest.mark.parametrize(
    ("pose", "match"),
    [
        ("1, 0, 0, 0, 0, 0", "expected 9 columns, got 8"),
        ("nan, 0, 0, 0, 0, 0, 0", "'nan' is not finite"),
        ("1, 0, 0, 0, inf, 0, 0", "'inf' is not finite"),
        ("1, 0, 0, 0, 0, -Infinity, 0", "not finite"),
        ("1, 0, 0, 0, 0, 0, 1e400", "not finite"),
        ("0, 0, 0, 0, 0, 0, 0", "not a unit quaternion"),
        ("1.002, 0, 0, 0, 0, 0, 0", "not a unit quaternion"),
        ("0.998, 0, 0, 0, 0, 0, 0", "not a unit quaternion"),
        ("1e200, 0, 0, 0, 0, 0, 0", "not a unit quaternion"),
        ("one, 0, 0, 0, 0, 0, 0", "'one' is not a number"),
        ("1, 0, 0, 0, 0, 1_0, 0", "'1_0' is not a number"),
        ("1, 0, 0, , 0, 0, 0", "some but not all"),
        ("1, 0, 0, 0, 0, , 0", "some but not all"),
    ],
)
def test_bad_poses_name_file_and_line(tmp_path: Path, pose: str, match: str) -> None:
    rows = f"0, cam, {IDENTITY}\n1, cam, {pose}\n"
    refuse(make(tmp_path, trajectories=VERSION + rows), "trajectories.txt:3", match=match)


@pytest.mark.parametrize("pose", [", , , , 1, 2, 3", "1, 0, 0, 0, , ,", " , , , , , , "])
def test_a_pose_without_rotation_or_translation_is_no_pose(tmp_path: Path, pose: str) -> None:
    root = make(tmp_path, trajectories=VERSION + f"0, cam, {IDENTITY}\n1, cam, {pose}\n")
    assert set(read_kapture_data(root).trajectories) == {(0, "cam")}


def test_a_partial_pose_still_counts_as_a_duplicate(tmp_path: Path) -> None:
    root = make(tmp_path, trajectories=VERSION + f"0, cam, {IDENTITY}\n0, cam, , , , , , ,\n")
    refuse(root, "trajectories.txt:3", match="listed twice")


def test_trajectories_of_unknown_devices_are_refused(tmp_path: Path) -> None:
    refuse(
        make(tmp_path, trajectories=VERSION + f"0, rig, {IDENTITY}\n"),
        "trajectories.txt:2",
        match="unknown sensor or rig 'rig'",
    )


def test_almost_unit_quaternions_are_normalised(tmp_path: Path) -> None:
    rows = "0, cam, 1.0009, 0, 0, 0, 0, 0, 0\n1, cam, 0.5, 0.5, 0.5, 0.4999, 0, 0, 0\n"
    poses = read_kapture_data(make(tmp_path, trajectories=VERSION + rows)).trajectories
    assert poses[0, "cam"].quat_wxyz == (1, 0, 0, 0)
    assert abs(np.linalg.norm(poses[1, "cam"].quat_wxyz) - 1) < 1e-15


@pytest.mark.parametrize(
    ("row", "match"),
    [
        ("x, ", "at least 3 columns"),
        (", n, camera, PINHOLE, 640, 480, 500, 500, 320, 240", "empty sensor id"),
        ("cam, n, gnss", "'cam' is listed twice"),
        ("x, n, camera", "without a model"),
        ("x, n, camera, PINHOLLOW, 640, 480, 1, 1, 1, 1", "unknown camera model 'PINHOLLOW'"),
        ("x, n, camera, PINHOLE, 640, 480, 500, 320, 240", "takes 6 parameters .* got 5"),
        ("x, n, camera, PINHOLE, 640, 480, 500, 500, 320, 240, 0", "got 7"),
        ("x, n, camera, PINHOLE, 640, 480, nan, 500, 320, 240", "'nan' is not finite"),
        ("x, n, camera, PINHOLE, 640, 480, 1e999, 500, 320, 240", "not finite"),
        ("x, n, camera, PINHOLE, 640, 480, -1, 500, 320, 240", "not positive"),
        ("x, n, camera, PINHOLE, 640.5, 480, 500, 500, 320, 240", "whole number"),
        ("x, n, camera, PINHOLE, 0, 480, 500, 500, 320, 240", "not positive"),
        ("x, n, depth, PINHOLE, 640, 480", "takes 6 parameters"),
        ("x, n, camera, UNKNOWN_CAMERA, 640", "width and a height"),
    ],
)
def test_bad_sensors_name_file_and_line(tmp_path: Path, row: str, match: str) -> None:
    refuse(make(tmp_path, sensors=SENSORS + row + "\n"), "sensors.txt:7", match=match)


def test_uncalibrated_cameras_are_read_but_have_no_intrinsics(tmp_path: Path) -> None:
    root = make(tmp_path, sensors=SENSORS + "raw, , camera, UNKNOWN_CAMERA, 640, 480\n")
    sensor = read_kapture_data(root).sensors["raw"]
    with pytest.raises(DataError, match="not calibrated"):
        sensor.camera()


@pytest.mark.parametrize(
    ("head", "match"),
    [
        ("# kapture format: 1.0\n", "1.0 is not supported"),
        ("# kapture format: 1.2\n", "1.2 is not supported"),
        ("# kapture format: 11.1\n", "11.1 is not supported"),
        ("", "first line must be"),
        ("# sensors\n", "first line must be"),
    ],
)
def test_only_version_1_1_is_read(tmp_path: Path, head: str, match: str) -> None:
    refuse(make(tmp_path, sensors=SENSORS.replace(VERSION, head)), "sensors.txt:1", match=match)


def test_missing_and_unreadable_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nothing: no such kapture folder"):
        read_kapture_data(tmp_path / "nothing")
    with pytest.raises(DataError, match="sensors.txt: cannot read: the file is missing"):
        read_kapture_data(tmp_path)
    make(tmp_path)
    os.mkfifo(tmp_path / "sensors" / "rigs.txt")  # opening it would wait for ever
    with pytest.raises(DataError, match="rigs.txt: not a plain file"):
        read_kapture_data(tmp_path)


def test_text_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    root = make(tmp_path, records_camera=VERSION.encode() + b"0, cam, a.jpg\n1, cam, \xff.jpg\n")
    refuse(root, "records_camera.txt:3", match="not a text file in UTF-8")


def test_text_files_may_not_be_links_out_of_the_kapture(tmp_path: Path) -> None:
    root = make(tmp_path / "root")
    (tmp_path / "elsewhere.txt").write_text(VERSION)
    (root / "sensors" / "rigs.txt").symlink_to(tmp_path / "elsewhere.txt")
    refuse(root, "rigs.txt", match="link that leaves")
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "sensors").symlink_to(make(tmp_path / "other") / "sensors")
    with pytest.raises(DataError, match="link that leaves"):
        read_kapture_data(tmp_path / "linked")


# ---------------------------------------------------------------------------------------- rigs


def test_sensors_that_were_taken_out_are_left_out_of_rigs(tmp_path: Path) -> None:
    rigs = VERSION + f"rig, gone, {IDENTITY}\nrig, cam, {IDENTITY}\n"
    assert set(read_kapture_data(make(tmp_path, rigs=rigs)).rigs["rig"]) == {"cam"}


@pytest.mark.parametrize(
    ("rows", "line", "match"),
    [
        ([f"cam2, cam, {IDENTITY}"], 2, "also a sensor id"),
        ([f"r, cam, {IDENTITY}"] * 2, 3, "twice"),
        ([f", cam, {IDENTITY}"], 2, "empty"),
        ([f"r, r, {IDENTITY}"], 2, "contains itself"),
        ([f"a, b, {IDENTITY}", f"b, c, {IDENTITY}", f"c, a, {IDENTITY}"], 4, "contains itself"),
        ([f"r, cam, {IDENTITY[:-3]}"], 2, "expected 9 columns"),
    ],
)
def test_bad_rigs_name_file_and_line(
    tmp_path: Path, rows: list[str], line: int, match: str
) -> None:
    root = make(tmp_path, rigs=VERSION + "\n".join(rows) + "\n")
    refuse(root, f"rigs.txt:{line}", match=match)


def test_rigs_may_share_rigs(tmp_path: Path) -> None:
    rows = [f"a, c, {IDENTITY}", f"b, c, {IDENTITY}", f"c, cam, {IDENTITY}", f"b, a, {IDENTITY}"]
    root = make(tmp_path, rigs=VERSION + "\n".join(rows) + "\n")
    assert set(read_kapture_data(root).rigs) == {"a", "b", "c"}


# ------------------------------------------------------------------------------------- writing

FINITE = st.floats(-1e9, 1e9, allow_nan=False)
NAMES = st.text(st.characters(codec="utf-8", exclude_characters=",\\/#"), min_size=1).filter(
    lambda s: s == s.strip() and s not in (".", "..") and all(31 < ord(c) != 127 for c in s)
)


@st.composite
def poses(draw: st.DrawFn) -> RigidTransform:
    quat = np.array(draw(st.tuples(*[st.floats(-1, 1)] * 4)))
    if np.linalg.norm(quat) < 1e-3:
        quat = np.array([1.0, 0, 0, 0])
    quat /= np.linalg.norm(quat)
    return RigidTransform(tuple(quat.tolist()), draw(st.tuples(FINITE, FINITE, FINITE)))


@st.composite
def kaptures(draw: st.DrawFn) -> KaptureData:
    data = KaptureData()
    ids = draw(st.lists(NAMES, min_size=2, max_size=5, unique=True))
    for sensor_id in ids[1:]:
        camera = Camera("SIMPLE_PINHOLE", 640, 480, (draw(st.floats(1, 5000)), 320.1, 240.7))
        data.sensors[sensor_id] = Sensor.from_camera(camera, name=draw(st.just("") | NAMES))
    data.rigs[ids[0]] = {sensor_id: draw(poses()) for sensor_id in ids[1:]}
    times = st.integers(-(10**20), 10**20)
    for key in draw(st.lists(st.tuples(times, st.sampled_from(ids)), max_size=4, unique=True)):
        data.trajectories[key] = draw(poses())
    images = draw(st.lists(NAMES, max_size=4, unique=True))
    for number, image in enumerate(images):
        data.records_camera[number, draw(st.sampled_from(ids[1:]))] = f"folder/{image}"
    return data


@given(kaptures())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
def test_what_is_written_is_read_back_equal(tmp_path: Path, data: KaptureData) -> None:
    write_sensors(tmp_path, data)
    assert read_kapture_data(tmp_path) == data
    before = {p.name: p.read_bytes() for p in (tmp_path / "sensors").iterdir()}
    write_sensors(tmp_path, read_kapture_data(tmp_path))
    assert {p.name: p.read_bytes() for p in (tmp_path / "sensors").iterdir()} == before


def test_rows_are_sorted_whatever_the_order_they_came_in(tmp_path: Path) -> None:
    data = read_kapture_data(make(tmp_path / "in"))
    for time in (10, 9, -1):
        data.records_camera[time, "cam"] = f"{time}.jpg"
        data.trajectories[np.int64(time), "cam"] = RigidTransform.identity()  # type: ignore[index]
    write_sensors(tmp_path / "a", data)
    data.sensors = dict(reversed(data.sensors.items()))
    data.records_camera = dict(reversed(data.records_camera.items()))
    write_sensors(tmp_path / "b", data)
    for name in ("sensors", "records_camera", "trajectories"):
        a, b = ((tmp_path / x / "sensors" / f"{name}.txt").read_text() for x in "ab")
        assert a == b
    assert [line.split(",")[0] for line in a.splitlines()[2:]] == ["-1", "9", "10"]


def test_a_table_that_became_empty_loses_its_file(tmp_path: Path) -> None:
    data = read_kapture_data(make(tmp_path / "in"))
    data.trajectories[0, "cam"] = RigidTransform.identity()
    write_sensors(tmp_path, data)
    data.trajectories.clear()
    write_sensors(tmp_path, data)
    assert read_kapture_data(tmp_path).trajectories == {}


def _broken(change: str) -> KaptureData:
    data = KaptureData(sensors={"cam": Sensor("", "camera", ("UNKNOWN_CAMERA", "4", "3"))})
    match change:
        case "comma":
            data.sensors["a,b"] = data.sensors["cam"]
        case "line break":
            data.sensors["a\nb"] = data.sensors["cam"]
        case "space":
            data.sensors["a "] = data.sensors["cam"]
        case "comment":
            data.sensors["#a"] = data.sensors["cam"]
        case "model":
            data.sensors["cam"] = Sensor("", "camera", ("PINHOLE", "4", "3"))
        case "path":
            data.records_camera[0, "cam"] = "../a.jpg"
        case "same image":
            data.records_camera.update({(0, "cam"): "a.jpg", (1, "cam"): "a.jpg"})
        case "no sensor":
            data.records_camera[0, "x"] = "a.jpg"
        case "no device":
            data.trajectories[0, "x"] = RigidTransform.identity()
        case "nan":
            data.trajectories[0, "cam"] = RigidTransform((1, 0, 0, 0), (float("nan"), 0, 0))
        case "quaternion":
            data.trajectories[0, "cam"] = RigidTransform((1, 1, 0, 0), (0, 0, 0))
        case "empty rig":
            data.rigs["rig"] = {}
            data.trajectories[0, "rig"] = RigidTransform.identity()
        case "rig member":
            data.rigs["rig"] = {"x": RigidTransform.identity()}
    return data


@pytest.mark.parametrize(
    "change",
    ["comma", "line break", "space", "comment", "model", "path", "same image", "no sensor"]
    + ["no device", "nan", "quaternion", "empty rig", "rig member"],
)
def test_what_could_not_be_read_back_is_not_written(tmp_path: Path, change: str) -> None:
    with pytest.raises(DataError):
        write_sensors(tmp_path, _broken(change))
    assert list(tmp_path.rglob("*.txt")) == []
