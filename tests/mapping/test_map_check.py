"""Mistakes in maps are named; correct maps pass."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from poses import WRONG_CONVENTIONS

from megloc_kapture.geometry.cameras import project
from megloc_kapture.mapping.map_check import (
    ObservedKeypoints,
    camera_fault,
    find_pixel_origin,
    map_fault,
)
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 510.0, 330.0, 235.0))
Changed = Callable[[NDArray[Any]], NDArray[Any]]
Map = tuple[list[ObservedKeypoints], NDArray[np.float64]]


def pose_at(number: int) -> RigidTransform:
    """Return a camera on an arc around the points, each with another roll."""
    angle, roll = 0.25 * (number - 4), 0.1 * number
    around = RigidTransform((np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0), (0.0, 0.0, 6.0))
    rolled = RigidTransform((np.cos(roll / 2), 0.0, 0.0, np.sin(roll / 2)), (0.0, 0.0, 0.0))
    return rolled @ around @ RigidTransform((1.0, 0.0, 0.0, 0.0), (0.3 * number, 0.1, -0.2))


def good_map(seed: int = 0, noise_px: float = 1.0) -> Map:
    rng = np.random.default_rng(seed)
    xyz = rng.uniform((-2.0, -1.5, -0.7), (2.0, 1.0, 1.2), (300, 3))
    images = []
    for number in range(9):
        pose = pose_at(number)
        seen = project(CAMERA, pose, xyz)
        inside = np.flatnonzero(((seen > 0) & (seen < (640, 480))).all(axis=1))
        points = np.sort(rng.choice(inside, 80, replace=False))
        # some keypoints observe nothing
        keypoints = rng.uniform((0, 0), (640, 480), (140, 2))
        rows = 1 + np.sort(rng.choice(138, 80, replace=False))
        keypoints[rows] = seen[points] + rng.normal(0, noise_px, (80, 2))
        images.append(
            ObservedKeypoints(
                f"{number:02d}.jpg", CAMERA, pose, keypoints.astype(np.float32), rows, points
            )
        )
    return images, xyz


def each(change: Callable[[ObservedKeypoints], dict[str, Any]]) -> Callable[[Map], Map]:
    return lambda m: ([replace(image, **change(image)) for image in m[0]], m[1])


def with_pose(change: Callable[[RigidTransform], RigidTransform]) -> Callable[[Map], Map]:
    return each(lambda i: {"cam_from_world": change(i.cam_from_world)})


def with_pixels(change: Changed) -> Callable[[Map], Map]:
    return each(lambda i: {"keypoints_px": change(i.keypoints_px)})


def with_points(change: Changed) -> Callable[[Map], Map]:
    return lambda m: (m[0], change(m[1]))


def with_params(*params: float, model: str = "PINHOLE") -> Callable[[Map], Map]:
    return each(lambda i: {"camera": Camera(model, 640, 480, params)})


def one_with_nan(array: NDArray[np.floating]) -> NDArray[np.floating]:
    changed = array.copy()
    changed[3, 1] = np.nan
    return changed


MISTAKES: dict[str, tuple[Callable[[Map], Map], str]] = {
    "keypoints as y, x": (with_pixels(lambda k: k[:, ::-1]), r"read as \(y, x\)"),
    "larger images": (with_pixels(lambda k: k * 1.6), "keypoints multiplied by 0.625"),
    **{
        words: (with_pose(convert), re.escape(words))
        for words, convert in WRONG_CONVENTIONS.items()
    },
    "focal length": (with_params(1000.0, 1020.0, 330.0, 235.0), "focal length 0.5 times as long"),
    "points not finite": (with_points(lambda p: one_with_nan(p)), "1 of 300 points are not finite"),
    "keypoints not finite": (with_pixels(one_with_nan), "keypoints of 00.jpg are not finite"),
    "one pose": (with_pose(lambda p: pose_at(3)), "all 9 images have the same pose"),
    "principal point": (
        with_params(500.0, 510.0, 1e6, 235.0),
        "is impossible: the principal point",
    ),
    "no focal length": (
        with_params(1.0, 1.0, 330.0, 235.0),
        "is impossible: the focal length is 1",
    ),
    "distortion": (
        with_params(500.0, 330.0, 235.0, 50.0, model="SIMPLE_RADIAL"),
        "is impossible: its distortion",
    ),
    "points behind": (with_points(lambda p: p - (0, 0, 50)), "most points are behind the cameras"),
    "random points": (
        with_points(lambda p: np.random.default_rng(1).uniform(-2, 2, p.shape)),
        "do not fit the keypoints: 9 of 9 images, such as .*, have",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_in_maps_are_named(name: str) -> None:
    change, expected = MISTAKES[name]
    fault = map_fault(*change(good_map()))
    assert fault is not None
    assert re.search(expected, fault), fault


@pytest.mark.parametrize(("seed", "noise_px"), [(0, 0.0), (2, 4.0)])
def test_good_maps_have_no_fault(seed: int, noise_px: float) -> None:
    assert map_fault(*good_map(seed, noise_px)) is None


def test_a_single_wrong_image_is_no_fault_of_the_map() -> None:
    images, xyz = good_map()
    images[4] = replace(images[4], cam_from_world=pose_at(0))
    assert map_fault(images, xyz) is None
    # without observations
    none = np.zeros(0, np.int64)
    assert map_fault([replace(i, rows=none, points=none) for i in images], xyz) is None
    assert map_fault([], xyz) is None


@pytest.mark.parametrize(
    "camera",
    [
        Camera("SIMPLE_RADIAL", 4032, 3024, (3100.0, 2016.0, 1512.0, -0.3)),
        Camera("OPENCV_FISHEYE", 1024, 1024, (300.0, 300.0, 512.0, 512.0, 0.1, 0.0, 0.0, 0.0)),
        Camera("FULL_OPENCV", 640, 480, (360.0, 360.0, 320, 240, 10, 4, 0, 0, 0.2, 10, 7, 1)),
        Camera("FOV", 752, 480, (400.0, 400.0, 376.0, 240.0, 0.9)),
        # cropped from a large image
        Camera.pinhole(200, 200, 3000.0),
        Camera("PINHOLE", 200, 200, (800.0, 800.0, -150.0, 380.0)),
    ],
)
def test_unusual_cameras_have_no_fault(camera: Camera) -> None:
    assert camera_fault(camera) is None


@pytest.mark.parametrize(
    ("shift_px", "centred", "expected"),
    [
        (0.0, False, ("corner", "corner")),
        (0.0, True, ("centre", "centre")),
        (-0.5, False, ("corner", "centre")),
        (0.5, False, ("centre", "corner")),
    ],
)
def test_origins_of_keypoints_and_intrinsics(shift_px: float, centred: bool, expected: Any) -> None:
    images, xyz = with_pixels(lambda k: k + np.float32(shift_px))(good_map(noise_px=0.3))
    principal = (319.5, 239.5) if centred else (320.0, 240.0)
    cameras = [Camera("PINHOLE", 640, 480, (500.0, 510.0, *principal))]
    origin = find_pixel_origin(images, xyz, cameras=cameras)
    assert (origin.intrinsics, origin.keypoints) == expected
