"""The image distance without weights: windows by hand, and what must not count."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.localization.structure import StructureDistance
from megloc_kapture.plugins import ImageDistance

Image = NDArray[np.uint8]
FULL = np.ones((60, 80), bool)


def picture(seed: int, low: int = 50, high: int = 200) -> Image:
    """Coloured blobs, uint8 (60, 80, 3)."""
    coarse = np.random.default_rng(seed).uniform(low, high, (12, 16, 3)).astype(np.float32)
    return cv2.resize(coarse, (80, 60), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


def structure(**options: float) -> StructureDistance:
    return StructureDistance(StructureDistance.Options.model_validate(options))


def by_hand(a: Image, b: Image, valid: NDArray[np.bool_], window: float) -> float:
    """Each window's weights written out."""
    sigma = window * 80
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64) for image in (a, b)]
    rows, columns = np.mgrid[:60, :80]
    reach = (round(sigma * 8 + 1) | 1) // 2  # OpenCV's choice of a kernel for floats
    found = []
    for row in range(60):
        for column in range(80):
            dy, dx = rows - row, columns - column
            inside = (np.abs(dy) <= reach) & (np.abs(dx) <= reach)
            gauss = np.exp(-(dx**2 + dy**2) / (2 * sigma**2)) * inside
            line = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * sigma**2)).sum()
            gauss = gauss / line**2
            if not valid[row, column] or (gauss * valid).sum() < 0.5:
                continue
            weight = gauss * valid / (gauss * valid).sum()
            mean = [(weight * g).sum() for g in grey]
            spread = [(weight * (g - m) ** 2).sum() for g, m in zip(grey, mean, strict=True)]
            cov = (weight * (grey[0] - mean[0]) * (grey[1] - mean[1])).sum()
            found.append(1 - (cov + 9) / (np.sqrt(spread[0] * spread[1]) + 9))
    return float(np.mean(found))


def test_it_is_the_mean_over_windows() -> None:
    valid = FULL.copy()
    valid[:25, 30:] = False
    valid[40:, 5] = False
    expected = by_hand(picture(0), picture(1), valid, 0.05)
    assert 0.3 < expected < 1.7
    found = structure(window=0.05).distance(picture(0), picture(1), valid)
    assert found == pytest.approx(expected, rel=1e-3)


def test_it_is_a_distance() -> None:
    a, b = picture(0), picture(1)
    assert isinstance(structure(), ImageDistance)
    assert structure().distance(a, a, FULL) == pytest.approx(0.0, abs=1e-5)
    assert structure().distance(a, b, FULL) == pytest.approx(structure().distance(b, a, FULL))
    inverted = (255 - a).astype(np.uint8)
    assert structure().distance(a, inverted, FULL) > 1.5


def test_it_grows_as_an_image_moves_away() -> None:
    a = picture(2)
    moved = [structure().distance(a, np.roll(a, shift, axis=1), FULL) for shift in range(4)]
    assert (np.diff(moved) > 0).all()


def test_light_and_shade_do_not_count() -> None:
    a, b = picture(3, 80, 160), picture(4, 80, 160)
    shade = np.linspace(0.6, 1.2, 80)[None, :, None]
    darker = (a * shade + 10).clip(0, 255).astype(np.uint8)
    assert structure().distance(a, darker, FULL) < 0.1 * structure().distance(a, b, FULL)


def test_invalid_pixels_do_not_count() -> None:
    a, b, other = picture(0), picture(1), picture(5)
    valid = FULL.copy()
    valid[20:40, 20:60] = False
    changed = np.where(valid[..., None], b, other)
    assert structure().distance(a, changed, valid) == structure().distance(a, b, valid)
    same = np.where(valid[..., None], a, other)
    assert structure().distance(a, same, valid) == pytest.approx(0.0, abs=1e-4)
    assert structure().distance(a, same, FULL) > 0.05


def test_where_nothing_can_be_told_it_is_infinite() -> None:
    a, b = picture(0), picture(1)
    assert structure().distance(a, b, ~FULL) == np.inf
    single = ~FULL
    single[30, 40] = True
    assert structure().distance(a, b, single) == np.inf
