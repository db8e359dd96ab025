"""The function for notebooks and scripts: poses in memory or on disk, and what it gives."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import megloc_kapture as megloc
from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.evaluate import evaluate, evaluate_results
from megloc_kapture.evaluation.protocols import Benchmark
from megloc_kapture.evaluation.report.reports import report_text, write_report
from megloc_kapture.evaluation.statistics import over_seeds
from megloc_kapture.io.tables import write_status
from megloc_kapture.values import Failure, Pose


@pytest.fixture
def result(world: Any, tmp_path: Path, kaptures: Callable[..., Path]) -> Path:
    folder = kaptures(tmp_path / "localized", list(world.truth), world.estimated)
    write_status(folder / "status.csv", world.statuses.values())
    return folder


def test_it_prints_as_the_recall_table(world: Any, result: Path, tmp_path: Path) -> None:
    found = megloc.evaluate(result, truth=world.truth)
    in_memory = evaluate(world.estimated, world.truth)
    np.testing.assert_array_equal(in_memory.errors.position_m, found.errors.position_m)
    assert str(found) + "\n" == report_text(found)
    assert "95 % confidence intervals" in str(found) and str(result) in str(found)
    found.html(tmp_path / "report.html")
    assert "How large the errors are" in (tmp_path / "report.html").read_text()


def test_what_localizing_gives_brings_reasons_and_inliers(world: Any) -> None:
    first, second, third, *_ = sorted(world.estimated)
    truth = {name: world.truth[name] for name in (first, second, third)}
    pose, failure = Pose(world.estimated[first], 300, 120), Failure("no matches", num_matches=7)
    found = evaluate({first: pose, second: failure}, truth, label="mine")
    table = found.to_pandas()
    assert table.loc[first, "num_inliers"] == 120 and table.loc[first, "outcome"] == "localized"
    assert table.loc[second, "reason"] == "no matches" and table.loc[second, "num_matches"] == 7
    assert table.loc[third, "outcome"] == "missing" and table.loc[third, "num_inliers"] is pd.NA
    assert found.label == "mine"


def test_two_results_are_compared(world: Any, tmp_path: Path) -> None:
    lost = sorted(world.estimated)[:12]
    fewer = {name: pose for name, pose in world.estimated.items() if name not in lost}
    all_of_them = evaluate(world.estimated, world.truth, label="all of them")
    comparison = all_of_them.compare(evaluate(fewer, world.truth, label="fewer"))
    assert "all of them finds" in " ".join(str(comparison).split())
    table = comparison.to_pandas()
    assert (table.loc[lost, "fewer: outcome"] == "missing").all()
    comparison.html(tmp_path / "comparison.html")
    assert "Is the difference real?" in (tmp_path / "comparison.html").read_text()
    with pytest.raises(OptionError, match="two results are called 'all of them'"):
        all_of_them.compare(all_of_them)
    # those without a label are told apart
    first, second = evaluate_results([world.estimated, {}], world.truth, Benchmark())
    assert (first.label, second.label) == ("result 1", "result 2")
    assert "+-" in str(over_seeds([first, second]))


def test_tables_in_python_are_those_of_the_files(world: Any, result: Path, tmp_path: Path) -> None:
    found = evaluate(result, world.truth)
    table, at = found.to_pandas(), found.row().recall[1]
    within = (table["position_error_m"] <= at.threshold.position_m) & (
        table["angle_error_deg"] <= at.threshold.angle_deg
    )
    assert list(table.index) == sorted(world.truth) and within.mean() == at.recall
    assert table["position_error_m"].median() == found.row().median_position_m
    assert set(table["outcome"]) == {"localized", "fallback", "missing"}
    comparison = found.compare(evaluate({}, world.truth, label="nothing"))
    for number, reported in enumerate((found, comparison)):
        paths = write_report(tmp_path / str(number), reported)
        # a missing pose is infinitely far in Python, and empty in the file
        written = pd.read_csv(paths["per_query.csv"], keep_default_na=False, na_values=[""])
        here = reported.to_pandas().reset_index().replace({np.inf: np.nan, "": np.nan})
        pd.testing.assert_frame_equal(written, here, check_dtype=False)


def test_nothing_heavy_is_loaded_before_it_is_needed() -> None:
    code = (
        "import sys; import megloc_kapture.evaluation.evaluate as e; "
        "import megloc_kapture.evaluation.report.reports; "
        "print([m for m in ('pandas', 'matplotlib', 'torch', 'jinja2') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
