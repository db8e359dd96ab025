"""The view from above: one page per coordinate frame, and who stands on which."""

from __future__ import annotations

import re
from typing import Any

from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.evaluation.figure_above import (
    Placed,
    views_from_above,
    views_of_evaluation,
)
from megloc_kapture.values import RigidTransform


def moved(x: float) -> RigidTransform:
    return RigidTransform((1.0, 0.0, 0.0, 0.0), (x, 0.0, 0.0))


def dots(svg: str) -> int:
    """Markers drawn, of all kinds."""
    return len(re.findall(r"<use ", svg))


def test_frames_are_drawn_apart() -> None:
    mapped = {f"DUC1/{i}.jpg": moved(i) for i in range(5)}
    mapped |= {f"DUC2/{i}.jpg": moved(1000.0 + i) for i in range(5)}
    frames = {name: name[:4] for name in mapped}
    truth = {"a.jpg": moved(1.0), "b.jpg": moved(1002.0), "c.jpg": moved(1003.0)}
    evaluation = evaluate(
        {"a.jpg": moved(1.5)},
        truth,
        conditions={"a.jpg": "DUC1", "b.jpg": "DUC2", "c.jpg": "DUC2"},
    )
    first, second = views_of_evaluation(evaluation, mapped, frames)
    assert (first.frame, second.frame) == ("DUC1", "DUC2")
    # on one page the two would be a kilometre apart, and the estimate outside of nothing
    assert first.num_outside == second.num_outside == 0
    assert dots(first.svg) < dots(second.svg) + 20
    assert "truth, no pose" in second.svg and "truth, no pose" not in first.svg
    ids = re.findall(r'\sid="([^"]*)"', first.svg + second.svg)
    assert len(ids) == len(set(ids))


def test_one_frame_needs_no_name(world: Any) -> None:
    evaluation = evaluate(world.estimated, world.truth, conditions=world.conditions)
    (view,) = views_of_evaluation(evaluation, world.mapped)
    assert view.frame == ""
    # a frame that all images share is one page too
    (again,) = views_of_evaluation(evaluation, world.mapped, dict.fromkeys(world.mapped, "town"))
    assert again.svg == view.svg


def test_without_truth_estimates_span_the_page_where_there_is_no_map() -> None:
    placed = {f"{i}.jpg": Placed(None, moved(10.0 * i)) for i in range(4)}
    (view,) = views_from_above(placed, {}, {}, with_truth=False)
    assert view.num_outside == 0
    assert "truth" not in re.sub(r"<[^>]*>", "", view.svg)
