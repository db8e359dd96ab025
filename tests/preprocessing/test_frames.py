"""Sizes, scaled and undistorted cameras, and resampling against OpenCV and COLMAP."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from camera_models import CAMERAS
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from megloc_kapture.errors import OptionError
from megloc_kapture.geometry.cameras import with_two_focals
from megloc_kapture.io.colmap import px_from_cam
from megloc_kapture.preprocessing import frames as module
from megloc_kapture.preprocessing.frames import (
    carry_points,
    cropped_size,
    fitted_size,
    plan_frame,
    processed_image,
    processed_mask,
    reached_region,
    resized,
    scaled_camera,
    undistorted_camera,
)
from megloc_kapture.values import Camera

UNDISTORT: dict[str, Any] = {"undistort": True}
SMALL: dict[str, Any] = {"undistort": True, "max_size_px": 200}
FOLDING = Camera("SIMPLE_RADIAL", 480, 360, (240.0, 240.0, 180.0, -0.4))


WIDTH, HEIGHT = 640, 480


@pytest.fixture(params=sorted(CAMERAS))
def camera(request: pytest.FixtureRequest) -> Camera:
    return CAMERAS[request.param]


def painted(
    brightness: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]],
    width: int = WIDTH,
    height: int = HEIGHT,
) -> NDArray[np.uint8]:
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    grey = np.clip(np.rint(brightness(x, y)), 0, 255).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)


def test_the_larger_side_fits_and_only_upscale_enlarges() -> None:
    assert fitted_size(4032, 3024, 1600) == (1600, 1200)
    assert fitted_size(2000, 1333, 1600) == (1600, 1066)
    assert fitted_size(1, 100_000, 1600) == (1, 1600)
    assert fitted_size(512, 768, 1600) == (512, 768)
    assert fitted_size(512, 768, 1600, upscale=True) == (1067, 1600)


@given(st.integers(8, 6000), st.integers(8, 6000))
def test_both_sides_become_multiples(width: int, height: int) -> None:
    for old, new in zip((width, height), cropped_size(width, height), strict=True):
        assert new % 8 == 0 and 0 <= old - new < 8
    with pytest.raises(OptionError, match=f"{width}x7 cannot be cropped to multiples of 8"):
        cropped_size(width, 7)


def points_seen() -> NDArray[np.float64]:
    rng = np.random.default_rng(0)
    rays = np.concatenate([rng.uniform(-0.6, 0.6, (200, 2)), np.ones((200, 1))], axis=1)
    return rays * rng.uniform(0.5, 50, (200, 1))


@pytest.mark.parametrize("size", [(1280, 960), (213, 160)])
def test_cameras_are_scaled_with_their_images(camera: Camera, size: tuple[int, int]) -> None:
    points = points_seen()
    px = px_from_cam(camera, points)
    np.testing.assert_allclose(px_from_cam(with_two_focals(camera), points), px, atol=1e-10)
    scaled = scaled_camera(camera, *size)
    assert (scaled.width, scaled.height) == size
    expected = px * [size[0] / camera.width, size[1] / camera.height]
    np.testing.assert_allclose(px_from_cam(scaled, points), expected, rtol=0, atol=1e-9)
    # equal scales of both axes keep the model
    twice = size == (2 * camera.width, 2 * camera.height)
    assert scaled.model == (camera if twice else with_two_focals(camera)).model


def test_an_estimated_camera_is_that_of_the_original_image() -> None:
    original = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 321.0, 243.0, 0.02))
    plan = plan_frame(original, max_size_px=320)
    estimated = Camera("SIMPLE_RADIAL", 320, 240, (275.0, 163.5, 119.5, 0.03), focal_deviation=0.01)
    expected = Camera("SIMPLE_RADIAL", 640, 480, (550.0, 327.0, 239.0, 0.03), focal_deviation=0.01)
    camera = plan.original_of(estimated)
    assert replace(camera, params=expected.params) == expected
    np.testing.assert_allclose(camera.params, expected.params, rtol=1e-12)


def test_cropping_keeps_pixels_and_shrinking_averages_them() -> None:
    image = painted(lambda x, y: x + y / 2, 123, 61)
    camera = Camera("SIMPLE_RADIAL", 123, 61, (100.0, 60.0, 30.0, 0.1))
    plan = plan_frame(camera, max_size_px=1600)
    assert plan.processed == replace(camera, width=120, height=56)
    np.testing.assert_array_equal(processed_image(image, plan), image[:56, :120])
    board = painted(lambda x, y: 255.0 * ((np.floor(x) + np.floor(y)) % 2), 64, 64)
    np.testing.assert_array_equal(resized(board, 16, 16), np.full((16, 16, 3), 128))


def test_images_are_unchanged_by_default() -> None:
    camera = CAMERAS["OPENCV"]
    plan = plan_frame(camera)
    assert plan.processed == camera and not plan.changes_pixels
    mask = np.ones((camera.height, camera.width), bool)
    assert processed_mask(mask, plan) is mask


@pytest.mark.parametrize("max_size_px", [97, 200])
def test_resized_masks_have_the_value_under_each_pixel_centre(max_size_px: int) -> None:
    mask = np.random.default_rng(0).random((61, 123)) > 0.5
    camera = Camera("PINHOLE", 123, 61, (100.0, 100.0, 60.0, 30.0))
    plan = plan_frame(camera, max_size_px=max_size_px, upscale=True)
    result = processed_mask(mask, plan)
    assert result.shape == (plan.processed.height, plan.processed.width)
    rows, columns = np.indices(result.shape)
    centres = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
    at = carry_points(plan.processed, plan.original, centres)
    # a centre on the edge between two pixels may have either value
    clear = (np.abs(at - np.rint(at)) > 1e-9).all(axis=1)
    assert clear.mean() > 0.5
    column, row = np.floor(at[clear]).astype(int).T
    np.testing.assert_array_equal(result.ravel()[clear], mask[row, column])


def cloudy() -> NDArray[np.uint8]:
    """Smooth noise: interpolation of any kind gives nearly the same."""
    noise = np.random.default_rng(3).normal(size=(HEIGHT, WIDTH, 3))
    smooth = cv2.GaussianBlur(noise, (0, 0), 8.0)
    return np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    "model", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE", "FOV", "THIN_PRISM_FISHEYE"]
)
def test_undistorted_images_equal_colmap(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    image, distorted = cloudy(), CAMERAS[model]
    theirs = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=distorted.params)
    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = 0.0
    picture, camera = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(image), theirs)
    monkeypatch.setattr(module, "_SIDE_STEP_PX", 1)
    plan = plan_frame(distorted, **UNDISTORT)
    assert plan.processed.model == "PINHOLE"
    assert (plan.processed.width, plan.processed.height) == (camera.width, camera.height)
    np.testing.assert_allclose(plan.processed.params, camera.params, rtol=1e-12)
    # COLMAP blends the outermost pixels of the original with black
    y, x = np.indices((camera.height, camera.width)) + 0.5
    at = carry_points(plan.processed, plan.original, np.stack([x.ravel(), y.ravel()], axis=1))
    inner = ((at > 2) & (at < [WIDTH - 2, HEIGHT - 2])).all(axis=1).reshape(x.shape)
    difference = np.abs(processed_image(image, plan).astype(int) - picture.to_array())[inner]
    assert inner.mean() > 0.5
    assert difference.max() <= 6
    assert difference.mean() < 0.6


def test_pixels_outside_the_other_image_are_nan() -> None:
    pixels = plan_frame(CAMERAS["OPENCV"], **UNDISTORT)
    corner = carry_points(pixels.original, pixels.processed, np.array([[0.5, 0.5], [240.0, 180.0]]))
    assert np.isnan(corner[0]).all() and np.isfinite(corner[1]).all()
    odd = replace(CAMERAS["PINHOLE"], width=643)
    cropped = plan_frame(odd, max_size_px=1600)
    columns = np.array([[642.5, 100.0], [639.5, 100.0]])
    edge = carry_points(cropped.original, cropped.processed, columns)
    assert np.isnan(edge[0]).all()
    np.testing.assert_array_equal(edge[1], [639.5, 100.0])


def test_pixels_beyond_the_fold_of_a_model_are_empty() -> None:
    """k = -0.4 bends rays beyond tan = 0.91 back, to a second copy of the image."""
    plan = plan_frame(FOLDING, undistort=True)
    reached = reached_region(plan)
    assert reached is not None
    fx, fy, cx, cy = plan.processed.params
    y, x = np.indices(reached.shape) + 0.5
    tangent = np.hypot((x - cx) / fx, (y - cy) / fy)
    fold = np.sqrt(1 / 1.2)
    assert not reached[tangent > fold * 1.01].any()
    assert reached[tangent < 0.4].all()
    image = np.full((FOLDING.height, FOLDING.width, 3), 200, np.uint8)
    shown = processed_image(image, plan)
    assert (shown[reached] == 200).all() and (shown[~reached] == 0).all()
    lost = carry_points(plan.processed, plan.original, np.array([[cx + fx, cy]]))
    assert np.isnan(lost).all()


def test_a_fisheye_beyond_half_a_sphere_is_undistorted() -> None:
    camera = Camera("OPENCV_FISHEYE", 400, 400, (112.0, 112.0, 200.0, 200.0, 0.0, 0.0, 0.0, 0.0))
    plan = plan_frame(camera, undistort=True)
    off_axis = np.column_stack([200.0 + 112.0 * np.radians([101, 30]), [200.0, 200.0]])
    behind, inside = carry_points(plan.original, plan.processed, off_axis)
    # 101 degrees off the axis is behind a pinhole
    assert np.isnan(behind).all()
    fx, _, cx, cy = plan.processed.params
    np.testing.assert_allclose(inside, [cx + fx * np.tan(np.radians(30)), cy], atol=1e-6)


@pytest.mark.parametrize("model", ["RADIAL", "FULL_OPENCV"])
def test_zero_distortion_changes_only_the_model(model: str) -> None:
    full, count = CAMERAS[model], 3 if model == "RADIAL" else 4
    camera = replace(full, params=full.params[:count] + (0.0,) * (len(full.params) - count))
    pinhole = undistorted_camera(camera)
    assert pinhole.model == "PINHOLE"
    points = points_seen()
    np.testing.assert_allclose(px_from_cam(pinhole, points), px_from_cam(camera, points))
    for same in (CAMERAS["SIMPLE_PINHOLE"], pinhole):
        plan = plan_frame(same, undistort=True)
        assert plan.processed == same and not plan.changes_pixels


@pytest.mark.parametrize(("model", "options"), [("OPENCV", UNDISTORT), ("FOV", SMALL)])
def test_masks_are_undistorted_like_images(model: str, options: dict[str, Any]) -> None:
    distorted = CAMERAS[model]
    y, x = np.indices((distorted.height, distorted.width)) + 0.5
    disc = np.hypot(x - 300, y - 150) < 60
    plan = plan_frame(distorted, **options)
    mask = processed_mask(disc, plan)
    image = processed_image(np.repeat(disc[..., None] * np.uint8(255), 3, axis=2), plan)
    sure = (image[..., 0] < 20) | (image[..., 0] > 235)
    np.testing.assert_array_equal(mask[sure], image[..., 0][sure] > 128)
    assert sure.mean() > 0.97 and 0 < mask.mean() < 0.5


def test_fine_detail_is_averaged_not_aliased() -> None:
    camera = CAMERAS["SIMPLE_RADIAL"]
    stripes = painted(lambda x, y: 255.0 * (np.floor(x) % 2))
    plan = plan_frame(camera, undistort=True, max_size_px=120)
    result = processed_image(stripes, plan)[2:-2, 2:-2].astype(float)
    assert plan.shrink > 4
    assert np.abs(result - 127.5).max() < 45
    assert result.std() < 12
