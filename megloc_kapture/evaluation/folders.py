"""Evaluate what lies on disk: localized kapture folders or pose files, against true poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.evaluate import Evaluation, evaluate
from megloc_kapture.evaluation.relative import evaluate_pairs
from megloc_kapture.evaluation.results import (
    Poses,
    Result,
    distinct_labels,
    load_poses,
    load_statuses,
    read_result,
)
from megloc_kapture.evaluation.rules import Rules, read_rules
from megloc_kapture.evaluation.surroundings import surroundings_of
from megloc_kapture.evaluation.thresholds import Threshold
from megloc_kapture.evaluation.without_truth import WithoutTruth, evaluate_without_truth
from megloc_kapture.io.kapture_store import KaptureFolder

__all__ = [
    "evaluate_folders",
    "evaluate_results",
    "load_poses",
    "load_statuses",
    "results_without_truth",
]


def evaluate_folders(
    result: Path | str,
    truth: Path | str,
    *,
    side_tables: Path | str | None = None,
    thresholds: Sequence[Threshold] | None = None,
    label: str = "",
    mapping: Path | str | None = None,
) -> Evaluation:
    """Evaluate ``result`` against the kapture folder ``truth``.

    Parameters
    ----------
    result : a kapture folder with trajectories (and perhaps ``status.csv``), or a pose file.
    side_tables : the workspace's ``megloc/`` folder: conditions, which images are scored, the
        protocol, and the world a pose file has to be brought back from.
    thresholds : instead of the protocol's.
    mapping : kapture folder of the map, for MLAD's pairs; found in the workspace of ``result``.

    Raises
    ------
    DataError : something is missing or broken, or there is nothing to count.
    """
    rules = read_rules(side_tables)
    return evaluate_results(
        [result], truth, rules, thresholds=thresholds, mapping=mapping, labels=[label]
    )[0]


def evaluate_results(
    results: Sequence[Path | str],
    truth: Path | str,
    rules: Rules,
    *,
    thresholds: Sequence[Threshold] | None = None,
    mapping: Path | str | None = None,
    labels: Sequence[str] | None = None,
) -> list[Evaluation]:
    """Evaluate several results against one truth, by one set of rules; in their order.

    Where the rules have MLAD's pairs, these are what counts, by MLAD's metric.

    Parameters
    ----------
    results : kapture folders or pose files.
    labels : what the results are called; by default their paths, cut to what tells them apart.

    Raises
    ------
    DataError : something is missing or broken, or there is nothing to count.
    """
    true_poses = KaptureFolder(Path(truth)).read().poses()
    relative = rules.protocol.pose_file == "mlad" and bool(rules.pairs)
    references = _references(results, rules, mapping) if relative else {}
    called = labels or distinct_labels([Path(result) for result in results])
    evaluations = []
    for source, label in zip(results, called, strict=True):
        found = read_result(source, rules, images=true_poses, references=references, label=label)
        if relative:
            evaluation = evaluate_pairs(
                found.poses_of_pairs(rules.pairs),
                true_poses,
                rules.pairs,
                references,
                thresholds=thresholds or rules.thresholds(),
                statuses=found.statuses,
                label=label,
            )
        else:
            evaluation = _by_centers(found, true_poses, rules, thresholds)
        evaluations.append(replace(evaluation, truth_known_by=rules.protocol.truth))
    return evaluations


def results_without_truth(
    results: Sequence[Path | str],
    rules: Rules,
    *,
    thresholds: Sequence[Threshold] | None = None,
    map_poses: Poses | None = None,
    labels: Sequence[str] | None = None,
) -> WithoutTruth:
    """What can be known of results without true poses.

    The queries are those of the challenge's list; without one, those that the results are about.

    Parameters
    ----------
    results : kapture folders or pose files, one or several.
    map_poses : ``cam_from_world`` of the map's images.
    labels : as in :func:`evaluate_results`.

    Raises
    ------
    DataError : something is missing or broken, or there is no query.
    """
    called = labels or distinct_labels([Path(result) for result in results])
    known = {image for place in results for image in surroundings_of(place).query_images()}
    found = [
        read_result(source, rules, images=known, references=map_poses or {}, label=label)
        for source, label in zip(results, called, strict=True)
    ]
    queries = set(rules.names) or {pair.query for pair in rules.pairs}
    if not queries:
        queries = rules.scored({*known, *(image for result in found for image in result.images)})
    return evaluate_without_truth(
        found,
        queries=sorted(queries),
        conditions=rules.conditions(queries),
        thresholds=thresholds or rules.thresholds(),
        condition_order=rules.protocol.conditions,
        pools=rules.protocol.pools,
        map_poses=map_poses,
        statement=rules.protocol.truth,
    )


def _by_centers(
    result: Result, truth: Poses, rules: Rules, thresholds: Sequence[Threshold] | None
) -> Evaluation:
    known = {*truth, *result.poses}
    return evaluate(
        result.poses,
        truth,
        conditions=rules.conditions(known),
        thresholds=thresholds or rules.thresholds(),
        scored=rules.scored(known),
        statuses=result.statuses,
        condition_order=rules.protocol.conditions,
        pools=rules.protocol.pools,
        label=result.label,
    )


def _references(results: Sequence[Path | str], rules: Rules, mapping: Path | str | None) -> Poses:
    """Poses of the reference keyframes: of the map that is given, or of a result's workspace."""
    for result in results:
        poses = surroundings_of(result, mapping=mapping).map_poses()
        if poses:
            return poses
    raise DataError(
        f"the {len(rules.pairs)} pairs to relocalize need the poses of their references, which "
        "are the map's: give it with --map"
    )
