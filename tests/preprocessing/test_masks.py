"""Fixed masks, margins, and regions that never change."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.path import Path as Outline
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.ndimage import distance_transform_edt

from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.preprocessing.masks import (
    MIN_IMAGES,
    FixedMask,
    UnchangingRegion,
    edge_directions,
    find_unchanging_region,
    outside_polygon,
    with_margin,
)

MASKS = arrays(np.bool_, st.tuples(st.integers(1, 12), st.integers(1, 12)))
Image = NDArray[np.uint8]


@pytest.mark.parametrize(
    ("share", "height", "used"), [(0.25, 8, 6), (0.2, 5, 4), (0.001, 4, 4), (0.5, 5, 2)]
)
def test_the_bottom_share_is_ignored(share: float, height: int, used: int) -> None:
    mask = FixedMask(camera="rear", bottom_share=share).drawn(3, height)
    assert mask.shape == (height, 3)
    assert mask[:used].all() and not mask[used:].any()


@pytest.mark.parametrize("seed", range(2))
def test_polygons_equal_matplotlib(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 7))
    radius = rng.uniform(0.1, 0.5, 7)
    corners = 0.5 + radius[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    width, height = 61, 307
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    inside = Outline(corners * [width, height]).contains_points(
        np.stack([x.ravel(), y.ravel()], axis=1)
    )
    result = outside_polygon(corners, width, height)
    np.testing.assert_array_equal(~result.ravel(), inside)
    assert 0 < inside.mean() < 1


def test_a_mask_applies_to_a_sensor_or_a_pattern_of_images() -> None:
    by_id = FixedMask(camera="rear", bottom_share=0.1)
    assert by_id.is_for("rear", "left/1.jpg") and not by_id.is_for("left", "rear/1.jpg")
    by_name = FixedMask(camera="*/rear/*.jpg", bottom_share=0.1)
    names = ("day/rear/1.jpg", "day/left/1.jpg", "day/REAR/1.jpg")
    assert [by_name.is_for("c0", name) for name in names] == [True, False, False]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "one of file, polygon and bottom_share"),
        ({"polygon": [(0, 0), (1, 1)]}, "at least 3"),
        ({"polygon": [(0, 0), (1, 1), (0, 1.2)]}, "between 0 and 1"),
    ],
)
def test_invalid_fixed_masks_are_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        FixedMask.model_validate({"camera": "c", **values})


@given(MASKS, st.floats(-1, 6))
def test_pixels_within_the_margin_of_ignored_pixels_are_ignored(
    mask: np.ndarray, margin_px: float
) -> None:
    # the border of the image is no edge of the mask; the library's distances are float32
    distances = np.float32(distance_transform_edt(mask)) if not mask.all() else np.inf
    expected = mask & (distances > np.float32(margin_px))
    result = with_margin(mask, margin_px)
    assert result.dtype == np.bool_
    np.testing.assert_array_equal(result, expected if margin_px > 0 else mask)
    assert with_margin(np.ones_like(mask), margin_px).all()


def region_of(images: list[Image]) -> UnchangingRegion:
    return find_unchanging_region(edge_directions(image) for image in images)


@pytest.mark.slow
def test_a_hand_held_camera_has_no_static_region(shared_data: Path) -> None:
    folder = shared_data / "scenes" / "redkitchen_rgbd" / "mapping" / "sensors" / "records_data"
    paths = sorted(folder.rglob("*.jpg"))[:120:4]
    assert len(paths) == 30
    assert not region_of([read_image_rgb(path) for path in paths])


def noise(seed: int) -> Image:
    rough = np.random.default_rng(seed).normal(size=(120, 200, 3))
    smooth = cv2.GaussianBlur(rough, (0, 0), 2.0)
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def draw_spot(image: Image, seed: int) -> None:
    cv2.circle(image, (100, 40), 18, (20, 20, 20), -1)


def draw_road(image: Image, seed: int) -> None:
    """Draw a plain region without a static edge."""
    rng = np.random.default_rng(1000 + seed)
    top = int(rng.integers(60, 90))
    image[top:] = 90 + rng.normal(0, 2, image[top:].shape)


def draw_strip(image: Image, seed: int) -> None:
    """Draw a static region narrower than any bonnet."""
    image[70:, 96:106] = noise(99)[70:, 96:106]


@pytest.mark.parametrize("draw", [draw_spot, draw_road, draw_strip])
def test_spots_roads_and_strips_are_no_static_region(draw: Callable[[Image, int], None]) -> None:
    images = [noise(seed) for seed in range(16)]
    for seed, image in enumerate(images):
        draw(image, seed)
    assert not region_of(images)


@pytest.mark.parametrize("darkest", [1.0, 0.35])
def test_a_bonnet_without_texture_is_detected_by_its_edge(darkest: float) -> None:
    images = [noise(seed) for seed in range(16)]
    for image in images:
        cv2.ellipse(image, (100, 130), (130, 40), 0, 0, 360, (60, 70, 80), -1)
    plain = (images[0] == (60, 70, 80)).all(axis=2)
    # also in changing light
    gains = np.linspace(darkest, 1.0, len(images))
    lit = [(image * gain).astype(np.uint8) for image, gain in zip(images, gains, strict=True)]
    mask = region_of(lit).mask(200, 120)
    assert (~mask)[plain].mean() > 0.99
    assert (~mask)[~plain].mean() < 0.08


def test_a_still_camera_is_reported() -> None:
    region = region_of([noise(0)] * MIN_IMAGES)
    assert not region and "hardly moves" in region.reason


def test_the_mask_is_below_the_frontier() -> None:
    mask = UnchangingRegion((0.5, 1.0)).mask(6, 4)
    np.testing.assert_array_equal(mask[:, 0], [True, True, False, False])
    np.testing.assert_array_equal(mask.all(axis=0), [False, False, False, True, True, True])
