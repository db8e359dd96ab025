"""One result scored by camera centres."""

from __future__ import annotations

from typing import Any

import pytest

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.evaluation.scoring import evaluate_poses
from megloc_kapture.io.tables import QueryStatus
from megloc_kapture.values import RigidTransform

HERE = RigidTransform.identity()


def test_every_true_query_is_counted_once(world: Any) -> None:
    evaluation = evaluate_poses(
        world.estimated, world.truth, conditions=world.conditions, statuses=world.statuses
    )
    assert [q.image for q in evaluation.queries] == sorted(world.truth)
    assert evaluation.errors.names == tuple(sorted(world.truth))
    row = evaluation.row()
    outcomes = [query.outcome for query in evaluation.queries]
    assert row.num_localized == outcomes.count("localized") == 32
    assert row.num_fallback == outcomes.count("fallback") == 4
    assert row.num_missing == outcomes.count("missing") == 4
    assert evaluation.row("day").num_queries + evaluation.row("night").num_queries == 40
    assert list(evaluation.estimated) == sorted(world.estimated)
    with pytest.raises(KeyError):
        evaluation.row("noon")


def test_images_without_truth_are_reported_and_not_counted() -> None:
    evaluation = evaluate_poses({"b": HERE, "x": HERE, "c": HERE}, {"a": HERE, "b": HERE})
    assert evaluation.without_truth == ("c", "x")
    assert evaluation.row().num_queries == 2
    assert "x" not in evaluation.estimated


def test_only_scored_images_are_counted() -> None:
    truth = {"a": HERE, "b": HERE, "c": HERE}
    evaluation = evaluate_poses({"a": HERE}, truth, scored={"a", "c", "unknown"})
    assert [q.image for q in evaluation.queries] == ["a", "c"]
    assert evaluation.not_scored == ("b",)
    assert evaluation.without_truth == ("unknown",)


def test_statuses_tell_fallback_and_reason() -> None:
    statuses = {
        "a": QueryStatus(image="a", status="localized", num_matches=9, num_inliers=5),
        "b": QueryStatus(image="b", status="failed", reason="dark", fallback="retrieval"),
        "c": QueryStatus(image="c", status="failed", reason="blurred"),
        "d": QueryStatus(image="d", status="localized"),
    }
    truth = dict.fromkeys("abcde", HERE)
    evaluation = evaluate_poses({"a": HERE, "b": HERE}, truth, statuses=statuses)
    assert [(q.outcome, q.reason, q.num_inliers) for q in evaluation.queries] == [
        ("localized", "", 5),
        ("fallback", "dark", 0),
        ("missing", "blurred", 0),
        ("missing", "status says localized, but the result has no pose", 0),
        ("missing", "no pose in the result", None),
    ]


def test_nothing_to_count_is_an_error() -> None:
    with pytest.raises(DataError, match="no query with a true pose"):
        evaluate_poses({"a": HERE}, {})
    with pytest.raises(DataError, match="no query with a true pose"):
        evaluate_poses({}, {"a": HERE}, scored=set())


def test_no_threshold_is_an_error() -> None:
    with pytest.raises(OptionError, match="threshold"):
        evaluate_poses({}, {"a": HERE}, thresholds=())


def test_the_order_of_the_input_does_not_matter(world: Any) -> None:
    backwards = dict(reversed(world.estimated.items()))
    first = evaluate_poses(world.estimated, world.truth)
    second = evaluate_poses(backwards, dict(reversed(world.truth.items())))
    assert first.rows == second.rows
    assert first.queries == second.queries
