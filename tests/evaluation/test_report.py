"""The report and the other files: self-contained, escaped, reproducible, complete."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest

from megloc_kapture.errors import OutputError
from megloc_kapture.evaluation.evaluate import Evaluation, evaluate
from megloc_kapture.evaluation.figure_above import views_of_evaluation
from megloc_kapture.evaluation.outputs import write_evaluation
from megloc_kapture.evaluation.report import render_report, worst_first
from megloc_kapture.evaluation.tables import recall_table
from megloc_kapture.io.status_table import QueryStatus
from megloc_kapture.values import RigidTransform

HERE = RigidTransform.identity()


def evaluation_of(world: Any) -> Evaluation:
    return evaluate(
        world.estimated,
        world.truth,
        conditions=world.conditions,
        statuses=world.statuses,
        label="a <b>bold</b> & daring result",
    )


def test_well_formed_and_self_contained(world: Any, page_of: Any) -> None:
    page = page_of(render_report(evaluation_of(world), map_poses=world.mapped))
    assert page.ids and page.references


def test_says_what_the_table_says(world: Any, page_of: Any) -> None:
    evaluation = evaluation_of(world)
    text = page_of(render_report(evaluation)).text
    row = evaluation.row()
    assert "32 of 40 queries localized, 4 more with a fallback pose, 4 without a pose" in text
    for at in row.recall:
        assert f"{100 * at.recall:.1f}" in text
    for query in evaluation.queries:
        assert query.image in text
    assert "6 inliers, 12 needed" in text


def test_names_are_escaped(world: Any, page_of: Any) -> None:
    evil = '"><script>alert(1)</script>'
    name = f"query/{evil}.jpg"
    world.truth[name] = HERE
    world.conditions = {n: "<i>day & $night$" for n in world.truth}
    world.statuses[name] = QueryStatus(image=name, status="failed", reason=f"why {evil}")
    evaluation = evaluation_of(world)
    html = render_report(evaluation, provenance={"root": f"/data/{evil}"})
    assert "<script" not in html
    assert "<i>day" not in html
    assert "<b>bold" not in html
    text = page_of(html).text
    assert name in text
    assert f"why {evil}" in text


def test_the_steps_of_the_paper_come_first(world: Any, page_of: Any) -> None:
    steps = [
        {"name": "ASLFeat", "on": True, "why": "preset megloc"},
        {"name": "poses refined by ICP", "on": False, "why": "<no> depth"},
    ]
    html = render_report(evaluation_of(world), provenance={"preset": "megloc", "steps": steps})
    text = page_of(html).text
    assert "Steps of the paper: 1 of 2 are on" in text
    assert text.index("ASLFeat") < text.index("poses refined by ICP") < text.index("Recall")
    assert "<no> depth" in text and "<no>" not in html
    assert "steps" not in html.partition("<pre>")[2]  # not once more at the end
    assert "Steps of the paper" not in render_report(evaluation_of(world))


def test_same_bytes_each_time_and_no_date(world: Any) -> None:
    evaluation = evaluation_of(world)
    options = {"preset": "classic"}
    first = render_report(evaluation, map_poses=world.mapped, provenance=options)
    assert render_report(evaluation, map_poses=world.mapped, provenance=options) == first
    assert "dc:date" not in first


def test_a_users_matplotlib_settings_change_nothing_and_are_kept(world: Any) -> None:
    evaluation = evaluation_of(world)
    first = render_report(evaluation)
    with matplotlib.rc_context({"font.size": 30, "axes.linewidth": 5, "xtick.direction": "in"}):
        assert render_report(evaluation) == first
        assert matplotlib.rcParams["font.size"] == 30


def test_worst_first(world: Any) -> None:
    rows = worst_first(evaluation_of(world))
    errors = [row.query.position_m for row in rows]
    assert errors == sorted(errors, reverse=True)
    missing = [row.query.image for row in rows if row.query.outcome == "missing"]
    assert missing == sorted(missing) == [row.query.image for row in rows[:4]]
    assert rows[0].met == (False, False, False, False)
    assert rows[-1].met == (True, True, True, True)


def test_a_single_query_without_status_condition_or_map(page_of: Any) -> None:
    text = page_of(render_report(evaluate({"a.jpg": HERE}, {"a.jpg": HERE}))).text
    assert "1 of 1 queries localized." in text
    assert "Error against inliers" not in text


def test_nothing_localized(page_of: Any) -> None:
    text = page_of(render_report(evaluate({}, {"a": HERE, "b": HERE}))).text
    assert "0 of 2 queries localized, 2 without a pose." in text
    assert "median: most lack a pose" in text


def test_estimates_off_the_page_are_counted(world: Any) -> None:
    name = next(name for name in world.estimated if world.statuses[name].status == "localized")
    world.estimated[name] = RigidTransform((1.0, 0.0, 0.0, 0.0), (-1e6, 0.0, 0.0))
    evaluation = evaluation_of(world)
    (view,) = views_of_evaluation(evaluation, world.mapped)
    assert view.num_outside == 1
    assert "1 estimate lies" in render_report(evaluation, map_poses=world.mapped)


def test_many_queries_stay_a_small_page(worlds: Any) -> None:
    evaluation = evaluation_of(worlds(num_queries=4000))
    html = render_report(evaluation)
    assert "3500 better ones are left out here" in " ".join(html.split())
    assert len(html) < 3_000_000
    assert render_report(evaluation) == html  # here the dots are pixels


def test_files(world: Any, tmp_path: Path) -> None:
    evaluation = evaluation_of(world)
    paths = write_evaluation(tmp_path / "evaluation", evaluation, map_poses=world.mapped)
    assert sorted(path.name for path in (tmp_path / "evaluation").iterdir()) == sorted(paths)
    assert paths["recall.txt"].read_text() == recall_table(evaluation)
    summary = json.loads(paths["recall.json"].read_text())
    assert summary["label"] == evaluation.label
    assert [row["name"] for row in summary["rows"]] == ["day", "night", "all"]
    whole = summary["rows"][-1]
    for at in whole["recall"]:
        assert at["recall"] == at["num_within"] / whole["num_queries"]
    assert whole["num_fallback"] == 4
    with paths["per_query.csv"].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["image"] for row in rows] == sorted(world.truth)
    for row, position_m in zip(rows, evaluation.errors.position_m, strict=True):
        if row["outcome"] == "missing":
            assert row["position_error_m"] == "" and position_m == np.inf
        else:
            assert float(row["position_error_m"]) == position_m


def test_files_are_the_same_each_time(world: Any, tmp_path: Path) -> None:
    evaluation = evaluation_of(world)
    first = write_evaluation(tmp_path / "1", evaluation)
    second = write_evaluation(tmp_path / "2", evaluation)
    for name, path in first.items():
        assert path.read_bytes() == second[name].read_bytes()


def test_an_unwritable_folder_is_named(world: Any, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        write_evaluation(tmp_path / "file", evaluation_of(world))
