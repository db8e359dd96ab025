"""The text table: what it says, and that it fits a terminal."""

from __future__ import annotations

from typing import Any

import pytest

from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.evaluation.tables import (
    format_degrees,
    format_metres,
    format_percent,
    recall_table,
)
from megloc_kapture.evaluation.thresholds import Threshold
from megloc_kapture.values import RigidTransform

HERE = RigidTransform.identity()

TABLE = """\
aachen

recall (%) at 0.05 m, 5 deg / 0.25 m, 2 deg / 0.5 m, 5 deg / 5 m, 10 deg
Both errors at or below (<=) the threshold; a query without a pose counts as a miss.

                                                           median error (m, deg)
condition  queries  localized  recall (%)                  of all         of localized
---------------------------------------------------------------------------------------
day              3          3  33.3 / 66.7 / 66.7 / 100.0  0.1000, 0.000  0.1000, 0.000
night            2          1  0.0 / 0.0 / 50.0 / 50.0     inf            0.4000, 0.000
---------------------------------------------------------------------------------------
all              5          4  20.0 / 40.0 / 60.0 / 80.0   0.4000, 0.000  0.2500, 0.000

95 % confidence intervals of recall, queries taken as independent, (%)
day    0.8-90.6 / 9.4-99.2 / 9.4-99.2  / 29.2-100.0
night  0.0-84.2 / 0.0-84.2 / 1.3-98.7  / 1.3-98.7
all    0.5-71.6 / 5.3-85.3 / 14.7-94.7 / 28.4-99.5
"""


def moved(metres: float) -> RigidTransform:
    return RigidTransform((1.0, 0.0, 0.0, 0.0), (metres, 0.0, 0.0))


def test_the_whole_table() -> None:
    truth = dict.fromkeys(["d1", "d2", "d3", "n1", "n2"], HERE)
    estimated = {"d1": moved(0.001), "d2": moved(0.1), "d3": moved(2.0), "n1": moved(0.4)}
    conditions = {name: {"d": "day", "n": "night"}[name[0]] for name in truth}
    text = recall_table(evaluate(estimated, truth, conditions=conditions, label="aachen"))
    assert text == TABLE


def test_fits_a_terminal_and_is_ascii(world: Any) -> None:
    world.estimated["stranger.jpg"] = HERE
    text = recall_table(
        evaluate(
            world.estimated,
            world.truth,
            conditions={name: f"{c}-in-a-hard-winter" for name, c in world.conditions.items()},
            statuses=world.statuses,
        )
    )
    assert text.isascii()
    assert max(map(len, text.splitlines())) <= 100
    assert "(+4)" in text and "(+n): fallback poses" in text
    assert "4 queries could not be localized" in text
    assert "1 image has no true pose and is not counted: stranger.jpg." in text


def test_no_pose_at_all_says_so_and_asks_about_names() -> None:
    text = recall_table(evaluate({"other/a.jpg": HERE}, {"a.jpg": HERE}))
    assert "0.0 / 0.0 / 0.0 / 0.0" in text
    assert "no query has a pose" in text
    assert "do the names agree?" in text


def test_long_lists_of_strangers_are_cut() -> None:
    strangers = {f"x{i}.jpg": HERE for i in range(1000)}
    text = recall_table(evaluate(strangers, {"a.jpg": HERE}))
    assert "1000 images have no true pose" in text
    assert "x5.jpg" not in text


def test_position_only_thresholds() -> None:
    text = recall_table(evaluate({"a": HERE}, {"a": HERE}, thresholds=[Threshold(position_m=0.1)]))
    assert "recall (%) at 0.1 m\nPosition error at or below" in text


@pytest.mark.parametrize(
    ("recall", "printed"), [(0.0, "0.0"), (0.8975, "89.8"), (1.0, "100.0"), (2 / 3, "66.7")]
)
def test_percent(recall: float, printed: str) -> None:
    assert format_percent(recall) == printed


def test_errors_are_printed_to_what_can_be_read() -> None:
    assert (format_metres(0.00123), format_metres(12.3456)) == ("0.0012", "12.35")
    assert (format_degrees(0.0456), format_degrees(1.2345)) == ("0.046", "1.23")
