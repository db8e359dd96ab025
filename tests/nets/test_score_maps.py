"""Non-maximum suppression and selection against scipy, a greedy search and maps made by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from megloc_kapture.nets.score_maps import (
    parabola_peak,
    select_keypoints,
    select_pixels,
    soft_argmax,
    suppress_non_maxima,
    window_maximum,
)

Scores = NDArray[np.float32]
XY = np.array([[3.5, 1.5], [0.5, 1.5], [2.5, 0.5], [1.5, 2.5]], np.float32)
SCORES = np.array([0.5, 0.5, 0.9, 0.5], np.float32)
SIZE = (3, 4)


def random_scores(seed: int, shape: tuple[int, int]) -> Scores:
    return np.random.default_rng(seed).uniform(0.01, 1, shape).astype(np.float32)


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


@given(
    height=st.integers(1, 24),
    width=st.integers(1, 24),
    radius=st.integers(0, 9),
    seed=st.integers(0, 99),
)
def test_window_maximum_is_scipys(height: int, width: int, radius: int, seed: int) -> None:
    values = random_scores(seed, (height, width))
    expected = maximum_filter(values, size=2 * radius + 1, mode="constant", cval=-1)
    found = window_maximum(torch.from_numpy(values), radius)
    np.testing.assert_array_equal(found.numpy(), expected)
    bits = values > 0.9
    expected = maximum_filter(bits, size=2 * radius + 1, mode="constant", cval=False)
    found = window_maximum(torch.from_numpy(bits), radius)
    assert found.dtype == torch.bool
    np.testing.assert_array_equal(found.numpy(), expected)


@pytest.mark.parametrize("rounds", [0, 1, 2])
@pytest.mark.parametrize("radius", [0, 1, 3, 4])
def test_suppression_is_its_definition(radius: int, rounds: int) -> None:
    scores = random_scores(radius, (47, 62))
    scores[10:14, 20:30] = 0.99  # equal neighbours
    found = suppress_non_maxima(torch.from_numpy(scores)[None], radius, rounds=rounds)
    np.testing.assert_array_equal(found[0].numpy(), by_definition(scores, radius, rounds))


@given(seed=st.integers(0, 99), radius=st.integers(1, 5))
def test_what_stays_is_far_apart_and_stays_again(seed: int, radius: int) -> None:
    scores = torch.from_numpy(random_scores(seed, (40, 40)))
    once = suppress_non_maxima(scores, radius)
    torch.testing.assert_close(suppress_non_maxima(once, radius), once, rtol=0, atol=0)
    yx = torch.nonzero(once)
    distance = (yx[:, None] - yx).abs().amax(dim=2) + 1000 * torch.eye(len(yx))
    assert distance.min() > radius


def test_isolated_maxima_are_those_of_a_greedy_search() -> None:
    rng = np.random.default_rng(5)
    radius, scores = 4, np.zeros((80, 90), np.float32)
    for y in range(8, 80, 16):  # peaks of a few pixels, further apart than any two windows
        for x in range(8, 90, 16):
            scores[y - 1 : y + 2, x - 1 : x + 2] = rng.uniform(0.1, 1, (3, 3))
    greedy, rest = np.zeros_like(scores), scores.copy()
    while rest.max() > 0:
        y, x = np.unravel_index(rest.argmax(), rest.shape)
        greedy[y, x] = rest[y, x]
        rest[y - radius : y + radius + 1, x - radius : x + radius + 1] = 0
    found = suppress_non_maxima(torch.from_numpy(scores), radius)
    np.testing.assert_array_equal(found.numpy(), greedy)
    assert np.count_nonzero(greedy) == 30  # one of each peak


def test_the_best_come_first_and_ties_by_y_then_x() -> None:
    scores = torch.zeros(6, 7)
    scores[4, 1] = scores[2, 5] = scores[2, 3] = 0.5
    scores[5, 6] = 0.9
    scores[0, 0] = 0.1
    found = select_pixels(scores, threshold=0.1)  # the threshold itself is too little
    assert found.xy.tolist() == [[6, 5], [3, 2], [5, 2], [1, 4]]
    assert found.scores.tolist() == pytest.approx([0.9, 0.5, 0.5, 0.5])
    assert select_pixels(scores, threshold=0.1, max_keypoints=2).xy.tolist() == [[6, 5], [3, 2]]


def test_borders_hold_no_keypoints() -> None:
    found = select_pixels(torch.ones(9, 7), threshold=0.0, border=3)
    assert found.xy.tolist() == [[3, 3], [3, 4], [3, 5]]
    assert len(select_pixels(torch.ones(9, 7), threshold=0.0, border=4).xy) == 0


def test_the_mask_comes_before_the_choice_of_the_best() -> None:
    scores = torch.from_numpy(random_scores(1, (8, 8)))
    mask = np.ones((11, 10), bool)  # of an image that is not a multiple of 8
    best = select_pixels(scores, threshold=0.5, mask=mask, max_keypoints=6)
    assert best.num_masked == 0
    for x, y in best.xy[:4].tolist():
        mask[y, x] = False
    mask[8:], mask[:, 8:] = False, False  # holds no scores
    found = select_pixels(scores, threshold=0.5, mask=mask, max_keypoints=6)
    assert found.num_masked == 4
    everything = select_pixels(scores, threshold=0.5)
    assert found.xy.tolist() == everything.xy[4:10].tolist()


def blob(x: float, y: float, sigma_px: float, size: tuple[int, int] = (21, 25)) -> torch.Tensor:
    rows, columns = torch.meshgrid(
        torch.arange(size[0], dtype=torch.float64),
        torch.arange(size[1], dtype=torch.float64),
        indexing="ij",
    )
    return torch.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma_px**2))


@pytest.mark.parametrize("sigma_px", [1.5, 2.0, 4.0])
@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (0.3, -0.4), (-0.45, 0.1), (0.25, 0.25)])
def test_the_parabola_finds_the_centre_of_a_blob(dx: float, dy: float, sigma_px: float) -> None:
    found = parabola_peak(blob(12 + dx, 10 + dy, sigma_px), torch.tensor([[12, 10]]))
    assert (found - torch.tensor([[12 + dx, 10 + dy]])).abs().max() < 0.05


def test_the_parabola_is_exact_on_a_tilted_paraboloid() -> None:
    rows, columns = torch.meshgrid(
        torch.arange(9, dtype=torch.float64), torch.arange(9, dtype=torch.float64), indexing="ij"
    )
    u, v = columns - 4.2, rows - 3.9
    found = parabola_peak(5 - u * u - 2 * v * v + 0.7 * u * v, torch.tensor([[4, 4]]))
    torch.testing.assert_close(found, torch.tensor([[4.2, 3.9]], dtype=torch.float64))


def test_the_parabola_goes_half_a_pixel_at_most_and_stays_on_flat_ground() -> None:
    slope = torch.arange(9, dtype=torch.float64).repeat(9, 1) ** 2 * 0.1
    slope = slope + slope.T * 0.5
    found = parabola_peak(slope, torch.tensor([[4, 4]]))
    assert (found - 4).abs().max() <= 0.5
    flat = parabola_peak(torch.ones(9, 9), torch.tensor([[4, 4]]))
    assert flat.tolist() == [[4.0, 4.0]]


def test_soft_argmax_by_hand() -> None:
    scores = torch.zeros(7, 8, dtype=torch.float64)
    scores[3, 4], scores[3, 5], scores[2, 4] = 0.5, 0.3, 0.2
    e = torch.exp(scores[2:5, 3:6] / 0.1)
    expected_x = 4 + float((e[:, 2] - e[:, 0]).sum() / e.sum())
    expected_y = 3 + float((e[2] - e[0]).sum() / e.sum())
    found = soft_argmax(scores, torch.tensor([[4, 3]]), 1, 0.1)
    torch.testing.assert_close(found, torch.tensor([[expected_x, expected_y]], dtype=torch.float64))
    assert expected_x > 4 > 3 > expected_y


def test_soft_argmax_of_a_symmetrical_peak_is_its_pixel() -> None:
    found = soft_argmax(blob(12, 10, 1.0), torch.tensor([[12, 10]]), 2, 0.1)
    assert (found - torch.tensor([[12.0, 10.0]])).abs().max() < 1e-12


def test_no_pixels() -> None:
    none = torch.zeros(0, 2, dtype=torch.int64)
    assert soft_argmax(torch.ones(5, 5), none, 2, 0.1).shape == (0, 2)
    assert parabola_peak(torch.ones(5, 5), none).shape == (0, 2)


def test_best_first_and_ties_by_y_then_x() -> None:
    rows, num_masked = select_keypoints(XY, SCORES, size=SIZE, mask=None, max_keypoints=10)
    assert rows.tolist() == [2, 1, 0, 3] and num_masked == 0
    rows, _ = select_keypoints(XY, SCORES, size=SIZE, mask=None, max_keypoints=2)
    assert rows.tolist() == [2, 1]


def test_the_mask_comes_before_the_limit() -> None:
    mask = np.ones(SIZE, bool)
    mask[0, 2] = mask[1, 0] = False
    rows, num_masked = select_keypoints(XY, SCORES, size=SIZE, mask=mask, max_keypoints=1)
    assert rows.tolist() == [0] and num_masked == 2


def test_a_keypoint_stands_in_the_pixel_that_holds_it() -> None:
    # (2, 1) begins the pixel of column 2 and row 1; the image's far edge belongs to its last pixel
    xy = np.array([[1.99, 0.99], [2.0, 1.0], [4.0, 3.0]], np.float32)
    scores = np.array([0.3, 0.2, 0.1], np.float32)
    for row, pixel in enumerate([(0, 1), (1, 2), (2, 3)]):
        mask = np.zeros(SIZE, bool)
        mask[pixel] = True
        rows, num_masked = select_keypoints(xy, scores, size=SIZE, mask=mask, max_keypoints=9)
        assert rows.tolist() == [row] and num_masked == 2


def test_nothing_to_select_from() -> None:
    none = np.zeros((0, 2), np.float32)
    mask = np.zeros(SIZE, bool)
    rows, num_masked = select_keypoints(none, SCORES[:0], size=SIZE, mask=mask, max_keypoints=9)
    assert len(rows) == 0 and num_masked == 0
