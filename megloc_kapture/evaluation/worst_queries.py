"""Which queries a page shows with their images: the worst, the disputed, the doubtful."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from megloc_kapture.evaluation.evaluate import Evaluation, QueryResult
from megloc_kapture.evaluation.gallery import Chosen
from megloc_kapture.evaluation.recall import within
from megloc_kapture.evaluation.tables import format_degrees, format_metres
from megloc_kapture.evaluation.without_truth import QueryWithoutTruth, ResultWithoutTruth

NUM_SHOWN = 10


def order_of_badness(query: QueryResult) -> tuple[float, float, str]:
    """Sorts queries the worst first: those without a pose, then by falling error, then by name."""
    return -query.position_m, -query.angle_deg, query.image


def worst_queries(evaluation: Evaluation, number: int = NUM_SHOWN) -> list[Chosen]:
    """The worst queries of a result; at most half of them without a pose, where others are left.

    Of those without a pose the ones with most inliers come first: they failed most narrowly.
    """
    ranked = sorted(evaluation.queries, key=order_of_badness)
    lost = [query for query in ranked if query.outcome == "missing"]
    lost.sort(key=lambda query: (-(query.num_inliers or 0), query.image))
    posed = [query for query in ranked if query.outcome != "missing"]
    num_posed = min(len(posed), max(number - len(lost), (number + 1) // 2))
    return [
        Chosen(
            name=query.image,
            image=evaluation.image(query.image),
            facts=("; ".join(_facts(query)),),
            candidates=_candidates(evaluation, query),
            pose=evaluation.truth[query.image],
            pose_name="true",
        )
        for query in posed[:num_posed] + lost[: number - num_posed]
    ]


def disputed_queries(
    evaluations: Sequence[Evaluation], number: int = NUM_SHOWN
) -> list[tuple[int, Chosen]]:
    """Queries that results disagree about most, then those that are worst in all of them.

    Returns
    -------
    Position of the result that does worst on the query, whose matches are shown, and the query.
    """
    thresholds = evaluations[0].thresholds
    met = np.stack([sum(within(e.errors, t).astype(int) for t in thresholds) for e in evaluations])
    errors = np.stack([e.errors.position_m for e in evaluations])
    dispute = met.max(axis=0) - met.min(axis=0)
    names = evaluations[0].errors.names
    best = errors.min(axis=0)
    by_dispute = sorted(np.flatnonzero(dispute > 0).tolist(), key=lambda i: (-dispute[i], names[i]))
    by_error = sorted(range(len(names)), key=lambda i: (-best[i], -errors[:, i].max(), names[i]))
    chosen = by_dispute[: number - number // 3]
    chosen += [i for i in by_error if i not in set(chosen)][: number - len(chosen)]
    found = []
    for index in chosen:
        queries = [evaluation.queries[index] for evaluation in evaluations]
        worst = max(range(len(queries)), key=lambda k: (errors[k, index], -k))
        facts = tuple(
            f"{evaluation.label}: {', '.join(_facts(query))}"
            for evaluation, query in zip(evaluations, queries, strict=True)
        )
        of_worst = evaluations[worst]
        found.append(
            (
                worst,
                Chosen(
                    name=names[index],
                    image=of_worst.image(names[index]),
                    facts=facts,
                    candidates=_candidates(of_worst, queries[worst]),
                    pose=of_worst.truth[names[index]],
                    pose_name="true",
                ),
            )
        )
    return found


def doubtful_queries(result: ResultWithoutTruth, number: int = NUM_SHOWN) -> list[Chosen]:
    """Localized queries that are least sure: far from every candidate, or of few inliers."""
    localized = [query for query in result.queries if query.outcome == "localized"]
    known = [q.num_inliers for q in localized if q.num_inliers is not None]
    few = float(np.quantile(known, 0.25)) if known else -math.inf

    def doubt(query: QueryWithoutTruth) -> tuple[bool, float, str]:
        far = query.near is not None and query.near.nearest_m > 25.0
        count = math.inf if query.num_inliers is None else query.num_inliers
        return not (far and count <= few), count, query.image

    return [
        Chosen(
            name=query.image,
            image=query.image,
            facts=("; ".join(_facts_without_truth(query)),),
            candidates=query.candidates,
            pose=result.poses[query.image],
            pose_name="estimated",
        )
        for query in sorted(localized, key=doubt)[:number]
    ]


def _candidates(evaluation: Evaluation, query: QueryResult) -> tuple[str, ...]:
    """What the pose comes from; where nothing says so, the reference it was to be found from."""
    if query.candidates or query.image not in evaluation.pairs:
        return query.candidates
    return (evaluation.pairs[query.image].reference,)


def _facts(query: QueryResult) -> tuple[str, ...]:
    facts = []
    if query.outcome == "missing":
        facts.append(f"no pose ({query.reason})")
    else:
        error = f"{format_metres(query.position_m)} m, {format_degrees(query.angle_deg)} deg"
        facts.append(f"{error} off")
        if query.outcome == "fallback":
            facts.append(f"fallback pose ({query.reason})")
    if query.num_inliers is not None:
        facts.append(f"{query.num_inliers} inliers of {query.num_matches}")
    return tuple(facts)


def _facts_without_truth(query: QueryWithoutTruth) -> tuple[str, ...]:
    facts = []
    if query.num_inliers is not None:
        facts.append(f"{query.num_inliers} inliers of {query.num_matches}")
    if query.near is not None:
        facts.append(f"{format_metres(query.near.first_m)} m from its first candidate")
        facts.append(f"{format_metres(query.near.nearest_m)} m from the nearest one")
    return tuple(facts)
