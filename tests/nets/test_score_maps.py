"""Non-maximum suppression and selection against scipy, a greedy search and maps made by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from megloc_kapture.nets.score_maps import select_pixels, suppress_non_maxima, window_maximum

Scores = NDArray[np.float32]


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
