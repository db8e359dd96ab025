"""Camera models and their derivatives compared with formulas, OpenCV and COLMAP."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest
from camera_models import CAMERAS, CX, CY, STRONG, F
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import (
    bearing_rays,
    focal_px,
    normalized_from_px,
    principal_point_px,
    project,
    px_from_cam,
    shift_principal_point,
)
from megloc_kapture.geometry.projection import project_with_jacobian
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

POINTS = np.random.default_rng(0).uniform((-2, -1.5, 4), (2, 1.5, 9), (100, 3))


@pytest.mark.parametrize("model", CAMERAS)
def test_unprojection_undoes_projection(model: str) -> None:
    pixels = px_from_cam(CAMERAS[model], POINTS)
    rays = bearing_rays(CAMERAS[model], pixels)
    np.testing.assert_allclose(rays, POINTS / POINTS[:, 2:], atol=1e-7)
    np.testing.assert_array_equal(rays[:, :2], normalized_from_px(CAMERAS[model], pixels))
    assert px_from_cam(CAMERAS[model], np.zeros((0, 3))).shape == (0, 2)
    assert bearing_rays(CAMERAS[model], np.zeros((0, 2))).shape == (0, 3)
    narrow = bearing_rays(CAMERAS[model], pixels.astype(np.float32))
    np.testing.assert_allclose(narrow, rays, atol=1e-6)
    assert narrow.dtype == np.float64


@pytest.mark.parametrize("model", CAMERAS)
def test_focal_length_and_principal_point(model: str) -> None:
    # on the optical axis every model is a pinhole: the point there and its derivative
    tiny = 1e-5
    axis = np.array([[0.0, 0, 1], [tiny, 0, 1], [0, tiny, 1]])
    center, right, down = px_from_cam(CAMERAS[model], axis)
    np.testing.assert_allclose(principal_point_px(CAMERAS[model]), center, atol=1e-9)
    if model != "FOV":  # its focal length is scaled by the field of view
        mean = 0.5 * ((right - center)[0] + (down - center)[1]) / tiny
        np.testing.assert_allclose(focal_px(CAMERAS[model]), mean, rtol=5e-3)
    assert focal_px(CAMERAS[model]) == (F if CAMERAS[model].params[1] == CX else 505.0)


@pytest.mark.parametrize("model", CAMERAS)
def test_a_shifted_principal_point_shifts_every_pixel(model: str) -> None:
    shifted = shift_principal_point(CAMERAS[model], 0.5)
    np.testing.assert_allclose(
        px_from_cam(shifted, POINTS), px_from_cam(CAMERAS[model], POINTS) + 0.5, atol=1e-9
    )
    assert (shifted.model, shifted.width, shifted.height) == (model, 640, 480)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_projection_agrees_with_opencv(model: str) -> None:
    fx, fy, cx, cy, *distortion = CAMERAS[model].params
    # OpenCV's first pixel has its centre at (0, 0)
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    zero = np.zeros(3)
    function = cv2.fisheye.projectPoints if model == "OPENCV_FISHEYE" else cv2.projectPoints
    pixels, _ = function(
        POINTS.reshape(-1, 1, 3), zero, zero, matrix, np.array(distortion or [0.0] * 4)
    )
    np.testing.assert_allclose(
        px_from_cam(CAMERAS[model], POINTS), pixels.reshape(-1, 2) + 0.5, atol=1e-8
    )


def test_project_applies_the_pose() -> None:
    pose = RigidTransform((0.5, 0.5, -0.5, 0.5), (0.1, -0.2, 5.0))
    points = np.random.default_rng(1).uniform(-1, 1, (20, 3))
    in_cam = points @ pose.rotation_matrix().T + pose.translation
    expected = np.array([F, 510.0]) * in_cam[:, :2] / in_cam[:, 2:] + (CX, CY)
    np.testing.assert_allclose(project(CAMERAS["PINHOLE"], pose, points), expected, atol=1e-9)


def test_points_behind_the_camera_and_pixels_without_rays_are_nan() -> None:
    assert np.isnan(normalized_from_px(STRONG, np.array([[0.0, 0.0]]))).all()
    pixels = px_from_cam(CAMERAS["PINHOLE"], np.array([[0.1, 0.1, -1.0], [0, 0, 0], [0.1, 0, 1]]))
    assert np.isnan(pixels[:2]).all() and np.isfinite(pixels[2]).all()
    assert np.isnan(
        px_from_cam(CAMERAS["OPENCV"], np.array([[np.nan, 0, 1.0], [0, 0, np.nan]]))
    ).all()


def test_the_models_number_of_parameters_is_colmaps() -> None:
    assert set(CAMERAS) == set(CAMERA_MODEL_NUM_PARAMS)
    for model, count in CAMERA_MODEL_NUM_PARAMS.items():
        made = pycolmap.Camera(model=model, width=640, height=480, params=[0.0] * count)
        assert made.verify_params()
        assert not pycolmap.Camera(model=model, params=[0.0] * (count + 1)).verify_params()


def various_points() -> NDArray[np.float64]:
    """Return points in front of a camera: in its view, near its axis, and on its axis."""
    rng = np.random.default_rng(0)
    result = rng.uniform((-1.2, -1.0, 1.0), (1.2, 1.0, 1.5), (400, 3)) * rng.uniform(
        0.1, 50, (400, 1)
    )
    result[:100, :2] *= 10.0 ** rng.uniform(-9, -1, (100, 1))
    result[100:102, :2] = 0.0
    return result


def colmaps_derivatives(given: Camera, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return central differences of COLMAP's pixels with Richardson's extrapolation."""

    def central(step: float) -> NDArray[np.float64]:
        steps = step * at[:, 2:3]
        rows = [
            (px_from_cam(given, at + steps * axis) - px_from_cam(given, at - steps * axis))
            / (2 * steps)
            for axis in np.eye(3)
        ]
        return np.stack(rows, axis=2)

    return (4 * central(1e-4) - central(2e-4)) / 3


def assert_colmaps(given: Camera, at: NDArray[np.float64]) -> None:
    pixels, jacobian = project_with_jacobian(given, at)
    np.testing.assert_allclose(pixels, px_from_cam(given, at), atol=1e-9, rtol=0)
    assert jacobian.shape == (len(at), 2, 3)
    scale = np.abs(jacobian).max(axis=(1, 2), keepdims=True)
    expected = colmaps_derivatives(given, at) / scale
    np.testing.assert_allclose(jacobian / scale, expected, atol=2e-8, rtol=0)


@pytest.mark.parametrize("model", CAMERA_MODEL_NUM_PARAMS)
def test_pixels_and_derivatives_are_colmaps(model: str) -> None:
    assert_colmaps(CAMERAS[model], various_points())


@pytest.mark.parametrize("omega", [1e-9, 0.0099, 0.0101, 2.0])
def test_the_field_of_view_model_at_its_expansions(omega: float) -> None:
    given, at = Camera("FOV", 640, 480, (F, 510.0, CX, CY, omega)), various_points()
    pixels, _ = project_with_jacobian(given, at)
    np.testing.assert_allclose(pixels, px_from_cam(given, at), atol=1e-9, rtol=0)
    # COLMAP's expansions are not continuous where they end
    radius = np.linalg.norm(at[:, :2] / at[:, 2:], axis=1)
    assert_colmaps(given, at[np.abs(radius - 0.01) > 1e-3])
