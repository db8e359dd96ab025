"""Pyramids of what is compared: scales, masks, and what changes of light do to the values."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.refinement.pyramid import (
    Appearance,
    build_pyramid,
)

APPEARANCES: tuple[Appearance, ...] = ("normalised", "colours", "intensity", "gradients")


def picture(seed: int = 0, width: int = 200, height: int = 150) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(20, 120, (height // 10, width // 10, 3)).astype(np.uint8)
    return np.kron(coarse, np.ones((10, 10, 1), np.uint8))


@pytest.mark.parametrize("appearance", APPEARANCES)
def test_levels_halve_and_know_their_scale(appearance: Appearance) -> None:
    levels = build_pyramid(picture(), levels=3, max_side_px=100, appearance=appearance)
    channels = 3 if appearance == "colours" else 1
    sizes = [(75, 100), (37, 50), (18, 25)]
    assert [level.values.shape for level in levels] == [(*size, channels) for size in sizes]
    assert [level.scale_x for level in levels] == [0.5, 0.25, 0.125]
    assert levels[1].scale_y == 37 / 150
    assert all(level.values.dtype == np.float32 for level in levels)
    assert len(build_pyramid(picture(), levels=9)) == 4  # none is smaller than 16 px


def test_a_ramp_keeps_its_brightness_where_it_stands() -> None:
    x = np.arange(160) + 0.5
    image = np.broadcast_to(x[None, :, None], (120, 160, 3)).astype(np.uint8)
    for level in build_pyramid(image, levels=3, appearance="intensity"):
        h, w = level.valid.shape
        there = (np.arange(w) + 0.5) / level.scale_x
        middle = slice(w // 4, -w // 4)
        expected = np.broadcast_to((there - 0.5)[middle] / 255, (h, len(there[middle])))
        np.testing.assert_allclose(level.values[:, middle, 0], expected, atol=2e-4)
    finest = build_pyramid(image, levels=1, appearance="gradients")[0]
    np.testing.assert_allclose(finest.values[20:100, 20:140], 1 / 255, rtol=1e-3)


@pytest.mark.parametrize("appearance", APPEARANCES)
def test_what_a_mask_hides_enters_no_value(appearance: Appearance) -> None:
    mask = np.ones((150, 200), bool)
    mask[30:90, 50:120] = False
    images = [picture(), picture()]
    images[1][~mask] = np.random.default_rng(1).integers(0, 256, ((~mask).sum(), 3))
    first, second = (build_pyramid(each, mask, appearance=appearance) for each in images)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.values, b.values)
        np.testing.assert_array_equal(a.valid, b.valid)
    assert not first[0].valid[30:90, 50:120].any() and first[0].valid[:28].all()
    assert first[2].valid.any() and not first[2].valid.all()


@pytest.mark.parametrize("appearance", APPEARANCES)
def test_a_full_mask_changes_nothing(appearance: Appearance) -> None:
    full = np.ones((150, 200), bool)
    with_mask = build_pyramid(picture(), full, appearance=appearance)
    for a, b in zip(with_mask, build_pyramid(picture(), appearance=appearance), strict=True):
        np.testing.assert_allclose(a.values, b.values, atol=1e-6)


def test_colours_are_normalised_each_as_brightness_is() -> None:
    image = picture()
    found = build_pyramid(image, levels=2, appearance="colours")
    for channel in range(3):
        grey = build_pyramid(np.repeat(image[..., channel : channel + 1], 3, axis=2), levels=2)
        for a, b in zip(found, grey, strict=True):
            np.testing.assert_allclose(a.values[..., channel], b.values[..., 0], atol=1e-5)


def test_normalised_values_do_not_depend_on_exposure() -> None:
    # grey, so that brightness is not rounded
    grey = np.repeat(picture()[..., :1], 3, axis=2)
    first, second = build_pyramid(grey), build_pyramid(grey * 2 + 10)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a.values, b.values, atol=1e-4)
        assert 0.5 < a.values.std() < 1.5


def test_gradient_energy_is_that_of_central_differences() -> None:
    mask = np.ones((150, 200), bool)
    mask[70, 100] = False
    level = build_pyramid(picture(), mask, levels=1, appearance="intensity")[0]
    energy = level.gradient_energy
    values = level.values[..., 0]
    expected = (values[50, 81] - values[50, 79]) ** 2 + (values[51, 80] - values[49, 80]) ** 2
    assert energy[50, 80] == pytest.approx(expected)
    assert not energy[0].any() and not energy[:, -1].any() and not energy[70, 99:102].any()


def test_feature_maps_are_compared_as_they_are() -> None:
    def maps(image: NDArray[np.uint8]) -> NDArray[np.float64]:
        return np.stack([image[::4, ::4].mean(2), image[::4, ::4, 0] * 1.0]) / 255

    levels = build_pyramid(picture(), levels=2, features=maps)
    assert [level.values.shape for level in levels] == [(38, 50, 2), (19, 25, 2)]
    assert levels[0].scale_x == 0.25
    mask = np.ones((150, 200), bool)
    mask[40:80, 40:80] = False
    hidden = picture()
    hidden[~mask] = 255
    first, second = (build_pyramid(each, mask, features=maps)[0] for each in (picture(), hidden))
    np.testing.assert_array_equal(first.values, second.values)
    assert not first.valid[12:18, 12:18].any() and first.valid[25:].all()


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(DataError, match="mask"):
        build_pyramid(picture(), np.ones((10, 10), bool))
    with pytest.raises(DataError, match="feature maps"):
        build_pyramid(picture(), features=lambda image: np.zeros((3, 4)))
    with pytest.raises(DataError, match="finite"):
        build_pyramid(picture(), features=lambda image: np.full((1, 40, 40), np.nan))
