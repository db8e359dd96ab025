"""Undistorted images against OpenCV and COLMAP, and keypoints carried both ways."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from megloc_kapture.io.colmap import px_from_cam
from megloc_kapture.preprocessing.frame_plan import FrameOptions, FramePlan, plan_frame
from megloc_kapture.preprocessing.frames import processed_image, processed_mask, reached_region
from megloc_kapture.preprocessing.pixel_map import PixelMap
from megloc_kapture.preprocessing.undistortion import undistorted_camera
from megloc_kapture.values import Camera

UNDISTORT = FrameOptions(undistort=True, multiple_of=1)
WHOLE = FrameOptions(undistort=True, blank_pixels=1.0)
SMALL = FrameOptions(undistort=True, blank_pixels=1.0, max_size_px=200)
FOLDING = Camera("SIMPLE_RADIAL", 480, 360, (240.0, 240.0, 180.0, -0.4))


def cloudy(height: int = 362, width: int = 483) -> NDArray[np.uint8]:
    """Smooth noise: interpolation of any kind gives nearly the same."""
    noise = np.random.default_rng(3).normal(size=(height, width, 3))
    smooth = cv2.GaussianBlur(noise, (0, 0), 8.0)
    return np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def opencv_matrix(camera: Camera) -> NDArray[np.float64]:
    """Calibration with the first pixel's centre at (0, 0), as OpenCV has it."""
    fx, fy, cx, cy = camera.params[:4]
    return np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])


def assert_same_picture(found: NDArray[np.uint8], expected: NDArray[np.uint8]) -> None:
    difference = np.abs(found.astype(int) - expected.astype(int))[3:-3, 3:-3]
    assert difference.max() <= 4
    assert difference.mean() < 0.6


def random_pixels(camera: Camera, count: int = 500) -> NDArray[np.float64]:
    return np.random.default_rng(5).random((count, 2)) * [camera.width, camera.height]


def test_opencvs_model_as_opencv_undistorts_it(lens: Callable[[str], Camera]) -> None:
    camera, image = lens("OPENCV"), cloudy()
    plan = plan_frame(camera, UNDISTORT)
    size = (plan.processed.width, plan.processed.height)
    maps = cv2.initUndistortRectifyMap(
        opencv_matrix(camera),
        np.array(camera.params[4:]),
        np.eye(3),
        opencv_matrix(plan.processed),
        size,
        cv2.CV_32FC1,
    )
    expected = cv2.remap(image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    assert_same_picture(processed_image(image, plan), expected)


def test_same_size_and_centre_as_opencvs_own_function(lens: Callable[[str], Camera]) -> None:
    camera, image = lens("OPENCV"), cloudy()
    pinhole = Camera("PINHOLE", camera.width, camera.height, camera.params[:4])
    plan = FramePlan(camera, pinhole, (camera.width, camera.height), 1.0)
    expected = cv2.undistort(image, opencv_matrix(camera), np.array(camera.params[4:]))
    assert_same_picture(processed_image(image, plan), expected)


def test_fisheye_as_opencv_undistorts_it(lens: Callable[[str], Camera]) -> None:
    camera, image = lens("OPENCV_FISHEYE"), cloudy()
    plan = plan_frame(camera, UNDISTORT)
    expected = cv2.fisheye.undistortImage(
        image,
        opencv_matrix(camera),
        np.array(camera.params[4:]),
        Knew=opencv_matrix(plan.processed),
        new_size=(plan.processed.width, plan.processed.height),
    )
    assert_same_picture(processed_image(image, plan), expected)


@pytest.mark.parametrize("blank_pixels", [0.0, 1.0])
def test_every_model_as_colmap_undistorts_it(distorted: Camera, blank_pixels: float) -> None:
    image = cloudy()
    theirs = pycolmap.Camera(
        model=distorted.model,
        width=distorted.width,
        height=distorted.height,
        params=list(distorted.params),
    )
    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = blank_pixels
    picture, camera = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(image), theirs)
    changes = {"blank_pixels": blank_pixels, "multiple_of": 1}
    plan = plan_frame(distorted, FrameOptions(undistort=True, **changes))
    assert plan.processed.model == "PINHOLE"
    assert (plan.processed.width, plan.processed.height) == (camera.width, camera.height)
    np.testing.assert_allclose(plan.processed.params, camera.params, rtol=1e-12)
    # COLMAP blends the outermost pixels of the original with black
    y, x = np.indices((camera.height, camera.width)) + 0.5
    at = plan.pixel_map().original_from_processed(np.stack([x.ravel(), y.ravel()], axis=1))
    limit = np.array([distorted.width, distorted.height]) - 2
    inner = ((at > 2) & (at < limit)).all(axis=1).reshape(x.shape)
    difference = np.abs(processed_image(image, plan).astype(int) - picture.to_array())[inner]
    assert inner.mean() > 0.5
    assert difference.max() <= 6
    assert difference.mean() < 0.6


