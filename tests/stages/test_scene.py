"""Rigs and the map index: poses of other cameras, and an index shared by processes."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import kapture
import numpy as np
import pytest
from poses import random_pose

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import (
    KaptureData,
    KaptureFolder,
    Sensor,
    write_observations,
    write_points3d,
)
from megloc_kapture.io.kapture.points import write_point_covariances
from megloc_kapture.localization.map_index import MapIndex
from megloc_kapture.stages.scene import (
    index_map,
    open_index,
    poses_through_rig,
    query_units,
    shared_index,
    with_noise,
)
from megloc_kapture.values import Camera, Pose, RigidTransform

CAMERA = Sensor.from_camera(Camera("SIMPLE_PINHOLE", 100, 80, (90.0, 50.0, 40.0)))


@pytest.fixture
def data() -> KaptureData:
    """A car with three cameras at two timestamps, with one at a third, and a phone."""
    data = KaptureData(sensors={name: CAMERA for name in ("left", "rear", "right", "phone")})
    data.rigs["car"] = {
        name: random_pose(np.random.default_rng(k))
        for k, name in enumerate(("left", "rear", "right"))
    }
    for timestamp in (1, 2):
        for name in data.sensors:
            data.records_camera[timestamp, name] = f"{name}/{timestamp}.jpg"
    data.records_camera[3, "left"] = "left/3.jpg"
    return data


def kaptures(pose: RigidTransform) -> kapture.PoseTransform:
    return kapture.PoseTransform(list(pose.quat_wxyz), list(pose.translation))


def test_poses_are_carried_to_other_cameras_of_the_rig(data: KaptureData) -> None:
    left = random_pose(np.random.default_rng(9))
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
    localized = {"left/1.jpg": Pose(random_pose(np.random.default_rng(9)), 20, 12)}
    expected = poses_through_rig(data, localized)
    car, front = data.rigs["car"], random_pose(np.random.default_rng(8))
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


def test_the_camera_with_most_inliers_gives_the_pose(data: KaptureData) -> None:
    inliers = {"left/1": 30, "right/1": 31, "left/2": 8, "right/2": 8, "phone/2": 400}
    localized = {
        f"{n}.jpg": Pose(random_pose(np.random.default_rng(5)), 500, count)
        for n, count in inliers.items()
    }
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


def test_a_shared_index_is_opened_without_reading_it_and_its_files_are_removed() -> None:
    rng = np.random.default_rng(0)
    images, keypoints, points = (rng.integers(0, n, 200) for n in (3, 50, 40))
    xyz, covariances = rng.normal(size=(40, 3)) + 4e6, rng.normal(size=(40, 6))
    names = ("a/\u00e9.jpg", "b\n.jpg", "c.jpg")
    index = MapIndex.build(xyz, names, images, keypoints, points, covariances)
    with shared_index({"sift": index}) as folders:
        opened = open_index(folders["sift"])
    assert not folders["sift"].parent.exists()
    # an open index stays valid
    assert opened.row_of_image == index.row_of_image
    for array in ("xyz", "offsets", "keypoint_ids", "point_ids", "covariances"):
        ours, expected = getattr(opened, array), getattr(index, array)
        np.testing.assert_array_equal(ours, expected, strict=True)
        assert isinstance(ours.base, np.memmap)


def test_an_index_has_the_covariances_of_the_map_and_may_be_empty(
    world: Any, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match="no observations of type 'other'"):
        index_map(world.map(), "other")
    root = Path(shutil.copytree(world.map().root, tmp_path / "map", symlinks=True))
    folder = KaptureFolder(root)
    count = len(folder.points3d())
    known = np.arange(6.0 * count).reshape(count, 6)
    write_point_covariances(root, known)
    np.testing.assert_array_equal(index_map(folder, "rootsift").covariances, known)
    write_points3d(root, np.zeros((0, 6)))
    write_observations(root, {})
    index = index_map(KaptureFolder(root), "rootsift")
    assert index.xyz.shape == (0, 3) and not index.row_of_image


def test_noise_is_measured_by_points_with_several_observations(world: Any) -> None:
    folder = world.map()
    measured = with_noise(folder, index_map(folder, "rootsift"))
    assert 0.02 < measured.noise_px < 1
    assert measured.noise_rad == pytest.approx(measured.noise_px / 300, rel=0.5)
    # lifted points have one observation, without error
    once = np.unique(measured.point_ids, return_index=True)[1]
    images = np.repeat(np.arange(len(measured.row_of_image)), np.diff(measured.offsets))[once]
    lifted = MapIndex.build(
        measured.xyz, tuple(measured.row_of_image), images, measured.keypoint_ids[once],
        measured.point_ids[once],
    )  # fmt: skip
    lifted = replace(lifted, local_type="rootsift")
    assert lifted.seen_once.all()
    assert np.isnan(with_noise(folder, lifted).noise_px)
