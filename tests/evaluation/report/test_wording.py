"""Text of reports: the recall table, and sentences about differences."""

from __future__ import annotations

from typing import Any

import numpy as np

from megloc_kapture.evaluation.metrics import Threshold
from megloc_kapture.evaluation.report.reports import report_text
from megloc_kapture.evaluation.report.wording import (
    format_degrees,
    format_metres,
    format_percent,
    median_sentence,
    threshold_sentence,
)
from megloc_kapture.evaluation.scoring import Evaluation, evaluate_poses
from megloc_kapture.evaluation.statistics import MedianDifference, compare
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

Note: too few queries (5) to compare recall by: the intervals say how little they tell.
"""


def moved(metres: float) -> RigidTransform:
    return RigidTransform((1.0, 0.0, 0.0, 0.0), (metres, 0.0, 0.0))


def test_the_whole_table() -> None:
    truth = dict.fromkeys(["d1", "d2", "d3", "n1", "n2"], HERE)
    estimated = {"d1": moved(0.001), "d2": moved(0.1), "d3": moved(2.0), "n1": moved(0.4)}
    conditions = {name: {"d": "day", "n": "night"}[name[0]] for name in truth}
    text = report_text(evaluate_poses(estimated, truth, conditions=conditions, label="aachen"))
    assert text == TABLE


def test_fits_a_terminal_and_is_ascii(world: Any) -> None:
    world.estimated["stranger.jpg"] = HERE
    conditions = {name: f"{c}-in-a-hard-winter" for name, c in world.conditions.items()}
    options = {"conditions": conditions, "statuses": world.statuses}
    text = report_text(evaluate_poses(world.estimated, world.truth, **options))
    assert text.isascii()
    assert max(map(len, text.splitlines())) <= 100
    assert "(+4)" in text and "(+n): fallback poses" in text
    assert "4 queries could not be localized" in text
    assert "1 image has no true pose and is not counted: stranger.jpg." in text


def test_no_pose_at_all_strangers_and_thresholds_without_angles() -> None:
    strangers = {f"x{i}.jpg": HERE for i in range(1000)}
    text = report_text(evaluate_poses(strangers, {"a.jpg": HERE}))
    for words in ("0.0 / 0.0 / 0.0 / 0.0", "no query has a pose", "do the names agree?"):
        assert words in text
    assert "1000 images have no true pose" in text and "x5.jpg" not in text
    metres = [Threshold(position_m=0.1)]
    text = report_text(evaluate_poses({"a": HERE}, {"a": HERE}, thresholds=metres))
    assert "recall (%) at 0.1 m\nPosition error at or below" in text


def test_figures_are_printed_to_what_can_be_read() -> None:
    shares = [format_percent(recall) for recall in (0.0, 0.8975, 1.0, 2 / 3)]
    assert shares == ["0.0", "89.8", "100.0", "66.7"]
    assert (format_metres(0.00123), format_metres(12.3456)) == ("0.0012", "12.35")
    assert (format_degrees(0.0456), format_degrees(1.2345)) == ("0.046", "1.23")


THRESHOLD = Threshold(position_m=0.25, angle_deg=2.0)


def by_hand(only: int, other: int, both: int = 10) -> tuple[Evaluation, Evaluation]:
    """Two results, one alone within the threshold on ``only`` queries, the other on ``other``."""
    near, far = moved(0.1), moved(3.0)
    names = [f"{i:03d}.jpg" for i in range(only + other + both)]
    truth = dict.fromkeys(names, HERE)
    first = {n: far if only <= i < only + other else near for i, n in enumerate(names)}
    second = {n: far if i < only else near for i, n in enumerate(names)}
    options = {"thresholds": [THRESHOLD]}
    return (
        evaluate_poses(first, truth, label="A", **options),
        evaluate_poses(second, truth, label="B", **options),
    )


def sentence_of(only: int, other: int, both: int = 10) -> str:
    comparison = compare(by_hand(only, other, both))
    return threshold_sentence(comparison.tests[0], ["A", "B"])


def test_differences_that_are_real_and_that_could_be_chance() -> None:
    assert sentence_of(12, 3) == (
        "At 0.25 m, 2 deg A finds 12 queries that B misses and B finds 3 that A misses: "
        "the difference is real (p = 0.035)."
    )
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
    nothing = [
        evaluate_poses({}, e.truth, thresholds=[THRESHOLD], label=e.label) for e in by_hand(2, 0)
    ]
    said = threshold_sentence(compare(nothing).tests[0], ["A", "B"])
    assert said == "At 0.25 m, 2 deg neither A nor B finds a query."


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
