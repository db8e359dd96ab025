"""The text, files and page about several results."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.evaluation.comparison import Comparison, MedianDifference, compare
from megloc_kapture.evaluation.comparison_outputs import write_comparison, write_seeds
from megloc_kapture.evaluation.comparison_report import render_comparison
from megloc_kapture.evaluation.comparison_text import comparison_text
from megloc_kapture.evaluation.evaluate import Evaluation, evaluate
from megloc_kapture.evaluation.seeds import over_seeds
from megloc_kapture.evaluation.sentences import median_sentence, threshold_sentence
from megloc_kapture.evaluation.thresholds import Threshold
from megloc_kapture.evaluation.worst_queries import disputed_queries, worst_queries
from megloc_kapture.values import RigidTransform

HERE = RigidTransform.identity()
THRESHOLD = Threshold(position_m=0.25, angle_deg=2.0)


def by_hand(label: str, only: int, other: int, both: int = 10) -> tuple[Evaluation, Evaluation]:
    """Two results, one alone within the threshold on ``only`` queries, the other on ``other``."""
    near, far = [RigidTransform((1.0, 0.0, 0.0, 0.0), (m, 0.0, 0.0)) for m in (0.1, 3.0)]
    names = [f"{i:03d}.jpg" for i in range(only + other + both)]
    truth = dict.fromkeys(names, HERE)
    first = {n: far if only <= i < only + other else near for i, n in enumerate(names)}
    second = {n: far if i < only else near for i, n in enumerate(names)}
    return (
        evaluate(first, truth, thresholds=[THRESHOLD], label="A"),
        evaluate(second, truth, thresholds=[THRESHOLD], label="B"),
    )


@pytest.fixture
def results(worlds: Callable[..., Any]) -> list[Evaluation]:
    """Two results on one truth; the second has lost the first eight poses of the day."""
    world = worlds(num_queries=60)
    options = {"conditions": world.conditions, "statuses": world.statuses}
    lost = sorted(n for n in world.estimated if world.conditions[n] == "day")[:8]
    fewer = {name: pose for name, pose in world.estimated.items() if name not in lost}
    return [
        evaluate(world.estimated, world.truth, label="all of them", **options),
        evaluate(fewer, world.truth, label="fewer", **options),
    ]


def sentence_of(only: int, other: int, both: int = 10) -> str:
    comparison = compare(by_hand("", only, other, both))
    return threshold_sentence(comparison.tests[0], ["A", "B"])


def test_a_real_difference() -> None:
    assert sentence_of(12, 3) == (
        "At 0.25 m, 2 deg A finds 12 queries that B misses and B finds 3 that A misses: "
        "the difference is real (p = 0.035)."
    )


def test_differences_that_could_be_chance() -> None:
    assert sentence_of(9, 4).endswith("the difference could be chance (p = 0.27).")
    assert sentence_of(1, 0) == (
        "At 0.25 m, 2 deg A finds 1 query that B misses and B finds none that A misses: "
        "too few queries differ to tell it from chance (p = 1)."
    )
    assert sentence_of(0, 5).startswith(
        "At 0.25 m, 2 deg A finds no query that B misses and B finds 5 that A misses: too few"
    )


def test_no_difference() -> None:
    assert sentence_of(0, 0) == "At 0.25 m, 2 deg A and B find the same 10 queries."
    everything_far = by_hand("", 2, 0, 0)
    worse = [evaluate({}, e.truth, thresholds=[THRESHOLD], label=e.label) for e in everything_far]
    test = compare(worse).tests[0]
    assert threshold_sentence(test, ["A", "B"]) == (
        "At 0.25 m, 2 deg neither A nor B finds a query."
    )


def test_sentences_about_medians() -> None:
    def said(*values: float) -> str:
        return median_sentence(MedianDifference(0, 1, *values), ["A", "B"])

    assert said(0.1, 0.12, -0.03, -0.01) == (
        "The median position error is 0.1000 m for A and 0.1200 m for B: -0.0200 m, "
        "95 % interval -0.0300 to -0.0100 m; the difference is real."
    )
    assert said(0.1, 0.12, -0.03, 0.01).endswith("+0.0100 m; the difference could be chance.")
    assert "Most queries of B have no pose" in said(0.1, np.inf, -np.inf, -np.inf)
    assert "of A and of B" in said(np.inf, np.inf, 0.0, 0.0)
    assert "to +inf m" in said(1.0, 0.1, 0.5, np.inf)


def test_text(results: list[Evaluation]) -> None:
    text = comparison_text(compare(results))
    assert text.isascii() and max(map(len, text.splitlines())) <= 100
    for evaluation in results:
        for row in evaluation.rows:
            recall = " / ".join(f"{100 * at.recall:.1f}" for at in row.recall)
            assert f"{evaluation.label:11s}" in text and recall in text
    flat = " ".join(text.split())
    assert "all of them finds 8 queries that fewer misses" in flat
    assert "the difference is real (p = 0." in flat
    assert "Note on fewer:" in flat


def test_long_labels_are_cut_in_the_table_only(results: list[Evaluation]) -> None:
    long = [replace(e, label=f"/data/runs/{e.label}/{'x' * 40}/localized") for e in results]
    lines = comparison_text(compare(long)).splitlines()
    table = lines[: lines.index("", 4)]
    assert max(map(len, table)) <= 112
    assert any("/data/run...localized" in line for line in table)


def test_files(results: list[Evaluation], tmp_path: Path, page_of: Callable[..., Any]) -> None:
    comparison = compare(results)
    paths = write_comparison(tmp_path / "out", comparison)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(paths)
    assert paths["recall.txt"].read_text() == comparison_text(comparison)
    summary = json.loads(paths["recall.json"].read_text())
    assert [result["label"] for result in summary["results"]] == ["all of them", "fewer"]
    tests = summary["comparison"]["tests"]
    assert len(tests) == 4 and len(summary["comparison"]["tests_by_condition"]) == 8
    test = tests[-1]
    assert (test["first"], test["second"], test["row"]) == ("all of them", "fewer", "all")
    assert len(test["only_first"]) == 8 and test["only_second"] == []
    assert len(summary["comparison"]["sentences"]) >= 5
    with paths["per_query.csv"].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["image"] for row in rows] == list(results[0].errors.names)
    lost = test["only_first"][0]
    (row,) = [row for row in rows if row["image"] == lost]
    assert (row["all of them: outcome"], row["fewer: outcome"]) == ("localized", "missing")
    assert row["fewer: position_error_m"] == ""
    index = results[0].errors.names.index(lost)
    assert float(row["all of them: position_error_m"]) == results[0].errors.position_m[index]
    with paths["differences.csv"].open(newline="") as file:
        listed = list(csv.DictReader(file))
    assert len(listed) == sum(len(t.only_first) + len(t.only_second) for t in comparison.tests)
    assert {row["found_by"] for row in listed} == {"all of them"}
    page = page_of(paths["report.html"].read_text())
    for sentence in summary["comparison"]["sentences"]:
        assert sentence in page.text


def test_the_page_is_the_same_each_time(
    results: list[Evaluation], worlds: Callable[..., Any]
) -> None:
    comparison = compare(results)
    first = render_comparison(comparison, map_poses=worlds().mapped)
    assert render_comparison(comparison, map_poses=worlds().mapped) == first


def test_labels_are_escaped(results: list[Evaluation], page_of: Callable[..., Any]) -> None:
    evil = replace(results[1], label="<script>alert('$x$')</script>")
    page = page_of(render_comparison(compare([results[0], evil])))
    assert evil.label in page.text


def test_seeds_files(
    results: list[Evaluation], tmp_path: Path, page_of: Callable[..., Any]
) -> None:
    paths = write_seeds(tmp_path, over_seeds(results))
    summary = json.loads(paths["recall.json"].read_text())
    assert [row["name"] for row in summary["seeds"]] == ["day", "night", "all"]
    recalls = [result["rows"][-1]["recall"][1]["recall"] for result in summary["results"]]
    found = summary["seeds"][-1]["recall"][1]
    assert found["mean"] == pytest.approx(np.mean(recalls))
    assert found["deviation"] == pytest.approx(np.std(recalls, ddof=1))
    assert summary["seeds"][-1]["recall"][-1]["found_sometimes"] == 8
    assert "comparison" not in summary
    text = page_of(paths["report.html"].read_text()).text
    assert "2 runs of one method" in text and "Is the difference real" not in text


def test_disputed_queries_come_first(results: list[Evaluation]) -> None:
    found = disputed_queries(results, number=10)
    assert len({chosen.name for _, chosen in found}) == 10
    lost = set(compare(results).tests[-1].only_first)
    # two thirds of the places are for what the results disagree about
    assert sum(chosen.name in lost for _, chosen in found) == 7
    worse, chosen = found[0]
    assert worse == 1 and chosen.name in lost
    assert chosen.facts[1].startswith("fewer: no pose")


def test_worst_queries_are_not_all_without_a_pose(worlds: Callable[..., Any]) -> None:
    world = worlds(num_queries=40)
    posed = dict(sorted(world.estimated.items())[:12])
    evaluation = evaluate(posed, world.truth, statuses=world.statuses)
    chosen = worst_queries(evaluation, number=10)
    with_pose = [one.name for one in chosen if one.name in posed]
    assert len(chosen) == 10 and len(with_pose) == 5
    worst = sorted(
        posed, key=lambda n: -evaluation.errors.position_m[evaluation.errors.names.index(n)]
    )
    assert with_pose == worst[:5]
    # where nothing is lost, all places are for errors
    whole = evaluate(world.truth, world.truth)
    assert len(worst_queries(whole, number=10)) == 10
    few = evaluate({}, dict(list(world.truth.items())[:3]))
    assert len(worst_queries(few, number=10)) == 3


def test_medians_stand_in_the_comparison(results: list[Evaluation]) -> None:
    comparison: Comparison = compare(results)
    (median,) = comparison.medians
    assert median.first_m == results[0].row().median_position_m
    assert median.low_m <= median.first_m - median.second_m <= median.high_m
