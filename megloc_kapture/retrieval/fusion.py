"""Fusion of several global features, by similarities or rankings; reranking by coverage.

With similarities ``s_i`` of n features and weights ``w_i`` that sum to one:

===============  ==================================================================================
ghm              ``1 / sum((1 / n) / (gamma + w_i s_i)) - gamma``, the generalized harmonic mean
mean             ``sum(w_i s_i)``
early            cosine of the weighted concatenated vectors: the same as ``mean``
reciprocal_rank  ``sum(w_i / (60 + rank_i))``, ranks from 1
===============  ==================================================================================

The generalized harmonic mean is Csurka and Clinchant's (CBMI 2012), as in kapture-localization and
MegLoc. Similarities below its pole at ``-gamma / w_i`` count as at the pole. Reciprocal rank
fusion: Cormack, Clarke and Buettcher, SIGIR 2009.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import OptionError
from megloc_kapture.values import Options

FusionMethod = Literal["ghm", "mean", "early", "reciprocal_rank"]
_GAMMA = 0.5  # kapture-localization's default
_RANK_CONSTANT = 60  # of Cormack et al.
RANKED_IMAGES = 200  # per feature in reciprocal rank fusion
Similarities = NDArray[np.floating[Any]]
Ranking = tuple[NDArray[np.int64], NDArray[np.float32]]


class FusionOptions(Options):
    """Options of the fusion of several global features' similarities or rankings."""

    method: FusionMethod = Field(
        default="ghm",
        description="fusion of similarities (mean; ghm: generalized harmonic mean), of "
        "concatenated vectors (early), or of ranks (reciprocal_rank)",
    )

    def fuses_ranks(self) -> bool:
        return self.method == "reciprocal_rank"


def fuse(
    similarities: Sequence[Similarities],
    options: FusionOptions,
    weights: Sequence[float] | None = None,
) -> Similarities:
    """Fuse the similarities (Q, M) of several features; weights are equal by default."""
    shares = normalized_weights(weights, len(similarities)).tolist()
    total = np.zeros_like(similarities[0])
    if options.method in ("mean", "early"):
        for matrix, share in zip(similarities, shares, strict=True):
            total += share * matrix
        return total
    with np.errstate(divide="ignore", over="ignore"):
        for matrix, share in zip(similarities, shares, strict=True):
            # 1 / 0 is infinite and makes the mean zero
            total += (1 / len(similarities)) / np.maximum(_GAMMA + share * matrix, 0)
        fused: Similarities = 1 / total
    fused -= _GAMMA
    return fused


def normalized_weights(weights: Sequence[float] | None, count: int) -> NDArray[np.float64]:
    """Return weights (count,) that sum to one, equal by default; OptionError if invalid."""
    given = np.ones(count) if weights is None else np.asarray(weights, dtype=np.float64)
    if count == 0 or given.shape != (count,):
        raise OptionError(f"{given.size} weights for {count} global features")
    if not (np.isfinite(given).all() and (given > 0).all()):
        raise OptionError(f"weights {given.tolist()} are not all finite and positive")
    normalized: NDArray[np.float64] = given / given.sum()
    return normalized


def fuse_rankings(
    lists: Sequence[NDArray[np.int64]], top_k: int, weights: Sequence[float] | None = None
) -> Ranking:
    """Fuse ranked lists, int64 (Q, K_i) per feature, by their reciprocal ranks.

    Returns indices int64 (Q, top_k), best first, -1 if exhausted, and sums float32, -inf where -1.
    Ties keep the order of images.
    """
    shares = normalized_weights(weights, len(lists)).tolist()
    indices = np.full((len(lists[0]), top_k), -1, dtype=np.int64)
    scores = np.full((len(lists[0]), top_k), -np.inf, dtype=np.float32)
    points = [
        share / (_RANK_CONSTANT + 1 + np.arange(ranked.shape[1]))
        for ranked, share in zip(lists, shares, strict=True)
    ]
    for query, rankings in enumerate(zip(*lists, strict=True)):
        images, rows = np.unique(np.concatenate(rankings), return_inverse=True)
        sums = np.bincount(rows, np.concatenate(points), minlength=len(images))
        sums, images = sums[images >= 0], images[images >= 0]
        best = np.argsort(-sums, kind="stable")[:top_k]
        indices[query, : len(best)] = images[best]
        scores[query, : len(best)] = sums[best]
    return indices, scores


def greedy_coverage(
    keypoint_ids: Sequence[NDArray[np.int64]], keep: int
) -> tuple[list[int], list[int]]:
    """Choose images one by one by the keypoints that the previous ones do not match.

    The matches alone would prefer neighbours of the best image. Greedy maximum coverage (Nemhauser,
    Wolsey and Fisher, 1978). ``keypoint_ids`` are each image's matched query keypoints. Returns at
    most ``keep`` indices, and the number of keypoints that each adds.
    """
    size = max((int(ids.max()) + 1 for ids in keypoint_ids if len(ids)), default=0)
    missing = np.ones(size, dtype=bool)
    left = list(range(len(keypoint_ids)))
    order: list[int] = []
    added: list[int] = []
    while left and len(order) < keep:
        gains = {at: int(missing[keypoint_ids[at]].sum()) for at in left}
        best = max(left, key=lambda at: (gains[at], len(keypoint_ids[at]), -at))
        missing[keypoint_ids[best]] = False
        left.remove(best)
        order.append(best)
        added.append(gains[best])
    return order, added
