"""Images of a rig at one timestamp, with poses against compositions by kapture."""

from __future__ import annotations

from dataclasses import replace

import kapture
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.stages.scene import depth_records, poses_through_rig, query_units
from megloc_kapture.values import Camera, Pose, RigidTransform

CAMERA = Sensor.from_camera(Camera("SIMPLE_PINHOLE", 100, 80, (90.0, 50.0, 40.0)))


def random_pose(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    return RigidTransform.from_matrix(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))


@pytest.fixture
def data() -> KaptureData:
    """A car with three cameras at two timestamps, with one at a third, and a phone."""
    data = KaptureData(sensors={name: CAMERA for name in ("left", "rear", "right", "phone")})
    data.rigs["car"] = {name: random_pose(k) for k, name in enumerate(("left", "rear", "right"))}
    for timestamp in (1, 2):
        for name in data.sensors:
            data.records_camera[timestamp, name] = f"{name}/{timestamp}.jpg"
    data.records_camera[3, "left"] = "left/3.jpg"
    return data


def kaptures(pose: RigidTransform) -> kapture.PoseTransform:
    return kapture.PoseTransform(list(pose.quat_wxyz), list(pose.translation))


def test_poses_are_carried_to_other_cameras_of_the_rig(data: KaptureData) -> None:
    left = random_pose(9)
    found = poses_through_rig(data, {"left/1.jpg": Pose(left, 20, 12)})
    sources = {image: source for image, (source, _) in found.items()}
    assert sources == {"rear/1.jpg": "left/1.jpg", "right/1.jpg": "left/1.jpg"}
    rig = {name: kaptures(pose) for name, pose in data.rigs["car"].items()}
    expected = kapture.PoseTransform.compose([rig["rear"], rig["left"].inverse(), kaptures(left)])
    pose = found["rear/1.jpg"][1]
    np.testing.assert_allclose(pose.translation, expected.t_raw, atol=1e-12)
    np.testing.assert_allclose(abs(np.dot(pose.quat_wxyz, expected.r_raw)), 1, atol=1e-12)
    data.rigs.clear()
    assert poses_through_rig(data, {"left/1.jpg": Pose(left, 20, 12)}) == {}


def test_nested_rigs_equal_one_rig(data: KaptureData) -> None:
    flat = query_units(data, rigs=True)
    localized = {"left/1.jpg": Pose(random_pose(9), 20, 12)}
    expected = poses_through_rig(data, localized)
    car, front = data.rigs["car"], random_pose(8)
    nested = {name: car.pop(name) @ front.inverse() for name in ("left", "rear")}
    data.rigs = {"car": {**car, "front": front}, "front": nested}
    for unit, other in zip(query_units(data, rigs=True), flat, strict=True):
        for (image, pose), (other_image, expected_pose) in zip(unit, other, strict=True):
            assert image == other_image
            np.testing.assert_allclose(pose.matrix(), expected_pose.matrix(), atol=1e-12)
    found = poses_through_rig(data, localized)
    assert found.keys() == expected.keys()
    for image, (_, pose) in found.items():
        np.testing.assert_allclose(pose.matrix(), expected[image][1].matrix(), atol=1e-12)
    data.sensors["depth"] = replace(CAMERA, sensor_type="depth")
    data.rigs["car"]["depth"] = random_pose(7)
    data.records_depth[1, "depth"] = "1.depth"
    of_image = depth_records(data)
    assert of_image.keys() == {"left/1.jpg", "rear/1.jpg", "right/1.jpg"}
    to_depth = data.rigs["front"]["left"] @ front @ random_pose(7).inverse()
    found_depth = of_image["left/1.jpg"].image_from_depth.matrix()
    np.testing.assert_allclose(found_depth, to_depth.matrix(), atol=1e-12)
    data.rigs["front"]["car"] = front
    data.rigs["roof"] = {"car": front}
    with pytest.raises(DataError, match="contains itself"):
        query_units(data, rigs=True)


def test_the_camera_with_most_inliers_gives_the_pose(data: KaptureData) -> None:
    inliers = {"left/1": 30, "right/1": 31, "left/2": 8, "right/2": 8, "phone/2": 400}
    localized = {f"{n}.jpg": Pose(random_pose(5), 500, count) for n, count in inliers.items()}
    sources = {image: source for image, (source, _) in poses_through_rig(data, localized).items()}
    assert sources == {"rear/1.jpg": "right/1.jpg", "rear/2.jpg": "left/2.jpg"}


def test_units_are_images_or_the_cameras_of_a_rig(data: KaptureData) -> None:
    alone = query_units(data, rigs=False)
    same = RigidTransform.identity()
    assert alone == [((name, same),) for name in data.image_names()]
    together = query_units(data, rigs=True)
    of_car = [tuple(f"{name}/{t}.jpg" for name in ("left", "rear", "right")) for t in (1, 2)]
    expected = [*of_car, ("left/3.jpg",), ("phone/1.jpg",), ("phone/2.jpg",)]
    assert [tuple(image for image, _ in unit) for unit in together] == expected
    assert [pose for _, pose in together[0]] == list(data.rigs["car"].values())
    # a single camera needs no rig
    assert together[2] == (("left/3.jpg", same),)
