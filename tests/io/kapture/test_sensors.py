"""Sensors, rigs, trajectories and records: strict reading, exact writing, lookups."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.format import KaptureData, Sensor
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


def test_everything_is_read(tmp_path: Path) -> None:
    records = VERSION + "1602074877390449152, cam, a b/c.jpg\n\n# x\n3, cam2, d.jpg"
    root = make(
        tmp_path,
        sensors=b"\xef\xbb\xbf" + SENSORS.encode(),
        rigs=VERSION + f"rig, cam, {IDENTITY}\nrig, cam2, 0.5, 0.5, 0.5, 0.5, 1, 2, 3\n",
        trajectories=VERSION + f"  -7, rig, {IDENTITY}\n1602074877390449152,cam2,{IDENTITY}\n",
        records_camera=records.replace("\n", "\r\n"),
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


# what stands before a row that is refused
BEFORE = {
    "sensors": SENSORS,
    "records_camera": VERSION + "0, cam, ok.jpg\n# note\n",
    "trajectories": VERSION + f"0, cam, {IDENTITY}\n",
    "rigs": VERSION + f"rig, cam, {IDENTITY}\n",
}
REFUSED = {
    "records_camera": {
        "1, cam": "expected 3 columns, got 2",
        "1.0, cam, a.jpg": "invalid literal for int.* '1.0'",
        "9, nocam, a.jpg": "unknown sensor or rig 'nocam'",
        "9, deep, a.jpg": "of type 'depth', not 'camera'",
        "0, cam, b.jpg": "timestamp 0 of 'cam' is listed twice",
        "9, cam, ok.jpg": "'ok.jpg' is listed twice",
        "9, cam, a/../../b.jpg": "leads out",
    },
    "trajectories": {
        "1, cam, 1, 0, 0, 0, 0, 0": "expected 9 columns, got 8",
        "1, cam, nan, 0, 0, 0, 0, 0, 0": "finite numbers qw qx .* got 'nan 0 ",
        "1, cam, 0.998, 0, 0, 0, 0, 0, 0": "not a unit quaternion",
        "1, cam, 1, 0, 0, , 0, 0, 0": "some but not all",
        f"0, rig, {IDENTITY}": "unknown sensor or rig 'rig'",
    },
    "sensors": {
        "x, ": "at least 3 columns",
        "cam, n, gnss": "'cam' is empty or listed twice",
        "x, n, camera": "expected a camera model, width, height",
        "x, n, camera, PINHOLLOW, 640, 480, 1, 1, 1, 1": "unknown camera model 'PINHOLLOW'",
        "x, n, camera, PINHOLE, 640, 480, 500, 320, 240": "takes 4 parameters, got 3",
        "x, n, camera, PINHOLE, 640, 480, nan, 500, 320, 240": "must be finite",
        "x, n, camera, PINHOLE, 640.5, 480, 500, 500, 320, 240": "whole pixels",
        "x, n, camera, UNKNOWN_CAMERA, 640": "width and a height",
    },
    "rigs": {
        f"cam2, cam, {IDENTITY}": "also a sensor id",
        f"rig, cam, {IDENTITY}": "twice",
    },
}


@pytest.mark.parametrize(
    ("file", "row", "match"),
    [(file, row, match) for file, rows in REFUSED.items() for row, match in rows.items()],
)
def test_what_is_wrong_is_named_with_file_and_line(
    tmp_path: Path, file: str, row: str, match: str
) -> None:
    content = BEFORE[file] + row + "\n"
    root = make(tmp_path, **{file: content})
    with pytest.raises(DataError, match=match) as caught:
        read_kapture_data(root)
    assert f"{root}/sensors/{file}.txt:{len(content.splitlines())}: " in str(caught.value)


@pytest.mark.parametrize(
    ("head", "match"),
    [
        ("# kapture format: 1.2\n", "1.2 is not supported"),
        ("# kapture format: 11.1\n", "11.1 is not supported"),
        ("", "first line must be"),
        ("# sensors\n", "first line must be"),
    ],
)
def test_newer_versions_are_refused(tmp_path: Path, head: str, match: str) -> None:
    root = make(tmp_path, sensors=SENSORS.replace(VERSION, head))
    with pytest.raises(DataError, match=rf"sensors\.txt:1: .*{match}"):
        read_kapture_data(root)


def test_sensors_of_version_1_0_are_read(tmp_path: Path) -> None:
    root = make(tmp_path, sensors=SENSORS.replace("1.1", "1.0"))
    assert set(read_kapture_data(root).sensors) == {"cam", "cam2", "deep", "gps"}


@pytest.mark.parametrize("pose", [", , , , 1, 2, 3", "1, 0, 0, 0, , ,", " , , , , , , "])
def test_a_pose_without_rotation_or_translation_is_no_pose(tmp_path: Path, pose: str) -> None:
    root = make(tmp_path, trajectories=VERSION + f"0, cam, {IDENTITY}\n1, cam, {pose}\n")
    assert set(read_kapture_data(root).trajectories) == {(0, "cam")}


def test_almost_unit_quaternions_are_normalised(tmp_path: Path) -> None:
    rows = "0, cam, 1.0009, 0, 0, 0, 0, 0, 0\n1, cam, 0.5, 0.5, 0.5, 0.4999, 0, 0, 0\n"
    poses = read_kapture_data(make(tmp_path, trajectories=VERSION + rows)).trajectories
    assert poses[0, "cam"].quat_wxyz == (1, 0, 0, 0)
    assert abs(np.linalg.norm(poses[1, "cam"].quat_wxyz) - 1) < 1e-15


def test_sensors_that_were_taken_out_are_left_out_of_rigs(tmp_path: Path) -> None:
    rigs = VERSION + f"rig, gone, {IDENTITY}\nrig, cam, {IDENTITY}\n"
    assert set(read_kapture_data(make(tmp_path, rigs=rigs)).rigs["rig"]) == {"cam"}


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
    for number, image in enumerate(draw(st.lists(NAMES, max_size=4, unique=True))):
        data.records_camera[number, draw(st.sampled_from(ids[1:]))] = f"folder/{image}"
    return data


def written(root: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in (root / "sensors").iterdir()}


@given(kaptures())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
def test_what_is_written_is_read_back_equal(tmp_path: Path, data: KaptureData) -> None:
    """Also where the last example had rows in a table that is empty now."""
    write_sensors(tmp_path, data)
    assert read_kapture_data(tmp_path) == data
    before = written(tmp_path)
    write_sensors(tmp_path, read_kapture_data(tmp_path))
    assert written(tmp_path) == before


# ------------------------------------------------------------------------------------- lookups


CAMERA = Camera("PINHOLE", 640, 480, (500.1, 501.2, 320.3, 240.4))


def turn(angle: float, *translation: float) -> RigidTransform:
    """Rotation about y."""
    rotation = Rotation.from_euler("y", angle).as_matrix()
    return RigidTransform.from_matrix(rotation, np.array(translation, float))


def two_cameras_on_nested_rigs() -> KaptureData:
    sensor = Sensor.from_camera(CAMERA)
    return KaptureData(
        sensors={"left": sensor, "right": sensor},
        rigs={
            "head": {"left": RigidTransform.identity(), "right": turn(0.1, -0.5, 0, 0)},
            "car": {"head": turn(0.3, 0, -1.5, 0.2)},
        },
        trajectories={(1, "car"): turn(0.7, 10, 0, 5), (2, "head"): turn(-0.2, 1, 2, 3)},
        records_camera={(1, "left"): "l1.jpg", (1, "right"): "r1.jpg"}
        | {(2, "right"): "r2.jpg", (3, "left"): "l3.jpg"},
    )


def test_poses_come_through_nested_rigs() -> None:
    data = two_cameras_on_nested_rigs()
    head, right = data.rigs["car"]["head"], data.rigs["head"]["right"]
    points = np.random.default_rng(0).normal(size=(5, 3))
    on_head = head.apply(data.trajectories[1, "car"].apply(points))
    found, expected = data.poses(), {"l1.jpg": on_head, "r1.jpg": right.apply(on_head)}
    expected["r2.jpg"] = right.apply(data.trajectories[2, "head"].apply(points))
    assert list(found) == list(expected) and data.cam_from_world("l3.jpg") is None
    for image, in_camera in expected.items():
        np.testing.assert_allclose(found[image].apply(points), in_camera, atol=1e-12)
    own = turn(1.0, 7, 7, 7)
    data.trajectories[1, "right"] = own
    assert data.cam_from_world("r1.jpg") == own  # comes before its rig's


def test_changes_of_the_dicts_are_noticed() -> None:
    data = two_cameras_on_nested_rigs()
    assert data.record_of("l1.jpg") == (1, "left")
    data.records_camera[1, "left"] = "new.jpg"  # the number of records stays the same
    assert data.record_of("new.jpg") == (1, "left")
    with pytest.raises(DataError, match="'l1.jpg'"):
        data.record_of("l1.jpg")
    del data.records_camera[1, "right"]
    with pytest.raises(DataError):
        data.record_of("r1.jpg")
    data.records_camera = {(5, "left"): "only.jpg"}
    assert data.image_names() == ["only.jpg"]
    assert data.cam_from_world("only.jpg") is None
    data.rigs["third"] = {"left": turn(0.5, 0, 0, 0)}
    data.trajectories[5, "third"] = RigidTransform.identity()
    assert data.cam_from_world("only.jpg") is not None


def test_cameras_are_found_by_image() -> None:
    data = two_cameras_on_nested_rigs()
    assert data.camera_of("r2.jpg") == CAMERA
    with pytest.raises(DataError, match="no image 'x.jpg'"):
        data.camera_of("x.jpg")
    data.sensors["right"] = Sensor("", "camera", ("UNKNOWN_CAMERA", "1", "1"))
    with pytest.raises(DataError, match="'right' of image 'r2.jpg': camera is not calibrated"):
        data.camera_of("r2.jpg")


def test_sensors_return_the_camera_they_were_made_of() -> None:
    awkward = Camera("SIMPLE_RADIAL", 7, 5, (1 / 3, 0.1 + 0.2, 1e-300, -5e-324))
    sensor = Sensor.from_camera(awkward, name="n", sensor_type="depth")
    assert sensor.camera() == awkward
    assert (sensor.name, sensor.sensor_type) == ("n", "depth")
    of_numpy = Camera("SIMPLE_PINHOLE", np.int64(7), np.int32(5), np.array([1.5, 2, 3]))  # type: ignore[arg-type]
    assert Sensor.from_camera(of_numpy).params == ("SIMPLE_PINHOLE", "7", "5", "1.5", "2", "3")
    with pytest.raises(DataError, match="'gnss'"):
        Sensor("", "gnss", ()).camera()
