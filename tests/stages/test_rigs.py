"""Images of one moment on a rig: units, and poses against composing kapture's own pose objects."""

from __future__ import annotations

import kapture
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.stages.rigs import Unit, poses_through_rig, query_units
from megloc_kapture.values import Camera, Pose, RigidTransform

CAMERA = Sensor.from_camera(Camera("SIMPLE_PINHOLE", 100, 80, (90.0, 50.0, 40.0)))


def random_pose(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    return RigidTransform.from_matrix(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))


@pytest.fixture
def data() -> KaptureData:
    """Two moments of a car with three cameras, and a telephone that is on no rig."""
    data = KaptureData(sensors={name: CAMERA for name in ("left", "rear", "right", "phone")})
    data.rigs["car"] = {name: random_pose(k) for k, name in enumerate(("left", "rear", "right"))}
    for timestamp in (1, 2):
        for name in data.sensors:
            data.records_camera[timestamp, name] = f"{name}/{timestamp}.jpg"
    return data


def test_a_sibling_gives_its_pose_through_the_rig(data: KaptureData) -> None:
    left = random_pose(9)
    found = poses_through_rig(data, {"left/1.jpg": Pose(left, 20, 12)})
    assert {image: source for image, (source, _) in found.items()} == {
        "rear/1.jpg": "left/1.jpg",
        "right/1.jpg": "left/1.jpg",
    }
    rig = {
        name: kapture.PoseTransform(list(pose.quat_wxyz), list(pose.translation))
        for name, pose in data.rigs["car"].items()
    }
    expected = kapture.PoseTransform.compose(
        [
            rig["rear"],
            rig["left"].inverse(),
            kapture.PoseTransform(list(left.quat_wxyz), list(left.translation)),
        ]
    )
    pose = found["rear/1.jpg"][1]
    np.testing.assert_allclose(pose.translation, expected.t_raw, atol=1e-12)
    np.testing.assert_allclose(abs(np.dot(pose.quat_wxyz, expected.r_raw)), 1, atol=1e-12)


def test_the_sibling_with_the_most_inliers_counts(data: KaptureData) -> None:
    localized = {
        "left/1.jpg": Pose(random_pose(5), 50, 30),
        "right/1.jpg": Pose(random_pose(6), 50, 31),
        "left/2.jpg": Pose(random_pose(7), 50, 8),
        "right/2.jpg": Pose(random_pose(8), 50, 8),
        "phone/2.jpg": Pose(random_pose(8), 500, 400),
    }
    found = poses_through_rig(data, localized)
    assert {image: source for image, (source, _) in found.items()} == {
        "rear/1.jpg": "right/1.jpg",
        "rear/2.jpg": "left/2.jpg",
    }


def test_without_a_rig_nothing_is_derived(data: KaptureData) -> None:
    data.rigs.clear()
    assert poses_through_rig(data, {"left/1.jpg": Pose(random_pose(5), 50, 30)}) == {}


# ---------------------------------------------------------------------------- units

SMALL = Sensor.from_camera(Camera("SIMPLE_PINHOLE", 64, 48, (50.0, 32.0, 24.0)))
LEFT = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.3, 0.0, 0.0))
REAR = RigidTransform((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def moments() -> KaptureData:
    records = {
        (1, "left"): "left/1.png",
        (1, "rear"): "rear/1.png",
        (1, "phone"): "a/1.png",
        (2, "left"): "left/2.png",
        (3, "rear"): "rear/3.png",
        (3, "left"): "left/3.png",
    }
    return KaptureData(
        sensors={"left": SMALL, "rear": SMALL, "phone": SMALL},
        rigs={"car": {"left": LEFT, "rear": REAR}},
        records_camera=records,
    )


def names(units: list[Unit]) -> list[tuple[str, ...]]:
    return [tuple(image for image, _ in unit) for unit in units]


def test_each_image_by_itself() -> None:
    units = query_units(moments(), rigs=False)
    assert names(units) == [(name,) for name in moments().image_names()]
    assert all(unit[0][1] == RigidTransform.identity() for unit in units)


def test_cameras_of_a_moment_are_together() -> None:
    units = query_units(moments(), rigs=True)
    assert names(units) == [
        ("a/1.png",),
        ("left/1.png", "rear/1.png"),
        ("left/2.png",),
        ("left/3.png", "rear/3.png"),
    ]
    assert [pose for _, pose in units[1]] == [LEFT, REAR]
    # the other camera of the moment is missing: a camera by itself needs no rig
    assert units[2][0][1] == RigidTransform.identity()
    assert sorted(name for unit in names(units) for name in unit) == moments().image_names()
