"""Images made smaller for a network: sizes, and the means of areas."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from megloc_kapture.nets.runtime import sized_tensor

CPU = torch.device("cpu")


def test_an_image_that_is_small_enough_stays() -> None:
    image = np.random.default_rng(0).integers(0, 256, (6, 9, 3), dtype=np.uint8)
    for most in (9, 100, None):
        found = sized_tensor(image, most, CPU)
        assert found.shape == (1, 3, 6, 9) and found.dtype == torch.float32
        np.testing.assert_allclose(found[0].numpy() * 255, image.transpose(2, 0, 1), atol=1e-4)


def test_half_the_size_is_the_mean_of_four() -> None:
    image = np.random.default_rng(0).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    found = sized_tensor(image, 6, CPU)[0].permute(1, 2, 0).numpy() * 255
    expected = image.reshape(4, 2, 6, 2, 3).astype(float).mean(axis=(1, 3))
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert np.abs(expected - expected.round()).max() > 0.2  # fractions are kept


@pytest.mark.parametrize(
    ("height", "width", "most", "size"),
    [(480, 640, 320, (240, 320)), (1000, 601, 500, (500, 300)), (3, 2000, 100, (1, 100))],
)
def test_sizes(height: int, width: int, most: int, size: tuple[int, int]) -> None:
    image = np.zeros((height, width, 3), np.uint8)
    assert sized_tensor(image, most, CPU).shape == (1, 3, *size)
