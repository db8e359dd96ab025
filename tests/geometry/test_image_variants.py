"""Variants of an image: where its pixels go, exactly, half a pixel included."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.geometry.image_variants import ImageVariant

SIZES = st.tuples(st.integers(1, 900), st.integers(1, 900))
VARIANTS = st.builds(ImageVariant, st.floats(0.05, 4.0), st.sampled_from((0, 90, 180, 270)))
SCALES = (0.25, 1 / 3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0)


def px_in_variant(variant: ImageVariant, px: np.ndarray, width: int, height: int) -> np.ndarray:
    """Pixels (N, 2) of an image of this size, in its variant."""
    scaled = variant.scaled_size(width, height)
    x, y = px.T * (np.array(scaled)[:, None] / np.array([[width], [height]]))
    turned = {
        0: (x, y),
        90: (y, scaled[0] - x),
        180: (scaled[0] - x, scaled[1] - y),
        270: (scaled[1] - y, x),
    }
    return np.stack(turned[variant.rotation_deg], axis=1)


@given(size=SIZES, variant=VARIANTS, seed=st.integers(0, 100))
def test_there_and_back_is_where_it_was(
    size: tuple[int, int], variant: ImageVariant, seed: int
) -> None:
    px = np.random.default_rng(seed).uniform(0, 1, (20, 2)) * size
    there = px_in_variant(variant, px, *size)
    np.testing.assert_allclose(variant.px_in_original(there, *size), px, atol=1e-9)
    back = variant.px_in_original(px, *size)
    np.testing.assert_allclose(px_in_variant(variant, back, *size), px, atol=1e-9)


@given(size=SIZES, variant=VARIANTS)
def test_corners_stay_corners(size: tuple[int, int], variant: ImageVariant) -> None:
    width, height = size
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], dtype=np.float64)
    w, h = variant.size(width, height)
    # counter-clockwise: the corner that was at the right of the top is now at its left
    turned = np.roll([(0, 0), (w, 0), (w, h), (0, h)], variant.rotation_deg // 90, axis=0)
    np.testing.assert_allclose(px_in_variant(variant, corners, width, height), turned, atol=1e-9)


@pytest.mark.parametrize("rotation", (0, 90, 180, 270))
def test_a_turned_pixel_is_where_the_map_says(rotation: int) -> None:
    variant = ImageVariant(1.0, rotation)
    for column, row in ((0, 0), (6, 0), (2, 3), (6, 4)):
        image = np.zeros((5, 7, 3), np.uint8)
        image[row, column] = (1, 2, 3)
        turned = variant.of_image(image)
        assert turned.shape[:2] == variant.size(7, 5)[::-1]
        ((x, y),) = px_in_variant(variant, np.array([[column + 0.5, row + 0.5]]), 7, 5)
        assert (x % 1, y % 1) == (0.5, 0.5)
        assert turned[int(y), int(x)].tolist() == [1, 2, 3]


@pytest.mark.parametrize("rotation", (0, 90, 180, 270))
@pytest.mark.parametrize("scale", SCALES)
def test_a_scaled_ramp_shows_the_places_its_pixels_come_from(scale: float, rotation: int) -> None:
    # a pixel's value is its place in the original, which means and interpolation leave right
    width, height = 241, 161
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.arange(width)[None]
    image[..., 1] = np.arange(height)[:, None]
    variant = ImageVariant(scale, rotation)
    changed = variant.of_image(image).astype(np.float64)
    rows, columns = np.mgrid[: changed.shape[0], : changed.shape[1]]
    assert (changed.shape[1], changed.shape[0]) == variant.size(width, height)
    px = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)
    original = variant.px_in_original(px, width, height)
    shown = changed[..., :2].reshape(-1, 2) + 0.5
    # beyond the outermost pixels' centres there is nothing to interpolate
    inside = ((original > 1) & (original < [width - 1, height - 1])).all(axis=1)
    error = (shown - original)[inside]
    assert np.abs(error).max() <= 0.51  # values are whole numbers
    assert np.abs(error.mean(axis=0)).max() < 0.05  # half a pixel too much would be 0.17 or more


@given(
    size=st.tuples(st.integers(1, 16), st.integers(1, 16)),
    variant=st.builds(ImageVariant, st.floats(0.1, 3.0), st.sampled_from((0, 90, 180, 270))),
    seed=st.integers(0, 100),
)
def test_a_masks_pixel_is_on_where_all_that_it_covers_is(
    size: tuple[int, int], variant: ImageVariant, seed: int
) -> None:
    width, height = size
    mask = np.random.default_rng(seed).random((height, width)) > 0.1
    changed = variant.of_mask(mask)
    w, h = variant.size(width, height)
    assert changed.shape == (h, w) and changed.dtype == np.bool_
    for y in range(h):
        for x in range(w):
            corners = variant.px_in_original(np.array([(x, y), (x + 1, y + 1)]), width, height)
            (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
            columns = slice(int(left + 1e-9), int(np.ceil(right - 1e-9)))
            rows = slice(int(top + 1e-9), int(np.ceil(bottom - 1e-9)))
            assert changed[y, x] == mask[rows, columns].all()


def test_the_identity_changes_nothing() -> None:
    image = np.random.default_rng(0).integers(0, 255, (5, 7, 3), np.uint8)
    assert ImageVariant().is_identity
    np.testing.assert_array_equal(ImageVariant().of_image(image), image)
    assert not ImageVariant(1.0, 90).is_identity and not ImageVariant(0.5).is_identity


def test_a_small_image_keeps_a_pixel() -> None:
    assert ImageVariant(0.1).of_image(np.zeros((2, 30, 3), np.uint8)).shape == (1, 3, 3)


@pytest.mark.parametrize(
    "wrong", [(1.0, 45), (1.0, 360), (1.0, -90), (0.0, 0), (-1.0, 0), (np.nan, 0), (np.inf, 0)]
)
def test_what_is_no_variant_is_refused(wrong: tuple[float, int]) -> None:
    with pytest.raises(ValueError, match=r"rotation|scale"):
        ImageVariant(*wrong)
