"""Reliability, risk against coverage, and queries that show nothing of the map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scored import evaluate_poses, shifted

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.evaluation.metrics import calibration_error, reliability, risk_by_score
from megloc_kapture.evaluation.report.reports import report_text
from megloc_kapture.values import LocalizationResult


def test_calibration_error() -> None:
    rng = np.random.default_rng(0)
    claimed = rng.uniform(0, 1, 200_000)
    right = rng.uniform(0, 1, 200_000) < claimed
    bins = reliability(claimed, right)
    assert calibration_error(bins) < 0.01
    assert all(bin.low < bin.mean_confidence < bin.high for bin in bins)
    # and those that say half of it have an error of a quarter
    assert calibration_error(reliability(claimed / 2, right)) == pytest.approx(0.25, abs=0.01)


def test_risk_by_hand() -> None:
    right = np.array([True, False, True, False])
    assert risk_by_score(np.array([0.9, 0.2, 0.8, 0.1]), right).tolist() == [0, 0, 1 / 3, 1 / 2]
    assert risk_by_score(np.array([0.1, 0.9, 0.2, 0.8]), right).tolist() == [1, 1, 2 / 3, 1 / 2]
    # equal scores say nothing: the mean over all orders
    assert risk_by_score(np.ones(4), right).tolist() == [0.5, 0.5, 0.5, 0.5]


def status(image: str, confidence: float | None, localized: bool = True) -> LocalizationResult:
    return LocalizationResult(
        name=image, reason="" if localized else "too little", num_inliers=10, confidence=confidence
    )


def test_confidence_of_a_result() -> None:
    truth = {name: shifted(0.0) for name in "abcd"}
    result = {"a": shifted(0.1), "b": shifted(100.0), "c": shifted(0.2), "stray": shifted(0.0)}
    statuses = {
        "a": status("a", 0.9),
        "b": status("b", 0.6),
        "c": status("c", 0.8),
        "d": status("d", 0.3, localized=False),
        "stray": status("stray", 0.7),
        "refused": status("refused", 0.1, localized=False),
    }
    evaluation = evaluate_poses(result, truth, statuses=statuses, nowhere=["stray", "refused"])
    known = evaluation.confidence
    assert (known.num_queries, known.num_poses, known.num_wrong) == (6, 4, 2)
    assert (known.num_nowhere, known.num_nowhere_refused) == (2, 1)
    # a and c first, then the stray, then b
    assert known.risk == pytest.approx((0, 0, 1 / 3, 1 / 2))
    assert known.coverage == pytest.approx((1 / 6, 2 / 6, 3 / 6, 4 / 6))
    assert known.area == pytest.approx(5 / 24) and known.area_by_inliers == pytest.approx(1 / 2)
    assert known.wrong_low < 0.5 < known.wrong_high
    # no row of recall counts them, and they are not images without truth
    assert evaluation.row().num_queries == 4 and evaluation.without_truth == ()
    text = " ".join(report_text(evaluation).split())
    assert "2 queries show nothing of the map: 1 not localized, 1 localized wrongly" in text
    assert "4 poses with a confidence, 2 of them wrong" in text
    assert evaluation.to_pandas().loc["a", "confidence"] == 0.9
    # a result without confidences says nothing of them
    evaluation = evaluate_poses(
        {"a": shifted(0.0)}, {"a": shifted(0.0)}, statuses={"a": status("a", None)}
    )
    assert evaluation.confidence is None and "onfidence:" not in report_text(evaluation)
    assert "confidence" not in evaluation.to_pandas().columns
    with pytest.raises(DataError, match="'a' has a true pose, but is listed"):
        evaluate_poses({}, {"a": shifted(0.0)}, nowhere=["a"])


def test_recall_above_a_confidence() -> None:
    truth = {name: shifted(float(row)) for row, name in enumerate("abcd")}
    statuses = {
        name: status(name, confidence)
        for name, confidence in zip("abc", (0.9, 0.6, 0.59), strict=True)
    }
    result = evaluate_poses(
        {name: truth[name] for name in "abc"},
        truth,
        statuses=statuses,
        conditions=dict(zip("abcd", ("day", "night", "night", "night"), strict=True)),
    )
    assert [row.recall[-1].num_within for row in result.rows] == [1, 2, 3]
    above = result.rows_above(0.6)
    assert [row.name for row in above] == [row.name for row in result.rows]
    assert [row.recall[-1].num_within for row in above] == [1, 1, 2]
    assert [row.num_missing for row in above] == [0, 2, 2]
    assert "misses" in report_text(result)
    # without confidences there is nothing to add
    assert evaluate_poses(truth, truth).rows_above(0.6) == ()


def test_confidences_of_a_pose_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    poses = tmp_path / "poses.txt"
    poses.write_text("a 1 0 0 0 0 0 0\nb 1 0 0 0 50 0 0\n")
    truth = {"a": shifted(0.0), "b": shifted(0.0)}
    assert evaluate(poses, truth).confidence is None
    (tmp_path / "poses.txt.json").write_text('{"confidence": {"a": 0.9, "b": 0.2}, "preset": "x"}')
    known = evaluate(poses, truth).confidence
    assert known is not None and known.risk == (0.0, 0.5) and known.area_by_inliers is None
    (tmp_path / "poses.txt.json").write_text('{"confidence": {"a": 7}}')
    assert evaluate(poses, truth).confidence is None
    assert "poses.txt.json: confidence.a: " in caplog.text and "are left out" in caplog.text
