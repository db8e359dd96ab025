"""The compiled loops of stereo, against what is worked out by hand."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from megloc_kapture.mvs.kernels import add_path, best_labels, correlate
from megloc_kapture.mvs.plane_kernels import _part_score, _plane_score, _window

_DIRECTIONS = [(y, x) for y, x in product((-1, 0, 1), repeat=2) if (y, x) != (0, 0)]


@pytest.mark.parametrize("direction", _DIRECTIONS)
def test_path_costs_equal_the_minimum_over_label_sequences(direction: tuple[int, int]) -> None:
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
    result = np.empty(truth.shape)
    best_labels(total, result)
    np.testing.assert_allclose(result, truth, atol=0.01)


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


def test_part_of_a_window_scores_as_its_pixels_correlate() -> None:
    rng = np.random.default_rng(3)
    reference = 30 * rng.normal(size=(30, 40)).astype(np.float32)
    source = reference + 20 * rng.normal(size=reference.shape).astype(np.float32)
    values, weights = np.empty(49, np.float32), np.empty(49, np.float32)
    turned = np.array([[1.0, 0.01, 0.1], [-0.02, 1.01, 0.2], [1e-4, 0, 1]])
    plane = np.array([0.5, 0.01, -0.01])
    assert _window(reference, 3, 12, 20, 20.0, values, weights)
    whole = _plane_score(
        values, weights, 3, 12, 20, plane, source, turned, np.array([0.1, 0.2, 0.01])
    )
    # the same window as the source's part that is all of it
    h, b = turned, np.array([0.1, 0.2, 0.01])
    at = h @ [20, 12, 1] + b * plane[0]
    u, v = at[0] / at[2], at[1] / at[2]
    slopes = [h[:, k] + b * plane[1 + k] for k in (0, 1)]
    (ux, vx), (uy, vy) = (
        ((one[0] - u * one[2]) / at[2], (one[1] - v * one[2]) / at[2]) for one in slopes
    )
    part = _part_score(values, weights, 3, source, u, v, ux, uy, vx, vy)
    assert part == pytest.approx(whole, abs=1e-4) and 0.2 < part < 0.99
    # at the image's corner: the pixels that both have, with their weights
    assert _window(reference, 3, 1, 0, 20.0, values, weights)
    assert (weights.reshape(7, 7)[:2] == 0).all() and (weights.reshape(7, 7)[:, :3] == 0).all()
    inside = weights.reshape(7, 7)[2:, 3:].astype(float)
    assert inside.sum() == pytest.approx(1, abs=1e-5)
    ours, theirs = (image[:5, :4].astype(float) for image in (reference, source))
    means = [np.sum(inside * one) for one in (ours, theirs)]
    above = np.sum(inside * (ours - means[0]) * (theirs - means[1]))
    spreads = [
        np.sqrt(np.sum(inside * (one - mean) ** 2))
        for one, mean in zip((ours, theirs), means, strict=True)
    ]
    straight = (np.array([0.0, 0, 0]), source, np.eye(3), np.zeros(3))
    result = _plane_score(values, weights, 3, 1, 0, *straight)
    assert result == pytest.approx(above / (spreads[0] * spreads[1]), abs=1e-4)
    # a source that shows less than half of it says nothing
    assert _part_score(values, weights, 3, source, 36.5, 28.5, 1.0, 0.0, 0.0, 1.0) == -2
