"""Figures without true poses: shares, inliers, agreement with retrieval and of two results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import corner
import numpy as np
import pytest
from scored import write_kapture

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.evaluation.comparison import (
    WithoutTruth,
    evaluate_without_truth,
    inliers_quartiles,
)
from megloc_kapture.evaluation.evaluate import results_without_truth
from megloc_kapture.evaluation.protocols import benchmark_of, protocol_of
from megloc_kapture.evaluation.report.content import result_table
from megloc_kapture.evaluation.report.reports import render_report, report_text
from megloc_kapture.evaluation.results import Result
from megloc_kapture.io.dataset_tables import (
    ImageGroup,
    Protocol,
    SideTables,
    write_side_tables,
)
from megloc_kapture.io.tables import write_status
from megloc_kapture.values import LocalizationResult, RigidTransform

THRESHOLDS = ((0.25, 2.0), (5.0, 10.0))


def pose_at(x: float, turn_deg: float = 0.0) -> RigidTransform:
    return corner.pose_at((x, 0.0, 0.0), turn_deg)


def status(image: str, inliers: int, *candidates: str, **other: Any) -> LocalizationResult:
    counts = {"num_matches": 2 * inliers, "num_inliers": inliers, "candidates": candidates}
    return LocalizationResult(name=image, **counts, **other)


MAP = {"m/0.jpg": pose_at(0.0), "m/8.jpg": pose_at(8.0), "m/30.jpg": pose_at(30.0, 90.0)}
CONDITIONS = {"d/1.jpg": "day", "d/2.jpg": "day", "n/1.jpg": "night", "n/2.jpg": "night"}


@pytest.fixture
def first() -> Result:
    """One query at its first candidate, one near another, a guess, and one without a pose."""
    guess = {"reason": "dark", "fallback": "retrieval"}
    rows = (
        status("d/1.jpg", 100, "m/0.jpg", "m/8.jpg"),
        status("d/2.jpg", 20, "m/30.jpg", "m/8.jpg", "m/gone.jpg"),
        status("n/1.jpg", 0, "m/0.jpg", **guess),
        status("n/2.jpg", 0, reason="no matches"),
    )
    poses = {"d/1.jpg": pose_at(1.0, 20.0), "d/2.jpg": pose_at(9.0), "n/1.jpg": pose_at(0.0)}
    return Result("A", poses, tuple(CONDITIONS), {row.name: row for row in rows})


@pytest.fixture
def second() -> Result:
    """A pose file: nothing but poses."""
    poses = {
        "d/1.jpg": pose_at(1.1, 20.0),
        "d/2.jpg": pose_at(9.0, 5.0),
        "n/2.jpg": pose_at(3.0),
    }
    return Result(label="B", poses=poses, images=tuple(poses))


@pytest.fixture
def result(first: Result, second: Result) -> WithoutTruth:
    groups = {image: ImageGroup(condition=name) for image, name in CONDITIONS.items()}
    rules = Protocol(truth="Nobody tells.", thresholds=THRESHOLDS)
    return evaluate_without_truth([first, second], SideTables(protocol=rules, groups=groups))


def test_counts_and_inliers(result: WithoutTruth) -> None:
    day, night, whole = result.evaluations[0].rows
    assert (day.name, night.name, whole.name) == ("day", "night", "all")
    counts = (whole.num_queries, whole.num_localized, whole.num_fallback, whole.num_missing)
    assert counts == (4, 2, 1, 1)
    quartiles = inliers_quartiles(result.evaluations[0], "all")
    assert quartiles == tuple(np.quantile([100, 20], (0.25, 0.5, 0.75)))
    assert inliers_quartiles(result.evaluations[0], "night") is None
    table = result_table(result.evaluations[0])
    assert table["%"].tolist()[-1] == "50.0"
    assert table["inliers, quartiles"].tolist()[1:] == ["-", "40 / 60 / 80"]
    other = result.evaluations[1].rows[-1]
    assert (other.num_localized, other.num_missing) == (3, 1)
    assert inliers_quartiles(result.evaluations[1], "all") is None
    assert [q.reason for q in result.evaluations[0].queries] == ["", "", "dark", "no matches"]


def test_agreement_of_two_results(result: WithoutTruth, first: Result) -> None:
    day, night, whole = result.agreement
    assert (whole.num_both, whole.num_only_first, whole.num_only_second) == (2, 1, 1)
    # 0.1 m apart; and 5 degrees apart
    assert [at.num_within for at in whole.within] == [1, 2]
    assert whole.within[0].recall == 0.25
    assert 0 < whole.within[0].low < 0.25
    assert (day.num_both, night.num_both) == (2, 0)
    assert np.isinf(night.median_m)
    assert whole.median_m == pytest.approx(0.05)
    np.testing.assert_allclose(result.apart[0].position_m, [0.1, 0.0, np.inf, np.inf], atol=1e-12)
    # a result agrees with itself
    twin = Result("twin", first.poses, first.images, first.statuses)
    benchmark = SideTables(protocol=Protocol(thresholds=THRESHOLDS))
    (row,) = evaluate_without_truth([first, twin], benchmark).agreement
    assert [at.num_within for at in row.within] == [3, 3] and row.median_m == 0.0


def test_a_single_result_and_one_without_poses(second: Result) -> None:
    text = report_text(evaluate_without_truth([second]))
    assert "No true poses were given." in text and "agree (%)" not in text
    result = evaluate_without_truth([Result("x", {}, ("a.jpg",))])
    assert result.evaluations[0].rows[0].num_missing == 1
    assert "From above" not in render_report(result)


def test_empty_or_equal_labels_are_refused(first: Result) -> None:
    with pytest.raises(DataError, match="there are no queries"):
        evaluate_without_truth([Result("x", {}, ())])
    for results in ([first, first], []):
        with pytest.raises(OptionError, match="labels must differ"):
            evaluate_without_truth(results)


def test_pose_files_may_spell_the_same_queries_differently(tmp_path: Path) -> None:
    row = " 1 0 0 0 1.5 -0.2 3\n"
    first, second, other = (tmp_path / name for name in ("first.txt", "second.txt", "other.txt"))
    first.write_text(f"d/1.jpg{row}d/2.jpg{row}")
    second.write_text(f"1.png{row}/data/d/2.jpg{row}")
    other.write_text(f"9.jpg{row}")
    result = results_without_truth([first, second], SideTables())
    assert result.agreement[0].num_both == result.agreement[0].num_queries == 2
    with pytest.raises(DataError, match=r"in common: first.* 'd/1\.jpg', other.* '9\.jpg'"):
        results_without_truth([first, other], SideTables())
    first.write_text(f"d/9.jpg{row}n/9.jpg{row}")
    with pytest.raises(DataError, match=r"other\.txt: '9\.jpg' may be"):
        results_without_truth([first, other], SideTables())


def test_from_a_workspace(first: Result, tmp_path: Path) -> None:
    workspace = tmp_path / "workspace"
    write_kapture(workspace / "mapping", list(MAP), MAP)
    write_kapture(workspace / "query", [*CONDITIONS, "d/training.jpg"], {})
    write_kapture(workspace / "localized", [*CONDITIONS, "d/training.jpg"], first.poses)
    write_status(workspace / "localized/status.csv", first.statuses.values())
    tables = workspace / "megloc"
    listed = SideTables(
        protocol=protocol_of("aachen"),
        groups={name: ImageGroup(condition=c) for name, c in CONDITIONS.items()},
        names={name: name.replace("/", "_") for name in CONDITIONS},
    )
    write_side_tables(tables, listed)
    rules = benchmark_of(tables)
    result = results_without_truth([workspace / "localized"], rules)
    assert "visuallocalization.net keeps them" in result.statement
    # the challenge's list says which queries count
    assert [row.num_queries for row in result.evaluations[0].rows] == [2, 2, 4]
    # without a list, all queries of the workspace do that are scored
    everything = results_without_truth(
        [workspace / "localized"], SideTables(protocol=rules.protocol, groups=rules.groups)
    )
    assert everything.evaluations[0].rows[-1].num_queries == 5