@pytest.mark.parametrize("options", [UNDISTORT, WHOLE, SMALL])
def test_points_project_to_where_they_are_carried(distorted: Camera, options: FrameOptions) -> None:
    """The pose stays: a 3D point's pixel in one image is carried to its pixel in the other."""
    pixels = plan_frame(distorted, options).pixel_map()
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(-0.5, 0.5, (300, 2)), np.ones((300, 1))], axis=1)
    points *= rng.uniform(1, 30, (300, 1))
    before, after = (px_from_cam(c, points) for c in (pixels.original, pixels.processed))
    carried = pixels.processed_from_original(before)
    inside = np.isfinite(carried).all(axis=1)
    assert inside.mean() > 0.8
    np.testing.assert_allclose(carried[inside], after[inside], rtol=0, atol=1e-6)
    back = pixels.original_from_processed(after[inside])
    np.testing.assert_allclose(back, before[inside], rtol=0, atol=1e-6)


@pytest.mark.parametrize("options", [UNDISTORT, WHOLE, SMALL, FrameOptions(max_size_px=200)])
def test_keypoints_come_back_exactly(camera: Camera, options: FrameOptions) -> None:
    pixels = plan_frame(camera, options).pixel_map()
    points = random_pixels(pixels.processed)
    original = pixels.original_from_processed(points)
    reached = np.isfinite(original).all(axis=1)
    assert reached.all() if options.blank_pixels == 0 else reached.mean() > 0.6
    back = pixels.processed_from_original(original[reached])
    np.testing.assert_allclose(back, points[reached], rtol=0, atol=1e-6)


def test_what_the_other_image_does_not_show_is_nan(lens: Callable[[str], Camera]) -> None:
    pixels = plan_frame(lens("OPENCV"), UNDISTORT).pixel_map()
    corner = pixels.processed_from_original(np.array([[0.5, 0.5], [240.0, 180.0]]))
    assert np.isnan(corner[0]).all() and np.isfinite(corner[1]).all()
    cropped = plan_frame(lens("PINHOLE"), FrameOptions(max_size_px=1600)).pixel_map()
    edge = cropped.processed_from_original(np.array([[482.5, 100.0], [479.5, 100.0]]))
    assert np.isnan(edge[0]).all()
    np.testing.assert_array_equal(edge[1], [479.5, 100.0])


def test_beyond_where_a_model_folds_nothing_is_seen() -> None:
    """k = -0.4 bends rays beyond tan = 0.91 back; a second copy of the image must not appear."""
    plan = plan_frame(FOLDING, FrameOptions(undistort=True))
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
    lost = plan.pixel_map().original_from_processed(np.array([[cx + fx, cy]]))
    assert np.isnan(lost).all()


