"""Dense maps: suppression, selection, bilinear readings, deformable convolution by definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kornia.feature.aliked.deform_conv2d import deform_conv2d as kornia_deform_conv2d
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from torch.nn import functional

from megloc_kapture.nets import score_maps
from megloc_kapture.nets.score_maps import (
    deform_conv2d,
    pixel_table,
    read_bilinear,
    select_pixels,
    suppress_non_maxima,
)

Scores = NDArray[np.float32]


def by_definition(scores: Scores, radius: int, rounds: int) -> Scores:
    """The suppression as SuperGlue's authors describe it, with scipy's filters."""

    def largest(values: Scores) -> Scores:
        return maximum_filter(values, size=2 * radius + 1, mode="constant", cval=-1)

    kept = scores == largest(scores)
    for _ in range(rounds):
        struck = largest(kept.astype(np.float32)) > 0
        rest = np.where(struck, 0, scores)
        kept |= (rest == largest(rest)) & ~struck
    return np.where(kept, scores, 0)


@pytest.mark.parametrize(("radius", "rounds"), [(0, 2), (1, 0), (4, 2), (70, 1)])
def test_suppression_equals_its_definition(radius: int, rounds: int) -> None:
    scores = np.random.default_rng(radius).uniform(0.01, 1, (47, 62)).astype(np.float32)
    scores[10:14, 20:30] = 0.99  # equal neighbours
    result = suppress_non_maxima(torch.from_numpy(scores)[None], radius, rounds=rounds)
    np.testing.assert_array_equal(result[0].numpy(), by_definition(scores, radius, rounds))


def test_pixels_above_the_threshold_are_selected_by_rows() -> None:
    scores = torch.zeros(6, 7)
    scores[4, 1] = scores[2, 5] = scores[2, 3] = 0.5
    scores[5, 6] = 0.9
    scores[0, 0] = 0.1
    xy, values = select_pixels(scores, threshold=0.1)  # the threshold itself is too little
    assert xy.tolist() == [[3, 2], [5, 2], [1, 4], [6, 5]]
    assert values.tolist() == pytest.approx([0.5, 0.5, 0.5, 0.9])
    # borders hold no keypoints
    inner, _ = select_pixels(torch.ones(9, 7), threshold=0.0, border=3)
    assert inner.tolist() == [[3, 3], [3, 4], [3, 5]]
    assert len(select_pixels(torch.ones(9, 7), threshold=0.0, border=4)[0]) == 0


def test_bilinear_reading_equals_grid_sample_inside_and_outside() -> None:
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(3, 7, 9, generator=generator, dtype=torch.float64)
    x = torch.rand(500, generator=generator, dtype=torch.float64) * 14 - 3
    y = torch.rand(500, generator=generator, dtype=torch.float64) * 12 - 3
    grid = torch.stack([2 * x / 8 - 1, 2 * y / 6 - 1], dim=1)[None, None]
    expected = functional.grid_sample(values[None], grid, align_corners=True)[0, :, 0].T
    result = read_bilinear(pixel_table(values), y, x, (7, 9))
    assert (result - expected).abs().max() < 1e-12
    halved = read_bilinear(pixel_table(values), y, x, (7, 9), torch.full_like(x, 0.5))
    assert (halved - expected / 2).abs().max() < 1e-12


def test_deformable_convolution_equals_kornia(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    x, weight, bias = normal(2, 3, 12, 15), normal(4, 3, 3, 3), normal(4)
    # offsets far beyond the map for some taps
    offset, mask = 3 * normal(2, 18, 12, 15), normal(2, 9, 12, 15).sigmoid()
    expected = kornia_deform_conv2d(x, offset, weight, bias, 1, 1, 1, mask)
    assert (deform_conv2d(x, offset, weight, bias, mask) - expected).abs().max() < 1e-12
    plain = kornia_deform_conv2d(x, offset, weight, None, 1, 1, 1, torch.ones_like(mask))
    assert (deform_conv2d(x, offset, weight) - plain).abs().max() < 1e-12
    monkeypatch.setitem(score_maps._VALUES_AT_ONCE, "cpu", 3 * 15 * 9 * 3)  # strips of three rows
    assert (deform_conv2d(x, offset, weight, bias, mask) - expected).abs().max() < 1e-12
    assert (deform_conv2d(x, torch.full_like(offset, 1e30), weight) == 0).all()
