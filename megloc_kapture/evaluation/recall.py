"""Recall at thresholds, per condition and pooled, with its confidence and the medians beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, PlainSerializer

from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.confidence import confidence_interval
from megloc_kapture.evaluation.pose_errors import PoseErrors
from megloc_kapture.evaluation.thresholds import Threshold
from megloc_kapture.values import Options

ALL = "all"

# JSON has no infinity: an infinite median ("most queries have no pose") is null there
MaybeInfinite = Annotated[
    float,
    BeforeValidator(lambda value: np.inf if value is None else value),
    PlainSerializer(lambda value: value if np.isfinite(value) else None, when_used="json"),
]


class RecallAt(Options):
    """Recall at one threshold.

    Parameters
    ----------
    num_within : queries within the threshold, of the row's ``num_queries``.
    recall : their ratio.
    low, high : the 95 % confidence interval of ``recall``
        (:func:`megloc_kapture.evaluation.confidence.confidence_interval`).
    """

    threshold: Threshold
    num_within: int
    recall: float
    low: float
    high: float


class RecallRow(Options):
    """Recall and medians of one group of queries.

    Parameters
    ----------
    name : the condition, or the name of a pool.
    num_queries : every query of the group: the denominator of recall.
    num_localized : queries whose pose was estimated.
    num_fallback : queries whose pose is a fallback, a guess; they count in recall as any pose
        does, but not as localized.
    num_missing : queries without a pose.
    recall : one entry per threshold, in the order of the thresholds.
    median_position_m, median_angle_deg : over all queries, a missing pose counting as infinite.
    median_localized_position_m, median_localized_angle_deg : over the localized queries only;
        infinite if there are none.
    """

    name: str
    num_queries: int
    num_localized: int
    num_fallback: int
    num_missing: int
    recall: tuple[RecallAt, ...]
    median_position_m: MaybeInfinite
    median_angle_deg: MaybeInfinite
    median_localized_position_m: MaybeInfinite
    median_localized_angle_deg: MaybeInfinite


def within(errors: PoseErrors, threshold: Threshold) -> NDArray[np.bool_]:
    """(N,) whether each query is at or below (``<=``) both bounds; one without a pose never is."""
    inside = errors.has_pose & (errors.position_m <= threshold.position_m)
    if threshold.angle_deg is not None:
        inside &= errors.angle_deg <= threshold.angle_deg
    return inside


def recall_row(
    name: str,
    errors: PoseErrors,
    thresholds: Sequence[Threshold],
    *,
    members: NDArray[np.bool_] | None = None,
    fallback: NDArray[np.bool_] | None = None,
) -> RecallRow:
    """Recall and medians of the queries ``members`` (N,), by default all of ``errors``.

    Parameters
    ----------
    fallback : (N,) whether the query's pose is a fallback; by default none is.
    """
    chosen = np.ones(len(errors.names), bool) if members is None else members
    guessed = np.zeros(len(errors.names), bool) if fallback is None else fallback
    posed = errors.has_pose & chosen
    localized = posed & ~guessed
    num_queries = int(chosen.sum())
    counts = [int((within(errors, threshold) & chosen).sum()) for threshold in thresholds]
    lows, highs = confidence_interval(counts, num_queries)
    return RecallRow(
        name=name,
        num_queries=num_queries,
        num_localized=int(localized.sum()),
        num_fallback=int((posed & guessed).sum()),
        num_missing=num_queries - int(posed.sum()),
        recall=tuple(
            RecallAt(
                threshold=threshold,
                num_within=count,
                recall=count / num_queries if num_queries else 0.0,
                low=float(low),
                high=float(high),
            )
            for threshold, count, low, high in zip(thresholds, counts, lows, highs, strict=True)
        ),
        median_position_m=_median(errors.position_m[chosen]),
        median_angle_deg=_median(errors.angle_deg[chosen]),
        median_localized_position_m=_median(errors.position_m[localized]),
        median_localized_angle_deg=_median(errors.angle_deg[localized]),
    )


def row_members(
    conditions: Sequence[str],
    *,
    order: Sequence[str] = (),
    pools: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, NDArray[np.bool_]]:
    """The rows of a recall table and the queries they count: one row per condition, then one per
    pool, then ``"all"``.

    A pool counts the queries of its conditions together; it is not the mean of their recalls.

    Parameters
    ----------
    conditions : the condition of each of the N queries, ``""`` for none. Where no query has one,
        there is only the row ``"all"``.
    order : conditions in the order to report them; others follow, sorted, those without last.
    pools : name -> conditions; a pool without queries is left out.

    Returns
    -------
    Name -> bool (N,).

    Raises
    ------
    OptionError : two rows would bear one name.
    """
    of_query = np.array(list(conditions), str)
    present = set(of_query.tolist())
    named = [c for c in order if c in present] + sorted(present - {""} - set(order))
    if named and "" in present:
        named.append("")
    members: dict[str, NDArray[np.bool_]] = {c: of_query == c for c in named}
    for pool, parts in (pools or {}).items():
        _check_free(pool, members)
        pooled = np.isin(of_query, list(parts))
        if pooled.any():
            members[pool] = pooled
    _check_free(ALL, members)
    members[ALL] = np.ones(len(of_query), bool)
    return members


def recall_rows(
    errors: PoseErrors,
    thresholds: Sequence[Threshold],
    members: Mapping[str, NDArray[np.bool_]],
    *,
    fallback: NDArray[np.bool_] | None = None,
) -> tuple[RecallRow, ...]:
    """The rows of a recall table, of the queries that :func:`row_members` puts into them."""
    return tuple(
        recall_row(name, errors, thresholds, members=chosen, fallback=fallback)
        for name, chosen in members.items()
    )


def _check_free(name: str, taken: Mapping[str, object]) -> None:
    if name in taken:
        raise OptionError(f"two rows of the recall table would be called {name!r}; rename one")


def _median(values: NDArray[np.float64]) -> float:
    """Median; of nothing, or of more missing than present, infinite."""
    return float(np.median(values)) if values.size else float("inf")