def test_a_fisheye_beyond_half_a_sphere_is_undistorted() -> None:
    camera = Camera("OPENCV_FISHEYE", 400, 400, (112.0, 112.0, 200.0, 200.0, 0.0, 0.0, 0.0, 0.0))
    plan = plan_frame(camera, FrameOptions(undistort=True))
    pixels = plan.pixel_map()
    # 101 degrees off the axis is behind a pinhole
    behind = pixels.processed_from_original(np.array([[200.0 + 112.0 * np.radians(101), 200.0]]))
    assert np.isnan(behind).all()
    at = pixels.processed_from_original(np.array([[200.0 + 112.0 * np.radians(30), 200.0]]))
    fx, _, cx, cy = plan.processed.params
    np.testing.assert_allclose(at, [[cx + fx * np.tan(np.radians(30)), cy]], atol=1e-6)


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"])
def test_without_coefficients_only_the_model_changes(
    lens: Callable[[str], Camera], model: str
) -> None:
    full = lens(model)
    count = 3 if model in ("SIMPLE_RADIAL", "RADIAL") else 4
    params = full.params[:count] + (0.0,) * (len(full.params) - count)
    camera = Camera(model, full.width, full.height, params)
    pinhole = undistorted_camera(camera)
    assert pinhole.model == "PINHOLE"
    points = np.random.default_rng(2).uniform(-1, 1, (50, 3)) + [0, 0, 2.5]
    np.testing.assert_allclose(px_from_cam(pinhole, points), px_from_cam(camera, points))


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_PINHOLE"])
def test_a_pinhole_stays_what_it_is(lens: Callable[[str], Camera], model: str) -> None:
    plan = plan_frame(lens(model), FrameOptions(undistort=True))
    assert plan.processed == lens(model) and not plan.changes_pixels


@pytest.mark.parametrize("options", [UNDISTORT, SMALL])
def test_masks_go_where_their_pixels_go(distorted: Camera, options: FrameOptions) -> None:
    """A disc of the original is a mask and a picture at once."""
    y, x = np.indices((distorted.height, distorted.width)) + 0.5
    disc = np.hypot(x - 300, y - 150) < 60
    plan = plan_frame(distorted, options)
    mask = processed_mask(disc, plan)
    image = processed_image(np.repeat(disc[..., None] * np.uint8(255), 3, axis=2), plan)
    sure = (image[..., 0] < 20) | (image[..., 0] > 235)
    np.testing.assert_array_equal(mask[sure], image[..., 0][sure] > 128)
    assert sure.mean() > 0.97 and 0 < mask.mean() < 0.5


def test_shrunken_detail_is_averaged_not_picked(painted: Callable[..., Any]) -> None:
    """Stripes finer than the new pixels turn grey; samples between them would alias."""
    camera = Camera("SIMPLE_RADIAL", 483, 362, (330.0, 243.0, 181.0, -0.08))
    stripes = painted(lambda x, y: 255.0 * (np.floor(x) % 2))
    plan = plan_frame(camera, FrameOptions(undistort=True, max_size_px=120))
    found = processed_image(stripes, plan)[2:-2, 2:-2].astype(float)
    assert plan.shrink > 4
    assert np.abs(found - 127.5).max() < 45
    assert found.std() < 12


@pytest.mark.parametrize("options", [UNDISTORT, FrameOptions(undistort=True, max_size_px=180)])
def test_a_blob_is_where_the_pixel_map_says(
    distorted: Camera, painted: Callable[..., Any], options: FrameOptions
) -> None:
    centre = np.array([[262.4, 170.3]])
    image = painted(
        lambda x, y: 250 * np.exp(-((x - 262.4) ** 2 + (y - 170.3) ** 2) / (2 * 4.0**2))
    )
    plan = plan_frame(distorted, options)
    found = processed_image(image, plan)[..., 0].astype(float)
    y, x = np.indices(found.shape) + 0.5
    centroid = np.array([[(found * x).sum(), (found * y).sum()]]) / found.sum()
    np.testing.assert_allclose(
        centroid, plan.pixel_map().processed_from_original(centre), atol=0.08
    )


def test_a_pixel_map_of_two_cameras_alone() -> None:
    before = Camera("SIMPLE_RADIAL", 1000, 800, (900.0, 500.0, 400.0, 0.1))
    after = Camera("SIMPLE_RADIAL", 500, 400, (450.0, 250.0, 200.0, 0.1))
    points = np.array([[10.0, 20.0], [999.0, 799.0]], np.float32)
    found = PixelMap(before, after).processed_from_original(points)
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, points / 2)
