"""Thresholds, pose errors, confidence intervals and recall."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.metrics import (
    PoseErrors,
    Threshold,
    confidence_interval,
    pose_errors,
    recall_row,
    row_members,
    within,
)
from megloc_kapture.io.dataset_tables import Protocol
from megloc_kapture.values import RigidTransform


@pytest.mark.parametrize(
    ("text", "position_m", "angle_deg", "printed"),
    [
        ("0.25,2", 0.25, 2.0, "0.25 m, 2 deg"),
        ("5 10", 5.0, 10.0, "5 m, 10 deg"),
        (" 0.1 ", 0.1, None, "0.1 m"),
        ("0,0", 0.0, 0.0, "0 m, 0 deg"),
    ],
)
def test_parse_and_print(
    text: str, position_m: float, angle_deg: float | None, printed: str
) -> None:
    threshold = Threshold.parse(text)
    assert (threshold.position_m, threshold.angle_deg) == (position_m, angle_deg)
    assert str(threshold) == printed


def test_position_errors_are_distances_of_centres() -> None:
    # two cameras at one place, looking in opposite directions: t differs by 4 m, C by nothing
    north = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -2.0))
    turned = RigidTransform((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 2.0))
    # and the sign of a quaternion is nothing
    negative = RigidTransform((-1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -2.0))
    errors = pose_errors({"a": turned, "b": negative}, {"a": north, "b": north})
    np.testing.assert_allclose(errors.position_m, [0.0, 0.0], atol=1e-12)
    assert errors.angle_deg.tolist() == [pytest.approx(180.0), 0.0]


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


@given(st.integers(0, 60), st.integers(0, 60))
def test_equal_to_scipy(successes: int, failures: int) -> None:
    trials = successes + failures
    low, high = confidence_interval(successes, trials)
    if trials == 0:
        assert (low, high) == (0.0, 1.0)
        return
    theirs = stats.binomtest(successes, trials).proportion_ci(method="exact")
    assert (float(low), float(high)) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


INF = float("inf")


def errors_of(*pairs: tuple[float, float]) -> PoseErrors:
    names = tuple(f"{i}.jpg" for i in range(len(pairs)))
    array = np.array(pairs, dtype=np.float64).reshape(-1, 2)
    return PoseErrors(names, array[:, 0], array[:, 1])


def test_thresholds_bound_both_errors() -> None:
    off, turned = np.nextafter(0.25, 1), np.nextafter(2.0, 3)
    errors = errors_of((0.25, 2.0), (off, 2.0), (0.25, turned), (0.1, 3.0), (0.3, 1.0))
    assert within(errors, QUARTER).tolist() == [True, False, False, False, False]
    position_only = Threshold(position_m=0.25)
    assert within(errors, position_only).tolist() == [True, False, True, True, False]


def test_counts_and_medians() -> None:
    row = recall_row("x", errors_of((1.0, 10.0), (3.0, 30.0), (0.1, 1.0), (INF, INF)), [QUARTER])
    assert (row.num_queries, row.num_localized, row.num_missing) == (4, 3, 1)
    assert (row.recall[0].num_within, row.recall[0].recall) == (1, 1 / 4)
    assert (row.median_position_m, row.median_angle_deg) == (2.0, 20.0)
    assert (row.median_localized_position_m, row.median_localized_angle_deg) == (1.0, 10.0)
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
