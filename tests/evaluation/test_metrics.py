"""Thresholds, errors, intervals, recall, confidences, and tests of differences."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scored import evaluate_poses, shifted

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.evaluation.comparison import (
    _resampled_medians,
    compare,
    difference_interval,
    holm,
    mcnemar,
)
from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.evaluation.metrics import (
    PoseErrors,
    Threshold,
    calibration_error,
    confidence_interval,
    pose_errors,
    recall_row,
    reliability,
    risk_by_score,
    row_members,
)
from megloc_kapture.evaluation.report.reports import report_text
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.io.dataset_tables import Protocol
from megloc_kapture.values import LocalizationResult, RigidTransform


def test_parse_and_print() -> None:
    assert Threshold.parse("0.25,2") == Threshold(position_m=0.25, angle_deg=2.0)
    assert str(Threshold.parse("5 10")) == "5 m, 10 deg"
    assert str(Threshold.parse("0,0")) == "0 m, 0 deg"
    position_only = Threshold.parse(" 0.1 ")
    assert position_only.angle_deg is None and str(position_only) == "0.1 m"
    with pytest.raises(OptionError, match="threshold '0.25,' is not METRES,DEGREES"):
        Threshold.parse("0.25,")


def test_missing_poses_have_infinite_errors() -> None:
    pose = RigidTransform.identity()
    errors = pose_errors({"b": pose, "foreign": pose}, {"c": pose, "b": pose, "a": pose})
    assert errors.names == ("a", "b", "c")
    assert errors.position_m.tolist() == errors.angle_deg.tolist() == [np.inf, 0.0, np.inf]
    assert errors.has_pose.tolist() == [False, True, False]
    # names that are asked for keep their order
    assert pose_errors({}, {"a": pose, "b": pose}, ["b", "a"]).names == ("b", "a")
    assert pose_errors({}, {}).position_m.shape == (0,)


QUARTER = Threshold(position_m=0.25, angle_deg=2.0)


def test_confidence_intervals_equal_those_of_scipy() -> None:
    assert confidence_interval(0, 0) == (0.0, 1.0)
    for successes, trials in ((0, 1), (0, 60), (1, 2), (7, 40), (59, 60), (60, 60)):
        low, high = confidence_interval(successes, trials)
        theirs = stats.binomtest(successes, trials).proportion_ci(method="exact")
        assert (float(low), float(high)) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


INF = float("inf")


def errors_of(*pairs: tuple[float, float]) -> PoseErrors:
    names = tuple(f"{i}.jpg" for i in range(len(pairs)))
    array = np.array(pairs, dtype=np.float64).reshape(-1, 2)
    return PoseErrors(names, array[:, 0], array[:, 1])


def test_fallback_poses_are_not_localized() -> None:
    errors = errors_of((0.1, 1.0), (0.2, 1.5), (INF, INF))
    row = recall_row("x", errors, [QUARTER], fallback=np.array([False, True, True]))
    assert (row.num_localized, row.num_fallback, row.num_missing) == (1, 1, 1)
    assert row.recall[0].num_within == 2
    assert row.median_localized_position_m == 0.1


def test_rows_by_condition_pool_and_all() -> None:
    errors = errors_of((0.1, 1), (0.1, 1), (0.1, 1), (9, 1), (9, 1), (INF, INF))
    conditions = ["noon", "noon", "noon", "dawn", "night", ""]
    pools = {"day": ("dawn", "noon"), "wet": ("rain",)}
    members = row_members(conditions, Protocol(conditions=("noon", "rain"), pools=pools))
    rows = [recall_row(n, errors, [QUARTER], members=rows_of) for n, rows_of in members.items()]
    assert [row.name for row in rows] == ["noon", "dawn", "night", "", "day", "all"]
    recall = {row.name: row.recall[0].recall for row in rows}
    # pooled: 3 of 4 queries, not the mean 0.5 of the two recalls
    assert (recall["day"], recall["all"]) == (0.75, 0.5)
    assert sum(row.num_queries for row in rows[:4]) == rows[-1].num_queries == 6
    assert list(row_members([""], Protocol())) == list(row_members([], Protocol())) == ["all"]
    for condition, pools in (("all", {}), ("day", {"day": ("day",)}), ("x", {"all": ("x",)})):
        with pytest.raises(OptionError, match="rename one"):
            row_members([condition], Protocol(pools=pools))


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


HERE = RigidTransform.identity()
METRE = Threshold(position_m=1.0)


def result(label: str, errors_m: Sequence[float], **options: Any) -> Evaluation:
    """A result whose queries are off by these metres; infinite: no pose."""
    names = [f"{i:04d}.jpg" for i in range(len(errors_m))]
    estimated = {
        name: shifted(error)
        for name, error in zip(names, errors_m, strict=True)
        if np.isfinite(error)
    }
    options = {"thresholds": [METRE]} | options
    return evaluate_poses(estimated, dict.fromkeys(names, HERE), label=label, **options)


def test_equal_to_scipys_binomial_test() -> None:
    assert mcnemar(0, 0) == 1.0
    for only_first, only_second in ((0, 1), (3, 3), (4, 3), (12, 0), (2, 17), (150, 190)):
        theirs = stats.binomtest(only_first, only_first + only_second, 0.5).pvalue
        assert mcnemar(only_first, only_second) == pytest.approx(theirs, rel=1e-9)


def test_holm_by_hand() -> None:
    # smallest times 4, then 3, 2, 1, never falling, never above 1
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.9]).tolist() == [1.0, 1.0]
    assert holm([0.02]).tolist() == [0.02]
    assert holm([]).tolist() == []


def test_a_large_paired_difference_is_real_although_intervals_overlap() -> None:
    rng = np.random.default_rng(0)
    errors = np.where(rng.random(200) < 0.8, 0.1, 9.0)
    worse = errors.copy()
    worse[np.flatnonzero(errors < 1)[:12]] = 9.0
    better, other = result("A", errors.tolist()), result("B", worse.tolist())
    (test,) = compare([better, other]).tests
    assert test.is_real
    assert test.p_value == pytest.approx(2 * 0.5**12)
    assert other.row().recall[0].high > better.row().recall[0].low


def test_tests_of_all_thresholds_and_pairs_are_corrected() -> None:
    rng = np.random.default_rng(1)
    thresholds = [METRE, Threshold(position_m=5.0, angle_deg=10.0)]
    results = [result(x, 10 ** rng.normal(0, 1, 60), thresholds=thresholds) for x in "ABC"]
    actual = compare(results)
    assert len(actual.tests) == 3 * 2
    expected = holm([test.p_value for test in actual.tests])
    assert [test.p_adjusted for test in actual.tests] == pytest.approx(expected.tolist())
    for test in actual.tests:
        assert len(test.only_first) + len(test.only_second) + test.both + test.neither == 60
    assert [(m.first, m.second) for m in actual.medians] == [("A", "B"), ("A", "C"), ("B", "C")]


def test_the_interval_of_a_median_difference_covers_the_true_one() -> None:
    rng = np.random.default_rng(3)
    num_runs, held = 40, 0
    # log-normal errors: medians 0.1 and 0.13
    for _ in range(num_runs):
        shared = rng.normal(0, 0.7, 90)
        first = 0.10 * np.exp(shared + rng.normal(0, 0.5, 90))
        second = 0.13 * np.exp(shared + rng.normal(0, 0.5, 90))
        low, high = difference_interval(_resampled_medians(first), _resampled_medians(second))
        held += low <= -0.03 <= high
    assert 0.95 - 3.5 * np.sqrt(0.05 * 0.95 / num_runs) <= held / num_runs < 1.0


def test_medians_with_missing_poses() -> None:
    values = np.array([0.1] * 40 + [np.inf] * 60)
    medians = _resampled_medians(values)
    assert np.isinf(np.median(medians)) and np.isfinite(medians.min())
    assert difference_interval(medians, medians) == (0.0, 0.0)
    low, high = difference_interval(_resampled_medians(np.full(100, 0.1)), medians)
    assert low == -np.inf and high <= 0.0


def test_incomparable_results_are_refused() -> None:
    first, same = result("A", [0.1, 0.2]), [0.1, 0.3]
    for others, words in (
        ([], "at least two"),
        ([result("A", same)], "two results are called 'A'"),
        ([result("B", same, thresholds=[Threshold(position_m=2.0)])], "different thresholds"),
        ([result("B", [*same, 0.2])], "A and B have different queries"),
        ([result("B", same, conditions={"0000.jpg": "night"})], "different conditions"),
    ):
        with pytest.raises(OptionError, match=words):
            compare([first, *others])
