"""Thresholds, pose errors, confidence intervals and recall."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.metrics import (
    PoseErrors,
    Threshold,
    confidence_interval,
    pose_errors,
    recall_row,
    row_members,
)
from megloc_kapture.io.dataset_tables import Protocol
from megloc_kapture.values import RigidTransform


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


def test_medians_of_few_poses() -> None:
    """test_against_kapture.py has errors, thresholds, counts and medians of many."""
    half = recall_row("x", errors_of((1.0, 10.0), (INF, INF)), [QUARTER])
    assert (half.median_position_m, half.median_localized_position_m) == (INF, 1.0)
    nobody = recall_row("x", errors_of(), [QUARTER])
    assert (nobody.recall[0].recall, nobody.median_position_m) == (0.0, INF)


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
