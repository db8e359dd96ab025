"""Sensors, rigs, trajectories and records: reading, exact round trips, lookups."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from poses import rigid

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.sensors import KaptureData, Sensor, read_kapture_data, write_sensors
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


def read(root: Path, **files: str | bytes) -> KaptureData:
    """Read a kapture of a correct sensors.txt and the given other files."""
    folder = root / "sensors"
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in {"sensors": SENSORS, **files}.items():
        data = content.encode() if isinstance(content, str) else content
        (folder / f"{name}.txt").write_bytes(data)
    return read_kapture_data(root)


def test_line_ends_comments_spaces_and_byte_order_marks_do_not_matter(tmp_path: Path) -> None:
    records = VERSION + "1602074877390449152, cam, a b/c.jpg\n\n# x\n3, cam2, d.jpg"
    data = read(
        tmp_path,
        sensors=b"\xef\xbb\xbf" + SENSORS.encode(),
        trajectories=VERSION + f"  -7, cam, {IDENTITY}\n1602074877390449152,cam2,{IDENTITY}\n",
        records_camera=records.replace("\n", "\r\n"),
    )
    assert set(data.sensors) == {"cam", "cam2", "deep", "gps"}
    assert set(data.trajectories) == {(-7, "cam"), (1602074877390449152, "cam2")}
    assert data.records_camera == {(1602074877390449152, "cam"): "a b/c.jpg", (3, "cam2"): "d.jpg"}


def test_version_1_0_unlisted_sensors_and_almost_unit_quaternions_are_read(tmp_path: Path) -> None:
    data = read(
        tmp_path,
        sensors=SENSORS.replace("1.1", "1.0"),
        rigs=VERSION + f"rig, gone, {IDENTITY}\nrig, cam, {IDENTITY}\n",
        trajectories=VERSION + "0, cam, 0, 1.0009, 0, 0, 0, 0, 0\n",
    )
    assert set(data.sensors) == {"cam", "cam2", "deep", "gps"}
    assert set(data.rigs["rig"]) == {"cam"}
    assert data.trajectories[0, "cam"].quat_wxyz == (0, 1, 0, 0)


def test_a_table_that_is_empty_now_is_removed(tmp_path: Path, nested: KaptureData) -> None:
    write_sensors(tmp_path, nested)
    fewer = KaptureData(sensors=nested.sensors, records_camera={(1, "left"): "l1.jpg"})
    write_sensors(tmp_path, fewer)
    assert read_kapture_data(tmp_path) == fewer


# ------------------------------------------------------------------------------------- lookups

CAMERA = Camera("PINHOLE", 640, 480, (500.1, 501.2, 320.3, 240.4))


def turn(angle: float, *translation: float) -> RigidTransform:
    """Rotation about y."""
    return rigid([0.0, angle, 0.0], translation)


@pytest.fixture
def nested() -> KaptureData:
    """Two cameras on a head, which is on a car."""
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


def test_poses_are_composed_through_nested_rigs(nested: KaptureData) -> None:
    head, right = nested.rigs["car"]["head"], nested.rigs["head"]["right"]
    points = np.random.default_rng(0).normal(size=(5, 3))
    on_head = head.apply(nested.trajectories[1, "car"].apply(points))
    expected = {"l1.jpg": on_head, "r1.jpg": right.apply(on_head)}
    expected["r2.jpg"] = right.apply(nested.trajectories[2, "head"].apply(points))
    actual = nested.poses()
    assert list(actual) == list(expected) and nested.cam_from_world("l3.jpg") is None
    for image, in_camera in expected.items():
        np.testing.assert_allclose(actual[image].apply(points), in_camera, atol=1e-12)


def test_a_pose_of_the_camera_takes_precedence_over_its_rig(nested: KaptureData) -> None:
    nested.trajectories[1, "right"] = turn(1.0, 7, 7, 7)
    assert nested.cam_from_world("r1.jpg") == turn(1.0, 7, 7, 7)


def test_lookups_find_new_records_and_rigs(nested: KaptureData) -> None:
    assert nested.record_of("l1.jpg") == (1, "left")
    nested.records_camera[5, "left"] = "only.jpg"
    assert nested.record_of("only.jpg") == (5, "left")
    assert nested.cam_from_world("only.jpg") is None
    nested.rigs["third"] = {"left": turn(0.5, 0, 0, 0)}
    nested.trajectories[5, "third"] = RigidTransform.identity()
    assert nested.cam_from_world("only.jpg") is not None


def test_the_camera_of_an_image_is_returned_or_its_lack_named(nested: KaptureData) -> None:
    assert nested.camera_of("r2.jpg") == CAMERA
    with pytest.raises(DataError, match="no image 'x.jpg'"):
        nested.camera_of("x.jpg")
    nested.sensors["right"] = Sensor("", "camera", ("UNKNOWN_CAMERA", "1", "1"))
    with pytest.raises(DataError, match="'right' of image 'r2.jpg': camera is not calibrated"):
        nested.camera_of("r2.jpg")


def test_a_sensor_keeps_every_digit_of_its_camera() -> None:
    awkward = Camera("SIMPLE_RADIAL", 7, 5, (1 / 3, 0.1 + 0.2, 1e-300, -5e-324))
    assert Sensor.from_camera(awkward).camera() == awkward
    of_numpy = Camera("SIMPLE_PINHOLE", np.int64(7), np.int32(5), np.array([1.5, 2, 3]))  # type: ignore[arg-type]
    assert Sensor.from_camera(of_numpy).params == ("SIMPLE_PINHOLE", "7", "5", "1.5", "2", "3")
    with pytest.raises(DataError, match="'gnss'"):
        Sensor("", "gnss", ()).camera()
