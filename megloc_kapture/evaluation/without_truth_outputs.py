"""The files about results whose truth is not known: agreement.json, agreement.txt, per_query.csv,
report.html."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import Any

from megloc_kapture.evaluation.outputs import PER_QUERY_CSV, REPORT_HTML, number
from megloc_kapture.evaluation.surroundings import Surroundings
from megloc_kapture.evaluation.without_truth import (
    PRIOR_DISTANCES_M,
    AgreementRow,
    PriorAgreement,
    ResultWithoutTruth,
    WithoutTruth,
)
from megloc_kapture.evaluation.without_truth_text import CAUTION, without_truth_text
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.json_model import write_json
from megloc_kapture.values import RigidTransform

AGREEMENT_JSON = "agreement.json"
AGREEMENT_TEXT = "agreement.txt"

_OWN_COLUMNS = (
    "outcome",
    "num_matches",
    "num_inliers",
    "first_candidate_m",
    "first_candidate_deg",
    "nearest_candidate",
    "nearest_candidate_m",
    "nearest_candidate_deg",
    "reason",
)


def write_without_truth(
    folder: Path | str,
    found: WithoutTruth,
    *,
    map_poses: Mapping[str, RigidTransform] | None = None,
    provenance: Mapping[str, Any] | None = None,
    around: Sequence[Surroundings] = (),
) -> dict[str, Path]:
    """Write the four files into ``folder``, each atomically; returns name -> path.

    Parameters
    ----------
    map_poses, provenance, around : see
        :func:`megloc_kapture.evaluation.without_truth_report.render_without_truth`.

    Raises
    ------
    OutputError : a file cannot be written.
    """
    names = (AGREEMENT_JSON, AGREEMENT_TEXT, PER_QUERY_CSV, REPORT_HTML)
    paths = {name: Path(folder) / name for name in names}
    # matplotlib loads with it, which other commands need not wait for
    from megloc_kapture.evaluation.without_truth_report import render_without_truth

    page = render_without_truth(found, map_poses=map_poses, provenance=provenance, around=around)
    write_json(paths[AGREEMENT_JSON], agreement_summary(found))
    write_bytes(paths[AGREEMENT_TEXT], without_truth_text(found).encode("utf-8"))
    write_csv_table(paths[PER_QUERY_CSV], _columns(found), _rows(found))
    write_bytes(paths[REPORT_HTML], page.encode("utf-8"))
    return paths


def agreement_summary(found: WithoutTruth) -> dict[str, Any]:
    """What ``agreement.json`` holds, as plain JSON data; what is not known is null."""
    labels = [result.label for result in found.results]
    return {
        "statement": found.statement,
        "caution": CAUTION,
        "results": [_result_summary(result) for result in found.results],
        "agreement": [_agreement_summary(row, labels) for row in found.agreement],
    }


def _result_summary(result: ResultWithoutTruth) -> dict[str, Any]:
    return {
        "label": result.label,
        "rows": [
            {
                "name": row.name,
                "num_queries": row.num_queries,
                "num_localized": row.num_localized,
                "num_fallback": row.num_fallback,
                "num_missing": row.num_missing,
                "inliers_quartiles": None if row.inliers is None else list(row.inliers),
                "first_candidate": _prior_summary(row.first),
                "nearest_candidate": _prior_summary(row.nearest),
            }
            for row in result.rows
        ],
    }


def _prior_summary(prior: PriorAgreement | None) -> dict[str, Any] | None:
    if prior is None:
        return None
    within = [
        {"distance_m": distance_m, "num_within": count, "share": count / prior.num_compared}
        for distance_m, count in zip(PRIOR_DISTANCES_M, prior.within, strict=True)
    ]
    return {**asdict(prior), "within": within}


def _agreement_summary(row: AgreementRow, labels: Sequence[str]) -> dict[str, Any]:
    return {
        "first": labels[row.first],
        "second": labels[row.second],
        "name": row.name,
        "num_queries": row.num_queries,
        "num_both": row.num_both,
        "num_only_first": row.num_only_first,
        "num_only_second": row.num_only_second,
        "within": [at.model_dump(mode="json") for at in row.within],
        "median_m": row.median_m if math.isfinite(row.median_m) else None,
        "median_deg": row.median_deg if math.isfinite(row.median_deg) else None,
    }


def _columns(found: WithoutTruth) -> list[str]:
    several = len(found.results) > 1
    columns = ["image", "condition"]
    for result in found.results:
        columns += [f"{result.label}: {name}" if several else name for name in _OWN_COLUMNS]
    labels = [result.label for result in found.results]
    for first, second in combinations(labels, 2):
        columns += [f"{first} to {second}: position_m", f"{first} to {second}: angle_deg"]
    return columns


def _rows(found: WithoutTruth) -> Iterator[list[str]]:
    of_results = zip(*(result.queries for result in found.results), strict=True)
    for index, queries in enumerate(of_results):
        row = [queries[0].image, queries[0].condition]
        for query in queries:
            near = query.near
            row += [
                query.outcome,
                "" if query.num_matches is None else str(query.num_matches),
                "" if query.num_inliers is None else str(query.num_inliers),
                "" if near is None else number(near.first_m),
                "" if near is None else number(near.first_deg),
                "" if near is None else near.nearest,
                "" if near is None else number(near.nearest_m),
                "" if near is None else number(near.nearest_deg),
                query.reason,
            ]
        for apart in found.apart:
            row += [number(apart.position_m[index]), number(apart.angle_deg[index])]
        yield row
