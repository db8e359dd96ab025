"""The value types against scipy, and rejected values."""

from __future__ import annotations

import pickle
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from poses import random_pose
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError
from megloc_kapture.plugins import PluginChoice
from megloc_kapture.values import (
    CAMERA_MODEL_NUM_PARAMS,
    Camera,
    Failure,
    Options,
    Pose,
    RigidTransform,
)

seeds = st.integers(0, 2**32 - 1)


def homogeneous(transform: RigidTransform) -> np.ndarray:
    w, x, y, z = transform.quat_wxyz
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    matrix[:3, 3] = transform.translation
    return matrix


@given(seeds)
def test_transforms_are_their_matrices(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_pose(rng), random_pose(rng)
    np.testing.assert_allclose(a.rotation_matrix(), homogeneous(a)[:3, :3], atol=1e-14)
    np.testing.assert_allclose(homogeneous(a @ b), homogeneous(a) @ homogeneous(b), atol=1e-12)
    np.testing.assert_allclose(homogeneous(a.inverse()), np.linalg.inv(homogeneous(a)), atol=1e-12)
    points = rng.normal(size=(7, 3))
    expected = (np.column_stack([points, np.ones(7)]) @ homogeneous(a).T)[:, :3]
    np.testing.assert_allclose(a.apply(points), expected, atol=1e-12)
    np.testing.assert_allclose(a.apply(a.center()[None]), np.zeros((1, 3)), atol=1e-12)
    result = RigidTransform.from_matrix(a.rotation_matrix(), np.zeros(3)).quat_wxyz
    sign = 1 if a.quat_wxyz[0] > 0 else -1
    np.testing.assert_allclose(np.array(result) * sign, a.quat_wxyz, atol=1e-14)


# rotations by (nearly) 180 degrees about every axis: where the trace formula loses all digits
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize(
    "axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, -0.8, 0], [-0.48, 0.6, 0.64]]
)
def test_from_matrix_is_stable_everywhere(axis: list[float], angle: float) -> None:
    matrix = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
    transform = RigidTransform.from_matrix(matrix, np.array([1.0, 2, 3]))
    np.testing.assert_allclose(transform.rotation_matrix(), matrix, atol=1e-14)
    assert abs(np.linalg.norm(transform.quat_wxyz) - 1) < 1e-15
    assert transform.quat_wxyz[0] >= 0
    assert transform.translation == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(4), r"must have the shape \(3, 3\), got \(4, 4\)"),
        (np.diag([1.0, 1.0, -1.0]), "not a rotation matrix"),
        (2 * np.eye(3), "not a rotation matrix"),
        (np.ones((3, 3)), "not a rotation matrix"),
        (np.full((3, 3), np.nan), "not a rotation matrix"),
    ],
)
def test_other_matrices_are_no_rotations(matrix: NDArray[np.float64], message: str) -> None:
    with pytest.raises(DataError, match=message):
        RigidTransform.from_matrix(matrix, np.zeros(3))


def test_a_camera_takes_numbers_of_any_kind() -> None:
    camera = Camera("PINHOLE", 640, 480, tuple(np.array([500, 510, 320, 240])))  # type: ignore[arg-type]
    assert camera.params == (500.0, 510.0, 320.0, 240.0)
    assert all(type(p) is float for p in camera.params)
    assert hash(camera) == hash(Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.0, 240.0)))
    fields: list[Any] = ["640", "480", "500", "510", "320", "240"]
    assert Camera("PINHOLE", *fields[:2], fields[2:]) == camera  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("model", "width", "height", "params", "message"),
    [
        ("KANNALA", 640, 480, (500, 320, 240), "unknown camera model 'KANNALA'; known: SIMPLE_"),
        ("PINHOLE", 640, 480, (500, 320, 240), "PINHOLE takes 4 parameters, got 3"),
        ("PINHOLE", 0, 480, (500, 500, 320, 240), "image size 0x480 is not positive"),
        ("PINHOLE", 640, -1, (500, 500, 320, 240), "image size 640x-1 is not positive"),
        ("PINHOLE", 640, 480, (500, 500, np.nan, 240), "must be finite"),
        ("PINHOLE", 640, 480, (np.inf, 500, 320, 240), "must be finite"),
        ("PINHOLE", 640, 480, (0, 500, 320, 240), "focal length 0.0 is not positive"),
        ("PINHOLE", 640, 480, (500, -500, 320, 240), "focal length -500.0 is not positive"),
        ("OPENCV_FISHEYE", 640, 480, (500, 0, 320, 240, 0, 0, 0, 0), "focal length 0.0"),
        ("PINHOLE", 640, 480, np.eye(3), "PINHOLE: sizes, params and deviation must be numbers"),
        ("SIMPLE_PINHOLE", float("inf"), 480, (500, 320, 240), "deviation must be numbers"),
        ("SIMPLE_PINHOLE", "wide", 480, (500, 320, 240), "deviation must be numbers"),
    ],
)
def test_cameras_that_cannot_be(
    model: str, width: Any, height: int, params: Any, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        Camera(model, width, height, params)


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"])
def test_a_principal_point_may_be_anywhere(model: str) -> None:
    count = CAMERA_MODEL_NUM_PARAMS[model] - 3
    assert Camera(model, 640, 480, (500.0, -20.0, 0.0) + (0.0,) * count).params[1] == -20.0


def test_values_travel_between_processes_and_say_whether_they_are_poses() -> None:
    assert not Failure("no map image matches")
    assert Pose(RigidTransform.identity(), num_matches=0, num_inliers=0)
    pose = random_pose(np.random.default_rng(0))
    camera = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.1))
    for value in (pose, camera, Failure("why", 3, 1, candidates=("a.jpg",))):
        assert pickle.loads(pickle.dumps(value)) == value


class Lists(Options):
    names: tuple[str, ...] = ()
    choices: tuple[PluginChoice, ...] = ()
    optional: tuple[Literal["a", "b"], ...] | None = None
    by_name: dict[str, tuple[str, ...]] = {}
    pair: tuple[str, str] = ("x", "y")
    text: str = ""


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"names": "one"}, {"names": ("one",)}),
        ({"names": "one, two"}, {"names": ("one", "two")}),
        ({"names": ["one, two"]}, {"names": ("one, two",)}),
        ({"choices": "icp"}, {"choices": (PluginChoice(name="icp"),)}),
        (
            {"choices": {"name": "icp", "options": {"a": 1}}},
            {"choices": (PluginChoice(name="icp", options={"a": 1}),)},
        ),
        ({"optional": "b"}, {"optional": ("b",)}),
        ({"optional": None}, {"optional": None}),
        ({"by_name": {"a": ("b",)}}, {"by_name": {"a": ("b",)}}),
        ({"text": "one, two"}, {"text": "one, two"}),
    ],
)
def test_one_name_is_a_list_of_one(given: dict[str, Any], expected: dict[str, Any]) -> None:
    assert Lists.model_validate(given) == Lists().model_copy(update=expected)


def test_options_are_frozen() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        Lists().text = "other"  # type: ignore[misc]
