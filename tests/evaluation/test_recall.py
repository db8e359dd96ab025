"""Recall rows: ties, missing queries, pools, medians, JSON."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.pose_errors import PoseErrors
from megloc_kapture.evaluation.recall import (
    RecallRow,
    recall_row,
    recall_rows,
    row_members,
    within,
)
from megloc_kapture.evaluation.thresholds import Threshold

INF = float("inf")
QUARTER = Threshold(position_m=0.25, angle_deg=2.0)


def errors_of(*pairs: tuple[float, float]) -> PoseErrors:
    names = tuple(f"{i}.jpg" for i in range(len(pairs)))
    array = np.array(pairs, dtype=np.float64).reshape(-1, 2)
    return PoseErrors(names, array[:, 0], array[:, 1])


def test_a_threshold_met_exactly_counts() -> None:
    errors = errors_of((0.25, 2.0), (np.nextafter(0.25, 1), 2.0), (0.25, np.nextafter(2.0, 3)))
    assert within(errors, QUARTER).tolist() == [True, False, False]


def test_both_errors_must_hold() -> None:
    errors = errors_of((0.1, 1.0), (0.1, 3.0), (0.3, 1.0))
    assert within(errors, QUARTER).tolist() == [True, False, False]
    position_only = Threshold(position_m=0.25)
    assert within(errors, position_only).tolist() == [True, True, False]


def test_missing_queries_stay_in_the_denominator() -> None:
    row = recall_row("x", errors_of((0.1, 1.0), (INF, INF), (INF, INF)), [QUARTER])
    assert (row.num_queries, row.num_localized, row.num_missing) == (3, 1, 2)
    assert row.recall[0].num_within == 1
    assert row.recall[0].recall == 1 / 3


def test_medians_over_all_and_over_the_localized() -> None:
    row = recall_row("x", errors_of((1.0, 10.0), (3.0, 30.0), (2.0, 20.0), (INF, INF)), [QUARTER])
    assert row.median_position_m == 2.5
    assert row.median_angle_deg == 25.0
    assert row.median_localized_position_m == 2.0
    assert row.median_localized_angle_deg == 20.0


def test_half_missing_makes_the_median_infinite() -> None:
    row = recall_row("x", errors_of((1.0, 10.0), (INF, INF)), [QUARTER])
    assert row.median_position_m == INF
    assert row.median_localized_position_m == 1.0


def test_fallback_poses_count_as_poses_but_not_as_localized() -> None:
    errors = errors_of((0.1, 1.0), (0.2, 1.5), (INF, INF))
    row = recall_row("x", errors, [QUARTER], fallback=np.array([False, True, True]))
    assert (row.num_localized, row.num_fallback, row.num_missing) == (1, 1, 1)
    assert row.recall[0].num_within == 2
    assert row.median_localized_position_m == 0.1


def test_a_group_without_queries() -> None:
    row = recall_row("x", errors_of(), [QUARTER])
    assert row.recall[0].recall == 0.0
    assert row.median_position_m == INF


def test_rows_by_condition_pool_and_all() -> None:
    errors = errors_of((0.1, 1), (0.1, 1), (0.1, 1), (9, 1), (9, 1), (INF, INF))
    conditions = ["noon", "noon", "noon", "dawn", "night", ""]
    members = row_members(
        conditions,
        order=("noon", "rain"),
        pools={"day": ("dawn", "noon"), "wet": ("rain",)},
    )
    rows = recall_rows(errors, [QUARTER], members)
    assert [row.name for row in rows] == ["noon", "dawn", "night", "", "day", "all"]
    recall = {row.name: row.recall[0].recall for row in rows}
    # pooled: 3 of 4 queries, not the mean 0.5 of the two recalls
    assert recall["day"] == 0.75
    assert recall["all"] == 0.5
    assert sum(row.num_queries for row in rows[:4]) == rows[-1].num_queries == 6


def test_without_conditions_there_is_one_row() -> None:
    assert list(row_members([""])) == ["all"]
    assert list(row_members([])) == ["all"]


@pytest.mark.parametrize(
    ("condition", "pools"), [("all", {}), ("day", {"day": ("day",)}), ("x", {"all": ("x",)})]
)
def test_two_rows_of_one_name_are_refused(condition: str, pools: dict) -> None:
    with pytest.raises(OptionError, match="rename one"):
        row_members([condition], pools=pools)


@given(st.lists(st.tuples(st.floats(0, 10), st.floats(0, 180)), max_size=20), st.integers(0, 5))
def test_wider_thresholds_never_lose_queries(pairs: list, num_missing: int) -> None:
    errors = errors_of(*pairs, *[(INF, INF)] * num_missing)
    wider = [Threshold(position_m=p, angle_deg=20 * p) for p in (0.1, 1.0, 5.0, 10.0)]
    row = recall_row("x", errors, wider)
    counts = [at.num_within for at in row.recall]
    assert counts == sorted(counts)
    assert counts[-1] <= len(pairs)
    assert row.num_localized + row.num_fallback + row.num_missing == row.num_queries


def test_json_has_no_infinity_and_reads_back() -> None:
    row = recall_row("x", errors_of((INF, INF)), [QUARTER])
    text = json.dumps(row.model_dump(mode="json"), allow_nan=False)
    assert json.loads(text)["median_position_m"] is None
    assert RecallRow.model_validate_json(text) == row
