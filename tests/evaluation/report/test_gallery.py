"""The gallery: which queries, their order, what they can be filtered by, and its size."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.evaluation.report import gallery
from megloc_kapture.evaluation.report.document import Cards
from megloc_kapture.evaluation.report.gallery import gallery_blocks
from megloc_kapture.evaluation.report.reports import render_report
from megloc_kapture.evaluation.report.shown_queries import StoredInliers, shown_queries
from megloc_kapture.evaluation.results import ResultContext
from megloc_kapture.evaluation.scoring import Evaluation, evaluate_poses
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureFolder


@pytest.fixture
def evaluation(world: Any, tmp_path: Path, kaptures: Any) -> Evaluation:
    root = kaptures(tmp_path / "query", list(world.truth), {})
    rng = np.random.default_rng(0)
    for name in world.truth:
        pixels = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        write_image(root / "sensors/records_data" / name, pixels)
    found = evaluate_poses(
        world.estimated, world.truth, conditions=world.conditions, statuses=world.statuses
    )
    return replace(found, context=ResultContext(queries=KaptureFolder(root)))


def cards_of(evaluation: Evaluation) -> Cards:
    blocks = gallery_blocks(StoredInliers(evaluation.context), shown_queries(evaluation))
    return next(block for block in blocks if isinstance(block, Cards))


def test_best_typical_and_worst_come_first_then_the_worst(evaluation: Evaluation) -> None:
    cards = cards_of(evaluation).cards
    assert [card.role for card in cards[:9]] == ["best"] * 3 + ["typical"] * 3 + ["worst"] * 3
    assert len(cards) == len({card.name for card in cards}) == 40
    errors = [card.sort["error"] for card in cards]
    everything = sorted(query.position_m for query in evaluation.queries)
    assert sorted(errors[:3]) == everything[:3]
    assert sorted(errors[3:6]) == everything[19:22]
    assert errors[6:9] == [np.inf] * 3
    assert errors[9:] == sorted(errors[9:], reverse=True)


def test_what_can_be_chosen(evaluation: Evaluation) -> None:
    cards = cards_of(evaluation)
    assert cards.values("condition") == ["day", "night"]
    assert cards.values("outcome") == ["fallback", "localized", "no pose"]
    assert cards.orders() == ["error", "inliers"]  # nobody gave confidences


def test_the_page_has_them_all_and_stands_without_the_script(
    evaluation: Evaluation, page_of: Any
) -> None:
    html = render_report(evaluation)
    page = page_of(html)
    assert len(page.images) >= 40 and page.scripts == ["script"]
    for query in evaluation.queries:
        assert query.image in page.text
    assert '<p class="pick" hidden>' in html  # shown by the script alone
    assert render_report(evaluation) == html


def test_hostile_names(evaluation: Evaluation, page_of: Any) -> None:
    evil = "\"'></p></script><script>alert(1)</script>"
    queries = tuple(
        replace(query, condition=evil if k % 2 else "day", reason=query.reason and evil)
        for k, query in enumerate(evaluation.queries)
    )
    html = render_report(replace(evaluation, queries=queries))
    assert "<script>alert" not in html
    page_of(html)


def test_of_many_some_are_shown(evaluation: Evaluation, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gallery, "MAX_PICTURES", 19)
    cards = cards_of(evaluation).cards
    assert len(cards) == 19
    worst = sorted(shown_queries(evaluation), key=lambda query: query.rank())[3:8]
    assert [card.name for card in cards[9:14]] == [query.name for query in worst]


def test_without_images_there_is_none(evaluation: Evaluation) -> None:
    shown = shown_queries(evaluation)
    assert gallery_blocks(StoredInliers(ResultContext()), shown) == ()
    assert evaluation.context.queries is not None
    for path in evaluation.context.queries.root.rglob("*.jpg"):
        path.unlink()
    assert gallery_blocks(StoredInliers(evaluation.context), shown) == ()
