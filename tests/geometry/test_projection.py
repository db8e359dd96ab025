"""Projection and its derivatives, against COLMAP and differences of COLMAP's."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from megloc_kapture.geometry.projection import project_with_jacobian
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera

INTRINSICS = (500.0, 510.0, 320.0, 241.0)
DISTORTION = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (-0.1,),
    "RADIAL": (-0.1, 0.03),
    "OPENCV": (-0.1, 0.03, 0.002, -0.003),
    "OPENCV_FISHEYE": (-0.1, 0.03, 0.02, -0.003),
    "FULL_OPENCV": (-0.1, 0.03, 0.002, -0.003, 0.01, 0.05, 0.02, 0.004),
    "FOV": (0.9,),
    "SIMPLE_RADIAL_FISHEYE": (0.1,),
    "RADIAL_FISHEYE": (0.1, -0.02),
    "THIN_PRISM_FISHEYE": (-0.1, 0.03, 0.002, -0.003, 0.01, 0.005, 0.002, -0.004),
}


def camera(model: str, distortion: tuple[float, ...] | None = None) -> Camera:
    rest = DISTORTION[model] if distortion is None else distortion
    focals = CAMERA_MODEL_NUM_PARAMS[model] - 2 - len(DISTORTION[model])
    return Camera(model, 640, 480, (*INTRINSICS[:focals], *INTRINSICS[2:], *rest))


def colmap(given: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    theirs = pycolmap.Camera(
        model=given.model, width=given.width, height=given.height, params=list(given.params)
    )
    return np.asarray(theirs.img_from_cam(points))


def points() -> NDArray[np.float64]:
    """In front of a camera: over its view, near its axis, and on it."""
    rng = np.random.default_rng(0)
    found = rng.uniform((-1.2, -1.0, 1.0), (1.2, 1.0, 1.5), (400, 3)) * rng.uniform(
        0.1, 50, (400, 1)
    )
    found[:100, :2] *= 10.0 ** rng.uniform(-9, -1, (100, 1))
    found[100:102, :2] = 0.0
    return found


def test_every_model_is_covered() -> None:
    assert set(DISTORTION) == set(CAMERA_MODEL_NUM_PARAMS)


@pytest.mark.parametrize("model", DISTORTION)
def test_pixels_are_colmaps(model: str) -> None:
    given = camera(model)
    pixels, _ = project_with_jacobian(given, points())
    np.testing.assert_allclose(pixels, colmap(given, points()), atol=1e-9, rtol=0)


def differences(given: Camera, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Central differences with Richardson's extrapolation."""

    def central(step: float) -> NDArray[np.float64]:
        steps = step * at[:, 2:3]
        rows = [
            (colmap(given, at + steps * axis) - colmap(given, at - steps * axis)) / (2 * steps)
            for axis in np.eye(3)
        ]
        return np.stack(rows, axis=2)

    return (4 * central(1e-4) - central(2e-4)) / 3


@pytest.mark.parametrize("model", DISTORTION)
def test_derivatives_are_those_of_colmaps_pixels(model: str) -> None:
    given = camera(model)
    _, jacobian = project_with_jacobian(given, points())
    assert jacobian.shape == (400, 2, 3)
    scale = np.abs(jacobian).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(
        jacobian / scale, differences(given, points()) / scale, atol=2e-8, rtol=0
    )


@pytest.mark.parametrize("omega", [1e-9, 1e-3, 0.0099, 0.0101, 0.5, 2.0])
def test_the_field_of_view_model_at_its_expansions(omega: float) -> None:
    given = camera("FOV", (omega,))
    pixels, jacobian = project_with_jacobian(given, points())
    np.testing.assert_allclose(pixels, colmap(given, points()), atol=1e-9, rtol=0)
    # COLMAP's expansions do not meet its formula where they end: no differences across that
    radius = np.linalg.norm(points()[:, :2] / points()[:, 2:], axis=1)
    inside = np.abs(radius - 0.01) > 1e-3
    scale = np.abs(jacobian).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(
        (jacobian / scale)[inside], (differences(given, points()) / scale)[inside], atol=2e-8
    )


@given(
    st.sampled_from(sorted(DISTORTION)),
    st.lists(st.floats(-0.1, 0.1), min_size=8, max_size=8),
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.01, 1000)),
)
def test_any_camera_and_point(
    model: str, numbers: list[float], where: tuple[float, float, float]
) -> None:
    rest = tuple(numbers[: len(DISTORTION[model])])
    given = camera(model, tuple(map(abs, rest)) if model == "FOV" else rest)
    point = np.array([[where[0] * where[2], where[1] * where[2], where[2]]])
    pixels, jacobian = project_with_jacobian(given, point)
    np.testing.assert_allclose(pixels, colmap(given, point), rtol=1e-9, atol=1e-9)
    # a point farther along its own ray is seen at the same pixel
    along = jacobian[0] @ point[0]
    np.testing.assert_allclose(along, 0.0, atol=1e-9 * np.abs(jacobian).max() * where[2])


def test_nothing_is_seen_behind_the_camera() -> None:
    behind = np.array([[0.0, 0.0, -1.0], [0.1, 0.2, 0.0], [np.nan, 0.0, 1.0], [0.0, 0.0, 2.0]])
    pixels, jacobian = project_with_jacobian(camera("OPENCV"), behind)
    assert np.isnan(pixels[:2]).all() and np.isnan(jacobian[:2]).all()
    assert np.isnan(pixels[2, 0]) and np.isfinite(pixels[3]).all()
    empty_px, empty = project_with_jacobian(camera("OPENCV"), np.zeros((0, 3)))
    assert empty_px.shape == (0, 2) and empty.shape == (0, 2, 3)
