"""Reports of one result and of several: sentences, text, files and page."""

from __future__ import annotations

import csv
import html
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scored import displaced, evaluate_poses, evaluation_of, make_world, shifted

from megloc_kapture.errors import OutputError
from megloc_kapture.evaluation.comparison import compare
from megloc_kapture.evaluation.metrics import Threshold
from megloc_kapture.evaluation.report.content import refinement_table
from megloc_kapture.evaluation.report.queries import shown_queries, worst_queries
from megloc_kapture.evaluation.report.reports import render_report, report_text, write_report
from megloc_kapture.evaluation.results import ResultContext
from megloc_kapture.values import LocalizationResult, PoseRefinement, RigidTransform

HERE = RigidTransform.identity()


def visible_text(page: str) -> str:
    """Return the text of a page that refers to its own elements and to the 3D view alone."""
    ids = re.findall(r'\bid="([^"]*)"', page)
    references = re.findall(r'\b(?:href|src)="([^"]*)"', page) + re.findall(r"url\(([^)]*)\)", page)
    assert len(ids) == len(set(ids)) and references
    for reference in references:
        ours = reference.startswith("data:") or reference == "view.html"
        assert ours or reference.removeprefix("#") in ids, reference
    text = re.sub(r"<style.*?</style>|<[^>]*>", " ", page, flags=re.DOTALL)
    return " ".join(html.unescape(text).split())


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_names_are_escaped_and_the_steps_of_the_paper_come_first(world: Any) -> None:
    evil = '"><script>alert(1)</script>'
    name = f"query/{evil}.jpg"
    world.truth[name] = HERE
    world.conditions = {n: "<i>day & $night$" for n in world.truth}
    world.statuses[name] = LocalizationResult(name=name, reason=f"why {evil}")
    steps = [
        {"name": "ASLFeat", "on": True, "why": "preset megloc"},
        {"name": "poses refined by ICP", "on": False, "why": "<no> depth"},
    ]
    provenance = {"root": f"/data/{evil}", "preset": "megloc", "steps": steps}
    evaluation = evaluation_of(world, "a <b>bold</b> & daring result")
    page = render_report(evaluation, provenance=provenance)
    assert not any(tag in page for tag in ("<script", "<i>day", "<b>bold"))
    text = visible_text(page)
    assert all(name in text for name in world.truth)
    assert f"why {evil}" in text and "6 inliers, 12 needed" in text
    assert "Stages: 1 of 2 are on" in text
    assert text.index("ASLFeat") < text.index("poses refined by ICP") < text.index("Recall")
    assert "<no> depth" in text and "<no>" not in page
    assert "steps" not in page.partition("<pre>")[2]  # not once more at the end


def test_files(world: Any, tmp_path: Path) -> None:
    evaluation = evaluation_of(world)
    provenance = {"preset": "classic"}
    write_report(tmp_path / "evaluation", evaluation, provenance=provenance)
    paths = {path.name: path for path in (tmp_path / "evaluation").iterdir()}

    assert "Recall" in visible_text(paths["report.html"].read_text())
    with pytest.raises(OutputError, match="recall"):
        write_report(paths["recall.txt"], evaluation)
    names = ["per_query.csv", "recall.json", "recall.txt", "report.html", "view.html"]
    assert sorted(paths) == names
    assert paths["recall.txt"].read_text() == report_text(evaluation)
    summary = json.loads(paths["recall.json"].read_text())
    assert summary["label"] == evaluation.label
    assert [row["name"] for row in summary["rows"]] == ["day", "night", "all"]
    whole = summary["rows"][-1]
    for at in whole["recall"]:
        assert at["recall"] == at["num_within"] / whole["num_queries"]
    assert whole["num_fallback"] == 4
    rows = rows_of(paths["per_query.csv"])
    assert [row["image"] for row in rows] == sorted(world.truth)
    for row, position_m in zip(rows, evaluation.errors.position_m, strict=True):
        if row["outcome"] == "missing":
            assert row["position_error_m"] == "" and position_m == np.inf
        else:
            assert float(row["position_error_m"]) == position_m


def test_text_of_two_results(world: Any) -> None:
    day = sorted(name for name in world.estimated if world.conditions[name] == "day")
    fewer = {name: pose for name, pose in world.estimated.items() if name not in day[:8]}
    results = [
        evaluation_of(world, f"/data/{'x' * 40}/localized"),
        evaluation_of(replace(world, estimated=fewer), "fewer"),
    ]
    comparison = compare(results)
    (median,) = comparison.medians
    assert median.first_m == results[0].row().median_position_m
    assert median.low_m <= median.first_m - median.second_m <= median.high_m
    text = report_text(comparison)
    for row in results[1].rows:
        assert " / ".join(f"{100 * at.recall:.1f}" for at in row.recall) in text
    assert "localized localizes 8 queries that fewer misses" in " ".join(text.split())
    # long labels are cut, in the table only
    assert "/data/xxxxxxx...xxx/localized" in text
    # equal results, with poses and without any
    for estimated, sentence in (
        (world.estimated, "A and B localize the same "),
        ({}, "neither A nor B localizes any query."),
    ):
        twins = [evaluation_of(replace(world, estimated=estimated), label) for label in "AB"]
        assert sentence in " ".join(report_text(compare(twins)).split())


