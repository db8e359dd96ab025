"""Fusion against kapture-localization, and ranks and coverage by hand."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import OptionError
from megloc_kapture.retrieval.search import FusionOptions, fuse, fuse_rankings, greedy_coverage

needs_kapture_localization = pytest.mark.skipif(
    importlib.util.find_spec("kapture_localization") is None,
    reason="kapture-localization is not installed (make test installs it)",
)
OPERATORS = [FusionOptions(method="mean"), FusionOptions(method="ghm")]


def theirs(matrices: Any, options: FusionOptions, weights: Any) -> NDArray[np.float64]:
    from kapture_localization.image_retrieval.fusion import LateFusionMethod, fuse_similarities

    mean = options.method == "mean"
    method = LateFusionMethod("mean" if mean else "generalized_harmonic_mean")
    parameters = {"weights": weights} | ({} if mean else {"gamma": 0.5})
    with np.errstate(all="ignore"):
        fused: NDArray[np.float64] = fuse_similarities(matrices, method, parameters)
    return fused


@needs_kapture_localization
@pytest.mark.parametrize("options", OPERATORS)
@pytest.mark.parametrize("weights", [None, [1.0], [1.0, 3.0, 0.5]])
def test_operators_equal_kapture_localization(
    options: FusionOptions, weights: list[float] | None
) -> None:
    rng = np.random.default_rng(0)
    matrices = [rng.uniform(-0.45, 1, (7, 40)) for _ in weights or range(3)]
    expected = theirs(matrices, options, weights)
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(fuse(matrices, options, weights), expected, rtol=0, atol=1e-9)


def test_the_default_is_the_generalized_harmonic_mean() -> None:
    a, b = np.array([[0.8]]), np.array([[0.2]])
    expected = 1 / (0.5 / (0.5 + 0.75 * 0.8) + 0.5 / (0.5 + 0.25 * 0.2)) - 0.5
    np.testing.assert_allclose(fuse([a, b], FusionOptions(), [3, 1]), expected, rtol=1e-12)


def test_the_generalized_harmonic_mean_is_at_least_minus_gamma() -> None:
    # with equal weights the pole is at a similarity of -1, below which the formula falls
    matrices = [np.array([[-1.2, -1.01, -1.0, -0.999]]), np.full((1, 4), 0.5)]
    fused = fuse(matrices, FusionOptions())
    np.testing.assert_allclose(fused[0, :3], -0.5, atol=1e-12)
    expected = 1 / (0.5 / (0.5 - 0.5 * 0.999) + 0.5 / (0.5 + 0.5 * 0.5)) - 0.5
    np.testing.assert_allclose(fused[0, 3], expected, atol=1e-9)


def test_early_fusion_is_the_weighted_mean_of_cosines_in_float32() -> None:
    cosines = list(np.random.default_rng(0).uniform(-1, 1, (2, 3, 9)).astype(np.float32))
    fused = fuse(cosines, FusionOptions(method="early"), [3, 1])
    assert fused.dtype == np.float32
    np.testing.assert_allclose(fused, 0.75 * cosines[0] + 0.25 * cosines[1], atol=1e-6)


@pytest.mark.parametrize("weights", [[1.0], [1.0, 0.0], [1.0, -1.0], [1.0, np.nan]])
def test_invalid_weights_are_refused(weights: list[float]) -> None:
    with pytest.raises(OptionError, match="weights"):
        fuse([np.zeros((2, 4), np.float32)] * 2, FusionOptions(), weights)


def test_reciprocal_ranks_add_up_and_equal_sums_keep_the_order_of_the_images() -> None:
    # -1 ends a list that is shorter
    lists = [np.array([[5, 3, 9, -1], [-1] * 4]), np.array([[3, 5, 7], [0, -1, -1]])]
    images, sums = fuse_rankings(lists, 3, [1.0, 3.0])
    assert images.tolist() == [[3, 5, 7], [0, -1, -1]]
    by_hand = [0.25 / 62 + 0.75 / 61, 0.25 / 61 + 0.75 / 62, 0.75 / 63]
    np.testing.assert_allclose(sums, [by_hand, [0.75 / 61, -np.inf, -np.inf]], rtol=1e-6)
    equal = [np.array([[5, 3, 9]]), np.array([[3, 5, 7]])]
    assert fuse_rankings(equal, 5)[0].tolist() == [[3, 5, 7, 9, -1]]


def ids(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.int64)


def test_coverage_prefers_images_that_add_more_points() -> None:
    images = [ids(0, 1, 2, 3), ids(0, 1), ids(7, 8), ids(1, 2, 3)]
    assert greedy_coverage(images, 2) == ([0, 2], [4, 2])
    # images that add nothing follow in order of their matches, then of their index
    assert greedy_coverage(images, 9) == ([0, 2, 3, 1], [4, 2, 0, 0])
    assert greedy_coverage([ids(), ids()], 9) == ([0, 1], [0, 0])
    assert greedy_coverage([], 3) == ([], [])
