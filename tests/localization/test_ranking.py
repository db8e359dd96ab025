"""Rankers of candidate poses, on hypotheses whose right order is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.localization.ranking import InlierCount, InlierSpread, ReprojectionScore
from megloc_kapture.plugins import (
    POSE_RANKERS,
    HypothesisView,
    PoseHypothesis,
    PoseRanker,
    load_plugin,
)
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))


class NoScene:
    """Our rankers look at matches only."""

    def __getattr__(self, name: str) -> object:
        raise AssertionError(f"{name} was asked for")


def view(points_px: NDArray[np.float64], errors_px: NDArray[np.float64]) -> HypothesisView:
    return HypothesisView(
        name="q",
        camera=CAMERA,
        cam_from_world=RigidTransform.identity(),
        points_px=points_px,
        points_world=np.zeros((len(points_px), 3)),
        errors_px=errors_px,
        inliers=errors_px <= 10.0,
    )


def hypothesis(*views: HypothesisView) -> PoseHypothesis:
    return PoseHypothesis(("m",), views, max_error_px=10.0)


def spot(count: int) -> NDArray[np.float64]:
    return np.full((count, 2), 100.0) + np.arange(count)[:, None] * 0.01


def everywhere(count: int) -> NDArray[np.float64]:
    at = (np.arange(count) + 0.5) / count
    return np.stack([640 * at, 480 * ((at * 7) % 1)], axis=1)


@pytest.mark.parametrize("name", ["inliers", "spread", "reprojection"])
def test_they_are_registered(name: str) -> None:
    ranker = load_plugin(POSE_RANKERS, name)
    assert isinstance(ranker, PoseRanker)
    assert ranker.score([], NoScene()).shape == (0,)


def test_inliers_are_counted_over_all_views() -> None:
    good, bad = np.array([1.0, 2.0, 20.0]), np.array([np.inf, 11.0, 3.0])
    three = everywhere(3)
    found = InlierCount().score(
        [hypothesis(view(three, good)), hypothesis(view(three, good), view(three, bad))], NoScene()
    )
    assert found.tolist() == [2.0, 3.0]


def test_spread_prefers_inliers_all_over_the_image() -> None:
    heap = hypothesis(view(spot(200), np.zeros(200)))
    few = hypothesis(view(everywhere(20), np.zeros(20)))
    assert InlierCount().score([heap, few], NoScene()).argmax() == 0
    assert InlierSpread().score([heap, few], NoScene()).argmax() == 1


def test_spread_counts_cells_and_breaks_ties_by_inliers() -> None:
    cell = np.array([[5.0, 5.0], [35.0, 5.0], [45.0, 5.0]])  # cells of 40 px
    two, three = view(cell[:2], np.zeros(2)), view(cell, np.zeros(3))
    one_cell, two_cells = InlierSpread().score([hypothesis(two), hypothesis(three)], NoScene())
    assert int(one_cell) == 1 and int(two_cells) == 2
    fewer = view(cell[[0, 2]], np.zeros(2))
    a, b = InlierSpread().score([hypothesis(fewer), hypothesis(three)], NoScene())
    assert a < b < a + 1


def test_reprojection_prefers_the_better_fit() -> None:
    many = hypothesis(view(everywhere(30), np.full(30, 9.0)))
    exact = hypothesis(view(everywhere(10), np.full(10, 1.0)))
    scores = ReprojectionScore().score([many, exact], NoScene())
    np.testing.assert_allclose(scores, [30 * 0.19, 10 * 0.99])
