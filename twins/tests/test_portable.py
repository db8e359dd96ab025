"""Resampling and arithmetic compared with OpenCV and numpy."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from megloc_twins.portable import averaged, blurred, product, resized, settled_pose
from megloc_twins.rasterization import bilinear


@given(
    st.integers(2, 60), st.integers(2, 60), st.integers(0, 50), st.integers(0, 50), st.booleans()
)
def test_enlarging_is_opencvs(
    height: int, width: int, more_rows: int, more_columns: int, cubic: bool
) -> None:
    image = np.random.default_rng(0).random((height, width, 2), dtype=np.float32)
    size = (width + more_columns, height + more_rows)
    method = cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR
    expected = cv2.resize(image.astype(np.float64), size, interpolation=method)
    np.testing.assert_allclose(resized(image, *size, cubic=cubic), expected, atol=2e-5)


@pytest.mark.parametrize(
    ("deviation_px", "shape"), [(0.5, (40, 50, 3)), (3.0, (40, 50, 3)), (1.1, (8, 9))]
)
def test_blurring_is_opencvs(deviation_px: float, shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(1).random(shape, dtype=np.float32)
    size = 2 * round(4 * deviation_px) + 1
    expected = cv2.GaussianBlur(image, (size, size), deviation_px)
    np.testing.assert_allclose(blurred(image, deviation_px), expected, atol=1e-5)


@pytest.mark.parametrize("factor", [1, 3, 8])
def test_averaging_leaves_out_what_fills_no_square(factor: int) -> None:
    image = np.random.default_rng(2).random((49, 66, 3), dtype=np.float32)
    height, width = 49 // factor, 66 // factor
    whole = image[: height * factor, : width * factor]
    expected = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(averaged(image, factor), expected, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_lookups_between_pixels_are_opencvs(dtype: type) -> None:
    rng = np.random.default_rng(3)
    image = (255 * rng.random((30, 40, 3))).astype(dtype)
    # OpenCV keeps 1/32 px of a position for uint8; beyond the edge too
    x, y = (rng.integers(-64, 32 * 44, (2, 20, 30)) / 32).astype(np.float32)
    method = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_REPLICATE}
    expected = cv2.remap(image.astype(np.float32), x, y, **method)
    np.testing.assert_allclose(bilinear(image, x, y), expected, atol=1e-3)


def test_lookups_nowhere_are_of_the_edge() -> None:
    image = np.arange(12, dtype=np.float32).reshape(3, 4, 1)
    x = np.array([[np.nan, np.inf, -np.inf, 1e30]], np.float32)
    np.testing.assert_array_equal(bilinear(image, x, x)[..., 0], [[0, 11, 0, 11]])


@given(st.integers(0, 2**32 - 1))
def test_products_and_poses_are_numpys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, matrix = rng.normal(size=(4, 5, 3)), rng.normal(size=(3, 3))
    np.testing.assert_allclose(product(points, matrix), points @ matrix, atol=1e-12)
    np.testing.assert_allclose(product(points, matrix[0]), points @ matrix[0], atol=1e-12)
    rotation = np.linalg.qr(matrix)[0]
    rotation *= np.sign(np.linalg.det(rotation))
    pose = settled_pose(rotation, matrix[0])
    np.testing.assert_allclose(pose.rotation_matrix(), rotation, atol=1e-8)
    np.testing.assert_allclose(pose.translation, matrix[0], atol=1e-9)


@pytest.mark.parametrize("last_bit", [-1e-16, 0.0, 1e-16])
@pytest.mark.parametrize("axis", range(3))
def test_half_a_turn_has_one_quaternion(axis: int, last_bit: float) -> None:
    rotation = -np.eye(3)
    rotation[axis, axis] = 1.0
    first, second = (index for index in range(3) if index != axis)
    rotation[first, second], rotation[second, first] = -last_bit, last_bit
    expected = [0.0] * 4
    expected[1 + axis] = 1.0
    pose = settled_pose(rotation, np.zeros(3))
    assert [value.hex() for value in pose.quat_wxyz] == [value.hex() for value in expected]
