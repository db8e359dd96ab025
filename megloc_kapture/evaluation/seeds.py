"""Runs of one method with different seeds: recall as mean and spread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from megloc_kapture.evaluation.comparison import check_comparable
from megloc_kapture.evaluation.evaluate import Evaluation
from megloc_kapture.evaluation.recall import within
from megloc_kapture.evaluation.thresholds import Threshold


@dataclass(frozen=True, slots=True)
class Spread:
    """One figure over the runs.

    Parameters
    ----------
    mean, smallest, largest : over the runs.
    deviation : standard deviation of a run (N - 1 in the denominator).
    """

    mean: float
    deviation: float
    smallest: float
    largest: float


@dataclass(frozen=True, slots=True)
class SeedsAt:
    """Recall at one threshold over the runs.

    Parameters
    ----------
    always, sometimes, never : queries within the threshold in all, some or none of the runs.
    """

    threshold: Threshold
    recall: Spread
    always: int
    sometimes: int
    never: int


@dataclass(frozen=True, slots=True)
class SeedsRow:
    """One condition, pool or ``"all"`` over the runs.

    Parameters
    ----------
    num_queries : the same in every run.
    num_localized : queries whose pose was estimated.
    median_position_m : of all queries, by run; a run where most lack a pose makes it infinite.
    """

    name: str
    num_queries: int
    num_localized: Spread
    recall: tuple[SeedsAt, ...]
    median_position_m: Spread


@dataclass(frozen=True, eq=False, slots=True)
class Seeds:
    """All runs and what they have in common.

    Parameters
    ----------
    evaluations : the runs, in the order they were given.
    rows : as those of each run.
    """

    evaluations: tuple[Evaluation, ...]
    rows: tuple[SeedsRow, ...]


def over_seeds(evaluations: Sequence[Evaluation]) -> Seeds:
    """Mean and spread of at least two runs of one method.

    Raises
    ------
    OptionError : fewer than two, or not of the same queries, thresholds and conditions.
    """
    check_comparable(evaluations)
    first = evaluations[0]
    # runs, thresholds, queries
    met = np.stack([[within(e.errors, t) for t in first.thresholds] for e in evaluations])
    rows = []
    for position, (name, chosen) in enumerate(first.members.items()):
        found = met[:, :, chosen]
        of_runs = [evaluation.rows[position] for evaluation in evaluations]
        rows.append(
            SeedsRow(
                name=name,
                num_queries=int(chosen.sum()),
                num_localized=_spread([float(row.num_localized) for row in of_runs]),
                recall=tuple(
                    SeedsAt(
                        threshold=threshold,
                        recall=_spread([row.recall[index].recall for row in of_runs]),
                        always=int(found[:, index].all(axis=0).sum()),
                        sometimes=int(
                            (found[:, index].any(axis=0) & ~found[:, index].all(axis=0)).sum()
                        ),
                        never=int((~found[:, index].any(axis=0)).sum()),
                    )
                    for index, threshold in enumerate(first.thresholds)
                ),
                median_position_m=_spread([row.median_position_m for row in of_runs]),
            )
        )
    return Seeds(tuple(evaluations), tuple(rows))


def _spread(values: Sequence[float]) -> Spread:
    numbers = np.array(values, dtype=np.float64)
    finite = bool(np.isfinite(numbers).all())
    return Spread(
        mean=float(numbers.mean()),
        deviation=float(numbers.std(ddof=1)) if finite else float("inf"),
        smallest=float(numbers.min()),
        largest=float(numbers.max()),
    )
