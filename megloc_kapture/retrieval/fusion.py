"""Fusion of several global features, by vectors, similarities or rankings; reranking.

The operators are those of Csurka and Clinchant, "An empirical study of fusion operators for
multimodal image retrieval", CBMI 2012, as kapture-localization has them, which MegLoc uses. With
similarities ``s_i`` of n features and weights ``w_i`` that sum to one:

==============  ===================================================================================
mean            ``sum(w_i s_i)``
power           ``prod(s_i ** w_i)``
maximum         ``max(s_i)``
minimum         ``min(s_i)``
mean_and_power  ``gamma mean + (1 - gamma) power``
mean_and_min    ``gamma mean + (1 - gamma) min``
min_and_max     ``alpha min + (1 - alpha) max``
villena_roman   ``(1 - alpha) max + alpha min ** 2 / (max + min)``
harmonic_mean   ``1 / sum((1 / n) / (w_i s_i))``
ghm             ``1 / sum((1 / n) / (gamma + w_i s_i)) - gamma``, the generalized harmonic mean
early           as ``mean``, in one search: the vectors are concatenated, see :func:`concatenate`
round_robin     first of each feature, second of each feature, ...; see :func:`fuse_rankings`
==============  ===================================================================================

They are written for similarities that are not negative, as those of text are. A cosine may be
negative, where a root is not a number and a mean of reciprocals jumps from one infinity to the
other. So powers, reciprocals and ``villena_roman`` take what is below their domain as its border:
such an image is as bad as can be, and no image gains by being less similar.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.values import Options

RankMethod = Literal["round_robin", "reciprocal_rank", "borda"]
FusionMethod = (
    Literal[
        "mean",
        "power",
        "maximum",
        "minimum",
        "mean_and_power",
        "mean_and_min",
        "min_and_max",
        "villena_roman",
        "harmonic_mean",
        "ghm",
        "early",
    ]
    | RankMethod
)
RANK_METHODS: frozenset[str] = frozenset({"round_robin", "reciprocal_rank", "borda"})
# which operators have which option
_OPTIONS_OF: dict[str, tuple[str, ...]] = {
    "gamma": ("ghm", "mean_and_power", "mean_and_min"),
    "alpha": ("min_and_max", "villena_roman"),
    "rank_constant": ("reciprocal_rank",),
    "list_length": ("reciprocal_rank", "borda"),
}
Similarities = NDArray[np.floating[Any]]
Ranking = tuple[NDArray[np.int64], NDArray[np.float32]]


class FusionOptions(Options):
    """Options of the fusion of several global features' similarities or rankings."""

    method: FusionMethod = Field(
        default="ghm",
        description="ghm: generalized harmonic mean; early: of vectors, each whitened by its own "
        "method; the last three fuse ranks",
    )
    gamma: float = Field(
        default=0.5,
        ge=0,
        description="ghm: what is added to each similarity; mean_and_power, mean_and_min: share "
        "of the mean, at most 1",
    )
    alpha: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="min_and_max: share of the minimum; villena_roman: share of its second term",
    )
    rank_constant: float = Field(
        default=60.0, gt=0, description="reciprocal_rank: added to each rank"
    )
    list_length: int = Field(
        default=200,
        gt=0,
        description="reciprocal_rank, borda: images of each feature's ranking that count, at "
        "least as many as are asked for",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.method in ("mean_and_power", "mean_and_min") and self.gamma > 1:
            raise ValueError(f"gamma is a share in {self.method}, {self.gamma} is more than 1")
        return self

    def fuses_ranks(self) -> bool:
        """True if only the order of each feature's similarities counts."""
        return self.method in RANK_METHODS


def fuse(
    similarities: Sequence[Similarities],
    options: FusionOptions,
    weights: Sequence[float] | None = None,
) -> Similarities:
    """Fuse the similarities of several features, element by element, by a method that is not one of
    RANK_METHODS, which :func:`fuse_rankings` is for.

    Parameters
    ----------
    similarities : per feature float (Q, M), finite; all of one shape and dtype, which is the
        result's.
    weights : one per feature, positive; all equal by default. Maximum, minimum, ``min_and_max`` and
        ``villena_roman`` have no use for them.

    Raises
    ------
    OptionError : weights that cannot be used, or no feature.
    DataError : different shapes.
    """
    shares = normalized_weights(weights, len(similarities)).tolist()
    if len({matrix.shape for matrix in similarities}) != 1:
        shapes = ", ".join(str(matrix.shape) for matrix in similarities)
        raise DataError(f"similarities of different shapes: {shapes}")
    method, gamma, alpha = options.method, options.gamma, options.alpha
    if method in ("mean", "early"):
        return _mean(similarities, shares)
    if method == "power":
        return _power(similarities, shares)
    if method == "mean_and_power":
        return gamma * _mean(similarities, shares) + (1 - gamma) * _power(similarities, shares)
    if method == "harmonic_mean":
        return _harmonic_mean(similarities, shares, 0.0)
    if method == "ghm":
        return _harmonic_mean(similarities, shares, gamma)
    least = np.minimum.reduce(similarities)
    if method == "minimum":
        return least
    if method == "mean_and_min":
        return gamma * _mean(similarities, shares) + (1 - gamma) * least
    largest = np.maximum.reduce(similarities)
    if method == "maximum":
        return largest
    if method == "min_and_max":
        return alpha * least + (1 - alpha) * largest
    return _villena_roman(least, largest, alpha)


def _mean(similarities: Sequence[Similarities], shares: Sequence[float]) -> Similarities:
    total = shares[0] * similarities[0]
    for matrix, share in zip(similarities[1:], shares[1:], strict=True):
        total += share * matrix
    return total


def _power(similarities: Sequence[Similarities], shares: Sequence[float]) -> Similarities:
    product = np.ones_like(similarities[0])
    for matrix, share in zip(similarities, shares, strict=True):
        product *= np.maximum(matrix, 0) ** share
    return product


def _harmonic_mean(
    similarities: Sequence[Similarities], shares: Sequence[float], gamma: float
) -> Similarities:
    """The limit towards the pole, ``-gamma``, is the value at the pole and beyond."""
    count = len(similarities)
    total = np.zeros_like(similarities[0])
    with np.errstate(divide="ignore", over="ignore"):
        for matrix, share in zip(similarities, shares, strict=True):
            # 1 / 0 is infinite, and makes the mean zero
            total += (1 / count) / np.maximum(gamma + share * matrix, 0)
        fused: Similarities = 1 / total
    fused -= gamma
    return fused


def _villena_roman(least: Similarities, largest: Similarities, alpha: float) -> Similarities:
    """As kapture-localization computes it; its help has the minimum in the maximum's place."""
    least, largest = np.maximum(least, 0), np.maximum(largest, 0)
    total = least + largest
    joint = np.divide(least * least, total, out=np.zeros_like(total), where=total > 0)
    return (1 - alpha) * largest + alpha * joint


def normalized_weights(weights: Sequence[float] | None, count: int) -> NDArray[np.float64]:
    """Weights (count,) that sum to one; all equal where none are given.

    Raises OptionError for another number of weights, or one that is not finite and positive. A
    feature that is not to count is left out: harmonic means and ranks know no weight of zero.
    """
    given = np.ones(count) if weights is None else np.asarray(weights, dtype=np.float64)
    if count == 0 or given.shape != (count,):
        raise OptionError(f"{given.size} weights for {count} global features")
    if not (np.isfinite(given).all() and (given > 0).all()):
        raise OptionError(f"weights {given.tolist()} are not all finite and positive")
    normalized: NDArray[np.float64] = given / given.sum()
    return normalized


def concatenate(
    vectors: Sequence[NDArray[np.float32]],
    weights: Sequence[float] | None = None,
    *,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Concatenate the descriptors of several features, float (N, D_i), row by row; float32.

    The inner product of two rows is the weighted mean of the features' cosines: block i is scaled
    by the square root of ``w_i / sum(w)``. It is what late fusion by the mean gives, in one search.
    A row is of unit length where every feature's is; a feature of zeros, of an image that it finds
    nothing in, takes its share away. Weights are positive, one per feature; all equal by default.
    The result is written to ``out`` where it is given.

    Raises
    ------
    OptionError : weights that cannot be used, or none of the features.
    DataError : features of different numbers of images.
    """
    scales = np.sqrt(normalized_weights(weights, len(vectors)))
    if len({len(rows) for rows in vectors}) != 1:
        raise DataError(f"features of {', '.join(str(len(rows)) for rows in vectors)} images")
    shape = (len(vectors[0]), sum(rows.shape[1] for rows in vectors))
    fused = np.empty(shape, dtype=np.float32) if out is None else out
    left = 0
    for rows, scale in zip(vectors, scales.tolist(), strict=True):
        right = left + rows.shape[1]
        np.multiply(rows, np.float32(scale), out=fused[:, left:right])
        left = right
    return fused


def fuse_rankings(
    lists: Sequence[NDArray[np.int64]],
    top_k: int,
    options: FusionOptions,
    weights: Sequence[float] | None = None,
) -> Ranking:
    """Fuse the ranked lists of several features by one of RANK_METHODS.

    ``round_robin`` takes the first of each list in turn, then the second of each, without what was
    there already. ``reciprocal_rank`` sums ``w_i / (rank_constant + rank_i)``, ranks from 1
    (Cormack, Clarke and Buettcher, "Reciprocal rank fusion outperforms Condorcet and individual
    rank learning methods", SIGIR 2009, whose constant is 60). ``borda`` gives the last of the
    longest list one point, each before it one more. A list without the image adds nothing; equal
    sums are in the order of the images. Raises DataError for lists of different numbers of queries,
    OptionError for no list, or weights that cannot be used.

    Parameters
    ----------
    lists : per feature int64 (Q, K_i), best first, -1 where there are no more.
    weights : one per feature, positive; all equal by default. ``round_robin`` has no use for them.

    Returns
    -------
    indices : int64 (Q, top_k), best first, -1 where the lists have no more.
    scores : float32 (Q, top_k), the sums; of ``round_robin`` ``top_k`` for the first, then one less
        each. -inf where -1.
    """
    if not lists:
        raise OptionError("no ranked list to fuse")
    ranks = [np.arange(ranked.shape[-1]) for ranked in lists]
    if options.method == "round_robin":
        turns = [-(own * len(lists) + feature) for feature, own in enumerate(ranks)]
        indices, _ = _best(lists, turns, top_k, np.maximum)
        scores = np.arange(top_k, 0, -1, dtype=np.float32)
        return indices, np.where(indices >= 0, scores, np.float32(-np.inf))
    shares = normalized_weights(weights, len(lists))
    both = list(zip(shares, ranks, strict=True))
    if options.method == "reciprocal_rank":
        points = [share / (options.rank_constant + 1 + own) for share, own in both]
    else:
        points = [share * (max(map(len, ranks)) - own) for share, own in both]
    return _best(lists, points, top_k, np.add)


def _best(
    lists: Sequence[NDArray[np.int64]],
    points: Sequence[NDArray[np.float64 | np.int64]],
    top_k: int,
    together: np.ufunc,
) -> Ranking:
    """The images with most points; ``together`` is what makes one of an image's points."""
    if any(ranked.ndim != 2 or len(ranked) != len(lists[0]) for ranked in lists):
        raise DataError(f"ranked lists of shapes {[ranked.shape for ranked in lists]}")
    every = np.concatenate(lists, axis=1)
    rows = np.repeat(np.arange(len(every)), every.shape[1])
    values = np.tile(np.concatenate(points).astype(np.float64), len(every))
    images = every.ravel()
    there = images >= 0
    rows, values, images = rows[there], values[there], images[there]
    indices = np.full((len(every), top_k), -1, dtype=np.int64)
    scores = np.full((len(every), top_k), -np.inf, dtype=np.float32)
    if len(images) == 0:
        return indices, scores
    order = np.lexsort((images, rows))
    rows, values, images = rows[order], values[order], images[order]
    starts = np.flatnonzero(np.diff(rows, prepend=-1) | np.diff(images, prepend=-1))
    rows, images, values = rows[starts], images[starts], together.reduceat(values, starts)
    order = np.lexsort((images, -values, rows))
    rows, images, values = rows[order], images[order], values[order]
    ranks = np.arange(len(rows)) - np.searchsorted(rows, rows)
    kept = ranks < top_k
    indices[rows[kept], ranks[kept]] = images[kept]
    scores[rows[kept], ranks[kept]] = values[kept]
    return indices, scores


def greedy_coverage(
    keypoint_ids: Sequence[NDArray[np.int64]], keep: int
) -> tuple[list[int], list[int]]:
    """Choose images one by one, each for the keypoints that those before it do not match.

    By the number of matches alone, neighbours of the best image come next, which see the same from
    nearly the same position. This is the greedy solution of maximum coverage, at least a share of 1
    - 1/e of the best one (Nemhauser, Wolsey and Fisher, "An analysis of approximations for
    maximizing submodular set functions", Mathematical Programming 1978).

    Of each image, the query's keypoints that it matches are given, each once. The result is at most
    ``keep`` indices, and the keypoints that each of them adds. Of images that add as many, the one
    with more matches comes first, of those the first.
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


class DiversityOptions(Options):
    """Options of diversity: near-duplicates by pose, and how many a ranking may have."""

    max_per_place: int = Field(default=3, gt=0, description="images within radius and angle")
    radius: float = Field(default=2.0, gt=0, description="of camera centres, unit of the map")
    angle_deg: float = Field(default=30.0, gt=0, le=180, description="between viewing directions")


def diversify(
    ranking: NDArray[np.int64],
    centers: NDArray[np.float64],
    directions: NDArray[np.float64],
    top_k: int,
    options: DiversityOptions,
) -> NDArray[np.int64]:
    """Positions in a ranking, int64 (min(K, top_k),), of the images to keep, in its order.

    Greedy: an image is passed over when ``max_per_place`` of those kept are near it. Passed-over
    images fill what is left of ``top_k`` in the end, so that the ranking stays as long. The ranking
    int64 (K,) has images as rows of camera centres and unit viewing directions, float64 (N, 3),
    best first.
    """
    at, towards = centers[ranking], directions[ranking]
    cosine = np.cos(np.deg2rad(options.angle_deg))
    kept: list[int] = []
    passed: list[int] = []
    for position in range(len(ranking)):
        if len(kept) == top_k:
            break
        distance = np.linalg.norm(at[kept] - at[position], axis=1)
        near = (distance <= options.radius) & (towards[kept] @ towards[position] >= cosine)
        (passed if near.sum() >= options.max_per_place else kept).append(position)
    return np.array([*kept, *passed[: top_k - len(kept)]], dtype=np.int64)
