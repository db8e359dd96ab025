"""Sizes, cameras that follow exactly, and resampling that is right to the half pixel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.errors import OptionError
from megloc_kapture.io.colmap import px_from_cam
from megloc_kapture.preprocessing.frame_plan import FrameOptions, plan_frame
from megloc_kapture.preprocessing.frames import processed_image, processed_mask
from megloc_kapture.preprocessing.resizing import (
    cropped_size,
    fitted_size,
    resized,
    scaled_camera,
    with_two_focals,
)
from megloc_kapture.values import Camera


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((4032, 3024), (1600, 1200)),
        ((3024, 4032), (1200, 1600)),
        ((1536, 1024), (1536, 1024)),
        ((1920, 1080), (1600, 900)),
        ((2000, 1333), (1600, 1066)),
        ((1601, 3), (1600, 3)),
        ((100_000, 1), (1600, 1)),
    ],
)
def test_the_larger_side_fits(size: tuple[int, int], expected: tuple[int, int]) -> None:
    assert fitted_size(*size, 1600) == expected


def test_small_images_are_enlarged_only_when_asked() -> None:
    assert fitted_size(1024, 1024, 1600) == (1024, 1024)
    assert fitted_size(1024, 1024, 1600, upscale=True) == (1600, 1600)
    assert fitted_size(512, 768, 1600, upscale=True) == (1067, 1600)


@given(st.integers(1, 6000), st.integers(1, 6000), st.integers(1, 6000))
def test_the_ratio_is_kept_as_whole_pixels_allow(width: int, height: int, target: int) -> None:
    new_width, new_height = fitted_size(width, height, target, upscale=True)
    assert max(new_width, new_height) == target
    exact = min(width, height) * target / max(width, height)
    assert abs(min(new_width, new_height) - max(exact, 1)) <= 0.5 + 1e-9


@given(st.integers(8, 6000), st.integers(8, 6000))
def test_both_sides_become_multiples(width: int, height: int) -> None:
    cropped = cropped_size(width, height, 8)
    assert all(
        new % 8 == 0 and 0 <= old - new < 8
        for old, new in zip((width, height), cropped, strict=True)
    )
    assert cropped_size(width, height, 1) == (width, height)


def test_an_image_too_small_to_crop_is_refused() -> None:
    with pytest.raises(OptionError, match="100x7 cannot be cropped to multiples of 8"):
        cropped_size(100, 7, 8)


def points_seen(camera: Camera, seed: int = 0, count: int = 200) -> np.ndarray:
    """3D points in front of a camera, within its view."""
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-0.6, 0.6, (count, 2)), np.ones((count, 1))], axis=1)
    return rays * rng.uniform(0.5, 50, (count, 1))


@pytest.mark.parametrize("size", [(240, 180), (161, 120), (1000, 749)])
def test_points_project_to_where_the_resized_image_shows_them(
    camera: Camera, size: tuple[int, int]
) -> None:
    points = points_seen(camera)
    scaled = scaled_camera(camera, *size)
    assert (scaled.width, scaled.height) == size
    expected = px_from_cam(camera, points) * [size[0] / camera.width, size[1] / camera.height]
    np.testing.assert_allclose(px_from_cam(scaled, points), expected, rtol=0, atol=1e-9)


def test_the_same_scale_on_both_axes_keeps_the_model(camera: Camera) -> None:
    twice = scaled_camera(camera, 2 * camera.width, 2 * camera.height)
    assert twice.model == camera.model
    one = with_two_focals(camera).params
    np.testing.assert_array_equal(
        np.array(with_two_focals(twice).params[:4]), 2 * np.array(one[:4])
    )
    assert with_two_focals(twice).params[4:] == one[4:]


def test_a_second_focal_length_changes_no_projection(camera: Camera) -> None:
    points = points_seen(camera, seed=1)
    np.testing.assert_allclose(
        px_from_cam(with_two_focals(camera), points), px_from_cam(camera, points), atol=1e-10
    )


@pytest.mark.parametrize("max_size_px", [97, 160, 241, 480])
def test_a_ramp_stays_the_same_function_of_the_ray(
    painted: Callable[..., Any], max_size_px: int
) -> None:
    """Half a pixel's error would be seen as 0.5 (1/s - 1) pixels' worth of the slope."""
    slope_x, slope_y = 1.6, 0.9
    image = painted(lambda x, y: slope_x * x + slope_y * y, 96, 81)
    camera = Camera("PINHOLE", 96, 81, (90.0, 90.0, 48.0, 40.5))
    plan = plan_frame(camera, FrameOptions(max_size_px=max_size_px, upscale=True, multiple_of=1))
    found = processed_image(image, plan)[..., 0].astype(float)
    assert found.shape == (plan.processed.height, plan.processed.width)
    x, y = np.meshgrid(np.arange(found.shape[1]) + 0.5, np.arange(found.shape[0]) + 0.5)
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    at = plan.pixel_map().original_from_processed(points).reshape(*found.shape, 2)
    expected = slope_x * at[..., 0] + slope_y * at[..., 1]
    # cubics need two pixels beside the one that is asked for
    inner = ((at > 3) & (at < [93, 78])).all(axis=2)
    error = (found - expected)[inner]
    assert np.abs(error.mean()) < 0.1
    assert np.abs(error).max() < 1.2


@pytest.mark.parametrize("max_size_px", [121, 200, 333, 900])
def test_a_blob_is_where_the_pixel_map_says(painted: Callable[..., Any], max_size_px: int) -> None:
    centre = np.array([201.3, 120.8])
    image = painted(
        lambda x, y: 250 * np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * 8.0**2))
    )
    camera = Camera("PINHOLE", 483, 362, (330.0, 330.0, 243.0, 181.0))
    plan = plan_frame(camera, FrameOptions(max_size_px=max_size_px, upscale=True))
    found = processed_image(image, plan)[..., 0].astype(float)
    y, x = np.indices(found.shape) + 0.5
    centroid = np.array([[(found * x).sum(), (found * y).sum()]]) / found.sum()
    back = plan.pixel_map().original_from_processed(centroid)
    np.testing.assert_allclose(back[0], centre, atol=0.03)


def test_smaller_pixels_are_means(painted: Callable[..., Any]) -> None:
    board = painted(lambda x, y: 255.0 * ((np.floor(x) + np.floor(y)) % 2), 64, 64)
    np.testing.assert_array_equal(resized(board, 16, 16), np.full((16, 16, 3), 128))


def test_what_is_cropped_moves_nothing(painted: Callable[..., Any]) -> None:
    image = painted(lambda x, y: x + y / 2, 123, 61)
    camera = Camera("SIMPLE_RADIAL", 123, 61, (100.0, 60.0, 30.0, 0.1))
    plan = plan_frame(camera, FrameOptions(max_size_px=1600))
    assert (plan.processed.width, plan.processed.height) == (120, 56)
    assert (plan.processed.model, plan.processed.params) == (camera.model, camera.params)
    np.testing.assert_array_equal(processed_image(image, plan), image[:56, :120])


def test_nothing_to_do_changes_nothing(camera: Camera) -> None:
    plan = plan_frame(camera, FrameOptions())
    assert plan.processed == camera and not plan.changes_pixels
    mask = np.ones((camera.height, camera.width), bool)
    assert processed_mask(mask, plan) is mask


@pytest.mark.parametrize("max_size_px", [60, 97, 200, 480])
def test_a_mask_is_that_of_the_pixel_under_each_centre(max_size_px: int) -> None:
    mask = np.random.default_rng(0).random((61, 123)) > 0.5
    camera = Camera("PINHOLE", 123, 61, (100.0, 100.0, 60.0, 30.0))
    plan = plan_frame(camera, FrameOptions(max_size_px=max_size_px, upscale=True))
    found = processed_mask(mask, plan)
    assert found.shape == (plan.processed.height, plan.processed.width)
    rows, columns = np.indices(found.shape)
    centres = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
    at = plan.pixel_map().original_from_processed(centres)
    # where a centre falls on the edge between two pixels, either is right
    clear = (np.abs(at - np.rint(at)) > 1e-9).all(axis=1)
    assert clear.mean() > 0.5
    column, row = np.floor(at[clear]).astype(int).T
    np.testing.assert_array_equal(found.ravel()[clear], mask[row, column])
