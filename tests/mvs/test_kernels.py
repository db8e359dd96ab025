"""The compiled loops of stereo, against what is worked out by hand."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from megloc_kapture.mvs.kernels import add_path, best_labels, correlate

_DIRECTIONS = [(y, x) for y, x in product((-1, 0, 1), repeat=2) if (y, x) != (0, 0)]


@pytest.mark.parametrize("direction", _DIRECTIONS)
def test_path_costs_are_those_of_all_label_sequences(direction: tuple[int, int]) -> None:
    rng = np.random.default_rng(5)
    cost = rng.integers(0, 60, (4, 5, 3)).astype(np.uint8)
    grey = rng.uniform(0, 100, (4, 5)).astype(np.float32)
    p1, p2, edge = 7.0, 40.0, 20.0
    total = np.zeros(cost.shape, np.uint16)
    dy, dx = direction
    add_path(cost, grey, p1, p2, edge, dy, dx, total)

    def jump(first: tuple[int, int], second: tuple[int, int], a: int, b: int) -> float:
        if abs(a - b) <= 1:
            return p1 * abs(a - b)
        return max(p1, np.floor(p2 * edge / (edge + abs(float(grey[first] - grey[second])))))

    for y, x in np.ndindex(4, 5):
        path = []
        at = y, x
        while 0 <= at[0] < 4 and 0 <= at[1] < 5:
            path.insert(0, at)
            at = at[0] - dy, at[1] - dx

        def least(path: list[tuple[int, int]], last: int) -> float:
            return min(
                sum(float(cost[p][d]) for p, d in zip(path, labels, strict=True))
                + sum(
                    jump(path[i], path[i + 1], labels[i], labels[i + 1])
                    for i in range(len(path) - 1)
                )
                for labels in product(range(3), repeat=len(path))
                if labels[-1] == last
            )

        before = min(least(path[:-1], d) for d in range(3)) if len(path) > 1 else 0.0
        assert total[y, x].tolist() == [least(path, d) - before for d in range(3)]


def test_a_parabola_gives_its_lowest_point() -> None:
    truth = np.array([[2.3, 5.0, 6.75]])
    labels = np.arange(9)
    total = (100 * (labels - truth[..., None]) ** 2).round().astype(np.uint16)
    found = np.empty(truth.shape)
    best_labels(total, found)
    np.testing.assert_allclose(found, truth, atol=0.01)


def test_cost_is_that_of_the_two_best_correlations() -> None:
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

    # both seen; where the first is not whole, its window has no say and the third does not help
    assert costs[10, 8] == int(255 * (1 - (1 + zncc(1, 10, 8)) / 2))
    assert costs[10, 19] == min(255, int(255 * (1 - (zncc(1, 10, 19) - 1) / 2)))
    assert (costs[:3] == 255).all() and (costs[:, -3:] == 255).all()
