"""Concatenation: one inner product is the weighted mean of cosines."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.retrieval.blocks import ConcatenatedBlocks
from megloc_kapture.retrieval.early_fusion import concatenate
from megloc_kapture.retrieval.fusion import FusionOptions
from megloc_kapture.retrieval.search import rank_by_similarity, rank_fused


def unit(seed: int, count: int, dimension: int) -> NDArray[np.float32]:
    rows = np.random.default_rng(seed).normal(size=(count, dimension))
    return (rows / np.linalg.norm(rows, axis=1)[:, None]).astype(np.float32)


@pytest.mark.parametrize("weights", [None, [1.0, 1.0, 1.0], [5.0, 1.0, 0.25]])
def test_the_inner_product_is_the_weighted_mean_of_cosines(weights: list[float] | None) -> None:
    a = [unit(k, 6, 3 + k) for k in range(3)]
    b = [unit(k + 10, 9, 3 + k) for k in range(3)]
    cosines = [x.astype(np.float64) @ y.T.astype(np.float64) for x, y in zip(a, b, strict=True)]
    fused = concatenate(a, weights)
    assert fused.shape == (6, 12) and fused.dtype == np.float32
    expected = np.average(cosines, axis=0, weights=weights)
    np.testing.assert_allclose(fused @ concatenate(b, weights).T, expected, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(fused, axis=1), 1, atol=1e-6)


def test_a_feature_of_zeros_takes_its_share_away() -> None:
    a, b = unit(0, 1, 4), unit(1, 1, 5)
    with_zero = concatenate([a, np.zeros((1, 5), dtype=np.float32)], [3, 1])
    np.testing.assert_allclose(with_zero @ concatenate([a, b], [3, 1]).T, 0.75, atol=1e-6)


def test_blocks_of_several_features_rank_as_the_mean_does() -> None:
    queries = [unit(1, 20, 16), unit(2, 20, 8)]
    database = [unit(3, 300, 16), unit(4, 300, 8)]
    blocks = ConcatenatedBlocks(database, [2, 1])
    assert len(blocks) == 300 and blocks.dimension == 24
    early = rank_by_similarity(concatenate(queries, [2, 1]), blocks, 10)
    mean = FusionOptions(method="mean")
    late = rank_fused(queries, database, 10, fusion=mean, weights=[2, 1])
    np.testing.assert_array_equal(early[0], late[0])
    np.testing.assert_allclose(early[1], late[1], atol=1e-6)


def test_what_cannot_be_concatenated_is_refused() -> None:
    with pytest.raises(DataError, match="2, 3 images"):
        concatenate([unit(0, 2, 4), unit(0, 3, 4)])
    with pytest.raises(DataError, match=r"\[2, 3\] rows"):
        ConcatenatedBlocks([unit(0, 2, 4), unit(0, 3, 4)])
    with pytest.raises(OptionError, match="weights"):
        ConcatenatedBlocks([unit(0, 2, 4), unit(0, 2, 4)], [1.0, 0.0])
    with pytest.raises(OptionError):
        concatenate([])
