"""The files about several results: as of one, with what differs between them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from megloc_kapture.evaluation.comparison import Comparison, MedianDifference, PairedTest
from megloc_kapture.evaluation.comparison_text import comparison_text, seeds_text
from megloc_kapture.evaluation.evaluate import Evaluation
from megloc_kapture.evaluation.outputs import (
    PER_QUERY_COLUMNS,
    PER_QUERY_CSV,
    RECALL_JSON,
    RECALL_TEXT,
    REPORT_HTML,
    number,
    query_cells,
    recall_summary,
)
from megloc_kapture.evaluation.seeds import Seeds, Spread
from megloc_kapture.evaluation.sentences import comparison_sentences, method_sentence
from megloc_kapture.evaluation.surroundings import Surroundings
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.json_model import write_json
from megloc_kapture.values import RigidTransform

DIFFERENCES_CSV = "differences.csv"
DIFFERENCES_COLUMNS = (
    "position_m",
    "angle_deg",
    "found_by",
    "missed_by",
    "image",
    "condition",
    "found_position_error_m",
    "found_angle_error_deg",
    "missed_position_error_m",
    "missed_angle_error_deg",
)


def write_comparison(
    folder: Path | str,
    comparison: Comparison,
    *,
    map_poses: Mapping[str, RigidTransform] | None = None,
    provenance: Mapping[str, Any] | None = None,
    around: Sequence[Surroundings] = (),
) -> dict[str, Path]:
    """Write recall.json, recall.txt, per_query.csv, differences.csv and report.html.

    Parameters
    ----------
    map_poses, provenance, around : see
        :func:`megloc_kapture.evaluation.comparison_report.render_comparison`.

    Raises
    ------
    OutputError : a file cannot be written.
    """
    # matplotlib loads with it, which other commands need not wait for
    from megloc_kapture.evaluation.comparison_report import render_comparison

    page = render_comparison(comparison, map_poses=map_poses, provenance=provenance, around=around)
    summary = {
        "results": [recall_summary(evaluation) for evaluation in comparison.evaluations],
        "comparison": comparison_summary(comparison),
    }
    paths = _write_common(
        Path(folder), comparison.evaluations, summary, comparison_text(comparison), page
    )
    paths[DIFFERENCES_CSV] = Path(folder) / DIFFERENCES_CSV
    write_csv_table(paths[DIFFERENCES_CSV], DIFFERENCES_COLUMNS, _differences(comparison))
    return paths


def write_seeds(
    folder: Path | str,
    seeds: Seeds,
    *,
    map_poses: Mapping[str, RigidTransform] | None = None,
    provenance: Mapping[str, Any] | None = None,
    around: Sequence[Surroundings] = (),
) -> dict[str, Path]:
    """Write recall.json, recall.txt, per_query.csv and report.html about runs of one method."""
    # matplotlib loads with it, which other commands need not wait for
    from megloc_kapture.evaluation.comparison_report import render_seeds

    page = render_seeds(seeds, map_poses=map_poses, provenance=provenance, around=around)
    summary = {
        "results": [recall_summary(evaluation) for evaluation in seeds.evaluations],
        "seeds": seeds_summary(seeds),
    }
    return _write_common(Path(folder), seeds.evaluations, summary, seeds_text(seeds), page)


def comparison_summary(comparison: Comparison) -> dict[str, Any]:
    """The tests as plain JSON data; queries that one result alone finds are named."""
    labels = [evaluation.label for evaluation in comparison.evaluations]
    return {
        "method": method_sentence(comparison),
        "sentences": [sentence for sentence, _ in comparison_sentences(comparison)],
        "tests": [_test_summary(t, labels) for t in comparison.tests],
        "tests_by_condition": [_test_summary(t, labels) for t in comparison.tests_by_row],
        "medians": [_median_summary(m, labels) for m in comparison.medians],
    }


def seeds_summary(seeds: Seeds) -> list[dict[str, Any]]:
    """Mean and spread of every row as plain JSON data."""
    return [
        {
            "name": row.name,
            "num_queries": row.num_queries,
            "num_localized": _spread_summary(row.num_localized),
            "recall": [
                {
                    "threshold": at.threshold.model_dump(mode="json"),
                    **_spread_summary(at.recall),
                    "found_always": at.always,
                    "found_sometimes": at.sometimes,
                    "found_never": at.never,
                }
                for at in row.recall
            ],
            "median_position_m": _spread_summary(row.median_position_m),
        }
        for row in seeds.rows
    ]


def _write_common(
    folder: Path,
    evaluations: Sequence[Evaluation],
    summary: Mapping[str, Any],
    text: str,
    page: str,
) -> dict[str, Path]:
    names = (RECALL_JSON, RECALL_TEXT, PER_QUERY_CSV, REPORT_HTML)
    paths = {name: folder / name for name in names}
    write_json(paths[RECALL_JSON], summary)
    write_bytes(paths[RECALL_TEXT], text.encode("utf-8"))
    own = PER_QUERY_COLUMNS[2:]
    columns = [
        *PER_QUERY_COLUMNS[:2],
        *(f"{evaluation.label}: {name}" for evaluation in evaluations for name in own),
    ]
    write_csv_table(paths[PER_QUERY_CSV], columns, _per_query(evaluations))
    write_bytes(paths[REPORT_HTML], page.encode("utf-8"))
    return paths


def _per_query(evaluations: Sequence[Evaluation]) -> Iterator[tuple[str, ...]]:
    for queries in zip(*(evaluation.queries for evaluation in evaluations), strict=True):
        image, condition, *_ = query_cells(queries[0])
        yield image, condition, *(cell for query in queries for cell in query_cells(query)[2:])


def _differences(comparison: Comparison) -> Iterator[tuple[str, ...]]:
    """Every query that one result alone finds, by pair and threshold."""
    evaluations = comparison.evaluations
    place = {name: index for index, name in enumerate(evaluations[0].errors.names)}
    for test in comparison.tests:
        sides = (
            (test.first, test.second, test.only_first),
            (test.second, test.first, test.only_second),
        )
        for finder, other, names in sides:
            for name in names:
                found, missed = (evaluations[k].queries[place[name]] for k in (finder, other))
                angle_deg = test.threshold.angle_deg
                yield (
                    number(test.threshold.position_m),
                    "" if angle_deg is None else number(angle_deg),
                    evaluations[finder].label,
                    evaluations[other].label,
                    name,
                    found.condition,
                    *map(number, (found.position_m, found.angle_deg)),
                    *map(number, (missed.position_m, missed.angle_deg)),
                )


def _test_summary(test: PairedTest, labels: Sequence[str]) -> dict[str, Any]:
    return {
        "first": labels[test.first],
        "second": labels[test.second],
        "row": test.row,
        "threshold": test.threshold.model_dump(mode="json"),
        "both": test.num_both,
        "neither": test.num_neither,
        "only_first": list(test.only_first),
        "only_second": list(test.only_second),
        "p_value": test.p_value,
        "p_adjusted": test.p_adjusted,
        "real": test.is_real,
    }


def _median_summary(difference: MedianDifference, labels: Sequence[str]) -> dict[str, Any]:
    return {
        "first": labels[difference.first],
        "second": labels[difference.second],
        "first_m": _finite(difference.first_m),
        "second_m": _finite(difference.second_m),
        "low_m": _finite(difference.low_m),
        "high_m": _finite(difference.high_m),
        "real": difference.is_real,
    }


def _spread_summary(spread: Spread) -> dict[str, float | None]:
    return {
        "mean": _finite(spread.mean),
        "deviation": _finite(spread.deviation),
        "smallest": _finite(spread.smallest),
        "largest": _finite(spread.largest),
    }


def _finite(value: float) -> float | None:
    """JSON has no infinity."""
    return value if math.isfinite(value) else None
