"""Lookups over sensors, rigs and trajectories."""

from __future__ import annotations

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.data import KaptureData, Sensor
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("PINHOLE", 640, 480, (500.1, 501.2, 320.3, 240.4))


def turn(angle: float, *translation: float) -> RigidTransform:
    """Rotation about y."""
    half = angle / 2
    return RigidTransform((float(np.cos(half)), 0.0, float(np.sin(half)), 0.0), translation)  # type: ignore[arg-type]


def two_cameras_on_nested_rigs() -> KaptureData:
    sensor = Sensor.from_camera(CAMERA)
    return KaptureData(
        sensors={"left": sensor, "right": sensor},
        rigs={
            "head": {"left": RigidTransform.identity(), "right": turn(0.1, -0.5, 0, 0)},
            "car": {"head": turn(0.3, 0, -1.5, 0.2)},
        },
        trajectories={(1, "car"): turn(0.7, 10, 0, 5), (2, "head"): turn(-0.2, 1, 2, 3)},
        records_camera={
            (1, "left"): "l1.jpg",
            (1, "right"): "r1.jpg",
            (2, "right"): "r2.jpg",
            (3, "left"): "l3.jpg",
        },
    )


def assert_same(pose: RigidTransform | None, matrix: np.ndarray) -> None:
    assert pose is not None
    assert np.allclose(pose.rotation_matrix(), matrix[:3, :3], atol=1e-12)
    assert np.allclose(pose.translation, matrix[:3, 3], atol=1e-12)


def as_matrix(pose: RigidTransform) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = pose.rotation_matrix()
    matrix[:3, 3] = pose.translation
    return matrix


def test_poses_come_through_nested_rigs() -> None:
    data = two_cameras_on_nested_rigs()
    car = as_matrix(data.trajectories[1, "car"])
    head = as_matrix(data.rigs["car"]["head"])
    right = as_matrix(data.rigs["head"]["right"])
    assert_same(data.cam_from_world("r1.jpg"), right @ head @ car)
    assert_same(data.cam_from_world("l1.jpg"), head @ car)
    assert_same(data.cam_from_world("r2.jpg"), right @ as_matrix(data.trajectories[2, "head"]))
    assert data.cam_from_world("l3.jpg") is None
    assert list(data.poses()) == ["l1.jpg", "r1.jpg", "r2.jpg"]


def test_a_camera_s_own_pose_comes_before_its_rig_s() -> None:
    data = two_cameras_on_nested_rigs()
    own = turn(1.0, 7, 7, 7)
    data.trajectories[1, "right"] = own
    assert data.cam_from_world("r1.jpg") == own


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


def test_image_names_are_identities() -> None:
    data = two_cameras_on_nested_rigs()
    data.records_camera[9, "left"] = "l1.jpg"
    with pytest.raises(DataError, match="two records"):
        data.record_of("l1.jpg")


def test_rigs_that_contain_themselves_are_refused() -> None:
    data = two_cameras_on_nested_rigs()
    data.rigs["head"]["car"] = RigidTransform.identity()
    with pytest.raises(DataError, match="contains itself"):
        data.cam_from_world("l3.jpg")


def test_sensors_return_the_camera_they_were_made_of() -> None:
    awkward = Camera("SIMPLE_RADIAL", 7, 5, (1 / 3, 0.1 + 0.2, 1e-300, -5e-324))
    sensor = Sensor.from_camera(awkward, name="n", sensor_type="depth")
    assert sensor.camera() == awkward
    assert (sensor.name, sensor.sensor_type) == ("n", "depth")
    of_numpy = Camera("SIMPLE_PINHOLE", np.int64(7), np.int32(5), np.array([1.5, 2, 3]))  # type: ignore[arg-type]
    assert Sensor.from_camera(of_numpy).params == ("SIMPLE_PINHOLE", "7", "5", "1.5", "2", "3")
    with pytest.raises(DataError, match="'gnss'"):
        Sensor("", "gnss", ()).camera()
