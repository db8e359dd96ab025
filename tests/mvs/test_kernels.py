"""The compiled loops of stereo against enumeration and numpy."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.mvs.kernels import add_path, best_labels, correlate

P1, P2, EDGE = 7.0, 40.0, 20.0


def least_costs(
    cost: NDArray[np.uint8], grey: NDArray[np.float32], path: list[tuple[int, int]]
) -> list[float]:
    """Least cost of all label sequences along a path, for each label of its last pixel."""
    least = [np.inf] * 3
    for labels in product(range(3), repeat=len(path)):
        total = float(sum(cost[pixel][label] for pixel, label in zip(path, labels, strict=True)))
        for (first, a), (second, b) in pairwise(zip(path, labels, strict=True)):
            step = abs(float(grey[first] - grey[second]))
            total += P1 * abs(a - b) if abs(a - b) <= 1 else max(P1, P2 * EDGE // (EDGE + step))
        least[labels[-1]] = min(least[labels[-1]], total)
    return least


@pytest.mark.parametrize("direction", [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, 1)])
def test_path_costs_equal_the_minimum_over_label_sequences(direction: tuple[int, int]) -> None:
    rng = np.random.default_rng(5)
    cost = rng.integers(0, 60, (4, 5, 3)).astype(np.uint8)
    grey = rng.uniform(0, 100, (4, 5)).astype(np.float32)
    total = np.zeros(cost.shape, np.uint16)
    dy, dx = direction
    add_path(cost, grey, P1, P2, EDGE, dy, dx, total)
    for y, x in np.ndindex(4, 5):
        steps = range(max(cost.shape))
        path = [(y - k * dy, x - k * dx) for k in steps]
        path = [(v, u) for v, u in path if 0 <= v < 4 and 0 <= u < 5][::-1]
        before = min(least_costs(cost, grey, path[:-1])) if len(path) > 1 else 0.0
        expected = [least - before for least in least_costs(cost, grey, path)]
        assert total[y, x].tolist() == expected


def test_the_best_label_is_the_minimum_of_the_parabola() -> None:
    truth = np.array([[2.3, 5.0, 6.75]])
    labels = np.arange(9)
    total = (100 * (labels - truth[..., None]) ** 2).round().astype(np.uint16)
    result = np.empty(truth.shape)
    best_labels(total, result)
    np.testing.assert_allclose(result, truth, atol=0.01)


def test_the_cost_is_the_mean_of_the_two_best_correlations() -> None:
    rng = np.random.default_rng(1)
    reference = rng.normal(size=(20, 24)).astype(np.float32)
    sources = np.stack(
        [reference * 3 + 10, reference + rng.normal(size=reference.shape), -reference]
    ).astype(np.float32)
    sources[0, :, 15:] = np.nan
    costs = np.empty(reference.shape, np.uint8)
    correlate(reference, sources, 3, costs)

    def zncc(source: int, y: int, x: int) -> float:
        window = np.s_[y - 3 : y + 4, x - 3 : x + 4]
        return float(np.corrcoef(reference[window].ravel(), sources[source][window].ravel())[0, 1])

    # windows with a NaN do not count, and neither does the third image
    assert costs[10, 8] == int(255 * (1 - (1 + zncc(1, 10, 8)) / 2))
    assert costs[10, 19] == min(255, int(255 * (1 - (zncc(1, 10, 19) - 1) / 2)))
    assert (costs[:3] == 255).all() and (costs[:, -3:] == 255).all()