def test_queries_are_shown_the_worst_first() -> None:
    world = make_world(num_queries=40)
    posed = dict(sorted(world.estimated.items())[:12])
    evaluation = evaluate_poses(posed, world.truth, statuses=world.statuses)
    ranked = shown_queries(evaluation)
    assert [query.cam_from_world is None for query in ranked] == [True] * 28 + [False] * 12
    errors = [query.position_m for query in ranked]
    assert errors == sorted(errors, reverse=True)
    # the gallery is not of queries without a pose alone
    chosen = worst_queries(ranked)
    assert chosen == [*ranked[28:33], *ranked[:5]]


def test_refinement_before_and_after() -> None:
    truth = {name: HERE for name in "abcd"}
    off = {m: displaced(HERE, np.array([m, 0.0, 0.0]), 0.0) for m in (0.4, 0.3, 0.2, 0.1, 0.02)}

    def row(method: str, before: float, reason: str = "", after: float = 0.0) -> PoseRefinement:
        moved_m = before - after if after else 0.0
        known = {"method": method, "before": off[before], "moved_m": abs(moved_m)}
        return PoseRefinement(off[after or before], reason, **known)

    refinements = {
        # 0.4 -> 0.2 -> 0.02; 0.3 stays, -> 0.1; 0.1 -> 0.2, stays; d is not refined
        "a": [row("icp", 0.4, after=0.2), row("rendering", 0.2, after=0.02)],
        "b": [row("icp", 0.3, "3.5 m apart"), row("rendering", 0.3, after=0.1)],
        "c": [row("icp", 0.1, after=0.2), row("rendering", 0.2, "covers 12 %")],
    }
    estimated = {"a": off[0.02], "b": off[0.1], "c": off[0.2], "d": off[0.02]}
    evaluation = evaluate_poses(estimated, truth)
    assert refinement_table(evaluation) is None
    context = ResultContext(refinements=refinements)
    table = refinement_table(replace(evaluation, context=context))
    assert table is not None and table.to_dict("records") == [
        {
            "step": "icp",
            "queries": 3,
            "accepted": 2,
            "moved by (median)": "0.1500 m, 0.000 deg",
            "error before": "0.2500 m, 0.000 deg",
            "error after": "0.2000 m, 0.000 deg",
            "reasons for rejection": "1 x … m apart",
        },
        {
            "step": "rendering",
            "queries": 3,
            "accepted": 2,
            "moved by (median)": "0.1900 m, 0.000 deg",
            "error before": "0.2500 m, 0.000 deg",
            "error after": "0.0600 m, 0.000 deg",
            "reasons for rejection": "1 x covers … %",
        },
    ]


TABLE = """\
aachen

recall (%) at 0.05 m, 5 deg / 0.25 m, 2 deg / 0.5 m, 5 deg / 5 m, 10 deg
Both errors at or below (<=) the threshold; a query without a pose counts as a miss.

condition  queries  localized  recall (%)                  median (m, deg)  median of localized
day        3        3          33.3 / 66.7 / 66.7 / 100.0  0.1000, 0.000    0.1000, 0.000
night      2        1          0.0 / 0.0 / 50.0 / 50.0     inf              0.4000, 0.000
all        5        4          20.0 / 40.0 / 60.0 / 80.0   0.4000, 0.000    0.2500, 0.000

95 % confidence intervals of recall, queries assumed independent (%)
condition  0.05 m, 5 deg  0.25 m, 2 deg  0.5 m, 5 deg  5 m, 10 deg
day        0.8-90.6       9.4-99.2       9.4-99.2      29.2-100.0
night      0.0-84.2       0.0-84.2       1.3-98.7      1.3-98.7
all        0.5-71.6       5.3-85.3       14.7-94.7     28.4-99.5

Note: too few queries (5) to compare recall: the intervals are wide.

Note: 1 query has no pose in the result: n2; if these are map images, give true poses of the
queries alone.
"""


def test_text_of_a_recall_table() -> None:
    truth = dict.fromkeys(["d1", "d2", "d3", "n1", "n2"], HERE)
    estimated = {"d1": shifted(0.001), "d2": shifted(0.1), "d3": shifted(2.0), "n1": shifted(0.4)}
    conditions = {name: {"d": "day", "n": "night"}[name[0]] for name in truth}
    text = report_text(evaluate_poses(estimated, truth, conditions=conditions, label="aachen"))
    assert text == TABLE


def test_text_without_poses_and_without_angles() -> None:
    strangers = {f"x{i}.jpg": HERE for i in range(1000)}
    text = report_text(evaluate_poses(strangers, {"a.jpg": HERE}))
    for words in ("0.0 / 0.0 / 0.0 / 0.0", "no query has a pose", "the names may not agree"):
        assert words in text
    assert "1000 images have no true pose" in text and "x5.jpg" not in text
    metres = [Threshold(position_m=0.1)]
    assert "equal" not in text
    text = report_text(evaluate_poses({"a": HERE}, {"a": HERE}, thresholds=metres))
    assert "recall (%) at 0.1 m\nPosition error at or below" in text
    assert "1 pose equals the true pose to the last digit: a; if these are map images" in text
