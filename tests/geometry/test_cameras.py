"""Camera models against formulas of their own, OpenCV and COLMAP."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest

from megloc_kapture.geometry.cameras import (
    bearing_rays,
    focal_px,
    normalized_from_px,
    principal_point_px,
    project,
    px_from_cam,
    shift_principal_point,
)
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

F, CX, CY = 500.0, 321.0, 238.5
CAMERAS = {
    "SIMPLE_PINHOLE": (F, CX, CY),
    "PINHOLE": (F, 510.0, CX, CY),
    "SIMPLE_RADIAL": (F, CX, CY, -0.05),
    "RADIAL": (F, CX, CY, -0.05, 0.01),
    "OPENCV": (F, 510.0, CX, CY, -0.05, 0.01, 1e-3, -2e-3),
    "OPENCV_FISHEYE": (F, 510.0, CX, CY, 0.02, -0.01, 3e-3, -1e-3),
    "FULL_OPENCV": (F, 510.0, CX, CY, -0.05, 0.01, 1e-3, -2e-3, 1e-3, 0.02, -0.01, 1e-3),
    "FOV": (F, 510.0, CX, CY, 0.9),
    "SIMPLE_RADIAL_FISHEYE": (F, CX, CY, 0.02),
    "RADIAL_FISHEYE": (F, CX, CY, 0.02, -0.01),
    "THIN_PRISM_FISHEYE": (F, 510.0, CX, CY, 0.02, -0.01, 1e-3, -1e-3, 1e-3, 0.0, 1e-3, -1e-3),
}
POINTS = np.random.default_rng(0).uniform((-2, -1.5, 4), (2, 1.5, 9), (100, 3))


def camera(model: str) -> Camera:
    return Camera(model, 640, 480, CAMERAS[model])


def test_every_model_that_a_camera_can_have_is_tested() -> None:
    assert set(CAMERAS) == set(CAMERA_MODEL_NUM_PARAMS)


@pytest.mark.parametrize("model", CAMERAS)
def test_unprojection_undoes_projection(model: str) -> None:
    pixels = px_from_cam(camera(model), POINTS)
    rays = bearing_rays(camera(model), pixels)
    np.testing.assert_allclose(rays, POINTS / POINTS[:, 2:], atol=1e-7)
    np.testing.assert_array_equal(rays[:, :2], normalized_from_px(camera(model), pixels))


@pytest.mark.parametrize("model", CAMERAS)
def test_focal_length_and_principal_point_are_those_of_the_model(model: str) -> None:
    # on the optical axis every model is a pinhole: the point there and its derivative
    tiny = 1e-5
    axis = np.array([[0.0, 0, 1], [tiny, 0, 1], [0, tiny, 1]])
    center, right, down = px_from_cam(camera(model), axis)
    np.testing.assert_allclose(principal_point_px(camera(model)), center, atol=1e-9)
    if model != "FOV":  # its focal length is scaled by the field of view
        mean = 0.5 * ((right - center)[0] + (down - center)[1]) / tiny
        np.testing.assert_allclose(focal_px(camera(model)), mean, rtol=5e-3)
    one_focal = len(set(CAMERAS[model][:2])) == 2 and CAMERAS[model][1] == CX
    assert focal_px(camera(model)) == (F if one_focal else 505.0)


@pytest.mark.parametrize("model", CAMERAS)
def test_a_shifted_principal_point_shifts_every_pixel(model: str) -> None:
    shifted = shift_principal_point(camera(model), 0.5)
    np.testing.assert_allclose(
        px_from_cam(shifted, POINTS), px_from_cam(camera(model), POINTS) + 0.5, atol=1e-9
    )
    assert (shifted.model, shifted.width, shifted.height) == (model, 640, 480)


def test_pinhole_by_hand() -> None:
    expected = np.array([F, 510.0]) * POINTS[:, :2] / POINTS[:, 2:] + (CX, CY)
    np.testing.assert_allclose(px_from_cam(camera("PINHOLE"), POINTS), expected, atol=1e-10)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_projection_agrees_with_opencv(model: str) -> None:
    fx, fy, cx, cy, *distortion = CAMERAS[model]
    # OpenCV's first pixel has its centre at (0, 0)
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    zero = np.zeros(3)
    function = cv2.fisheye.projectPoints if model == "OPENCV_FISHEYE" else cv2.projectPoints
    pixels, _ = function(
        POINTS.reshape(-1, 1, 3), zero, zero, matrix, np.array(distortion or [0.0] * 4)
    )
    np.testing.assert_allclose(
        px_from_cam(camera(model), POINTS), pixels.reshape(-1, 2) + 0.5, atol=1e-8
    )


def test_project_applies_the_pose() -> None:
    pose = RigidTransform((0.5, 0.5, -0.5, 0.5), (0.1, -0.2, 5.0))
    points = np.random.default_rng(1).uniform(-1, 1, (20, 3))
    in_cam = points @ pose.rotation_matrix().T + pose.translation
    expected = np.array([F, 510.0]) * in_cam[:, :2] / in_cam[:, 2:] + (CX, CY)
    np.testing.assert_allclose(project(camera("PINHOLE"), pose, points), expected, atol=1e-9)


def test_behind_the_camera_is_nan() -> None:
    pixels = px_from_cam(camera("PINHOLE"), np.array([[0.1, 0.1, -1.0], [0, 0, 0], [0.1, 0, 1]]))
    assert np.isnan(pixels[:2]).all() and np.isfinite(pixels[2]).all()
    assert np.isnan(
        px_from_cam(camera("OPENCV"), np.array([[np.nan, 0, 1.0], [0, 0, np.nan]]))
    ).all()


@pytest.mark.parametrize("model", CAMERAS)
def test_no_points(model: str) -> None:
    assert px_from_cam(camera(model), np.zeros((0, 3))).shape == (0, 2)
    assert bearing_rays(camera(model), np.zeros((0, 2))).shape == (0, 3)


def test_float32_pixels_are_taken() -> None:
    pixels = np.array([[10.25, 20.5]], dtype=np.float32)
    rays = bearing_rays(camera("PINHOLE"), pixels)
    assert rays.dtype == np.float64
    np.testing.assert_allclose(rays[0], [(10.25 - CX) / F, (20.5 - CY) / 510.0, 1])


def test_pixels_that_cannot_be_undistorted_are_nan() -> None:
    strong = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.3))
    assert np.isnan(normalized_from_px(strong, np.array([[0.0, 0.0]]))).all()


def test_the_models_number_of_parameters_is_colmaps() -> None:
    for model, count in CAMERA_MODEL_NUM_PARAMS.items():
        made = pycolmap.Camera(model=model, width=640, height=480, params=[0.0] * count)
        assert made.verify_params()
        assert not pycolmap.Camera(model=model, params=[0.0] * (count + 1)).verify_params()
