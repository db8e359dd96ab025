"""Random views of a photograph: their homography is that of their pixels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.training.pairs import HomographyOptions, random_view, relit


def smooth_image() -> NDArray[np.uint8]:
    noise = np.random.default_rng(0).normal(size=(240, 320, 3))
    image = cv2.GaussianBlur(noise, (0, 0), 6)
    return np.clip(128 + 40 * image / image.std(), 0, 255).astype(np.uint8)


def bilinear(image: NDArray[np.uint8], px: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y = (px - 0.5).T
    j, i = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v, values = (x - j)[:, None], (y - i)[:, None], image.astype(np.float64)
    top = values[i, j] * (1 - u) + values[i, j + 1] * u
    return top * (1 - v) + (values[i + 1, j] * (1 - u) + values[i + 1, j + 1] * u) * v


@pytest.mark.parametrize("seed", range(8))
def test_a_view_shows_what_its_homography_says(seed: int) -> None:
    image = smooth_image()
    rng = np.random.default_rng(seed)
    view, view_from_image = random_view(image, (160, 120), rng, HomographyOptions())
    assert view.shape == (120, 160, 3)
    px = rng.uniform((2, 2), (158, 118), (200, 2))
    back = np.column_stack([px, np.ones(200)]) @ np.linalg.inv(view_from_image).T
    there = back[:, :2] / back[:, 2:]
    # all of it lies in the photograph
    assert (there > -1e-3).all() and (there < (320.001, 240.001)).all()
    inside = ((there > 1) & (there < (318, 238))).all(axis=1)
    error = bilinear(view, px[inside]) - bilinear(image, there[inside])
    assert np.abs(error).mean() < 1.0


def test_the_same_numbers_give_the_same_view() -> None:
    first, second = (
        random_view(smooth_image(), (160, 120), np.random.default_rng(5), HomographyOptions())
        for _ in range(2)
    )
    assert first[0].tobytes() == second[0].tobytes()
    lit = [relit(first[0], np.random.default_rng(1)) for _ in range(2)]
    assert lit[0].tobytes() == lit[1].tobytes() != first[0].tobytes()
    assert relit(first[0], np.random.default_rng(1), 0.0) is first[0]


def test_nothing_moves_where_nothing_may() -> None:
    image = smooth_image()
    still = HomographyOptions(min_scale=1.0, max_angle_deg=0.0, perspective=0.0)
    view, view_from_image = random_view(image, (320, 240), np.random.default_rng(0), still)
    np.testing.assert_allclose(view_from_image, np.eye(3), atol=1e-5)
    np.testing.assert_array_equal(view, image)
