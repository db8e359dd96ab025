"""Rankers of poses by their inliers, on hypotheses whose right order is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import project
from megloc_kapture.localization import ranking
from megloc_kapture.localization.ranking import DistinctiveInliers, InlierCount
from megloc_kapture.plugins import HypothesisView, PoseHypothesis
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))
NO_SCENE: Any = None  # rankers by inliers use matches only


def room(count: int, seed: int = 0) -> NDArray[np.float64]:
    """Return points in front of a camera at the origin."""
    rng = np.random.default_rng(seed)
    return rng.uniform((-1.5, -1.0, 3.0), (1.5, 1.0, 5.0), (count, 3))


def standing(at_x: float, points: NDArray[np.float64]) -> PoseHypothesis:
    """Return a hypothesis in the room at ``at_x`` that sees points of the room's frame."""
    pose = RigidTransform((1.0, 0.0, 0.0, 0.0), (-at_x, 0.0, 0.0))
    world = points + (at_x, 0.0, 0.0)
    errors, every = np.zeros(len(points)), np.ones(len(points), bool)
    seen = HypothesisView("q", CAMERA, pose, project(CAMERA, pose, world), world, errors, every)
    return PoseHypothesis((f"room{at_x}",), (seen,), max_error_px=5.0)


def test_inliers_are_counted_over_all_views() -> None:
    alone = standing(0.0, room(3))
    (seen,) = alone.views
    some = replace(seen, inliers=np.array([True, True, False]))
    rig = replace(alone, views=(some, seen))
    scores = InlierCount().score([replace(alone, views=(some,)), rig], NO_SCENE)
    assert scores.tolist() == [2.0, 5.0]


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Count an inlier by the number of hypotheses that have an inlier at the same pixel."""
    monkeypatch.setattr(ranking, "_RADIUS", 0.0)
    monkeypatch.setattr(ranking, "_POWER", 1.0)


def test_distinctive_inliers_beat_more_common_ones(
    monkeypatch: pytest.MonkeyPatch, exact: None
) -> None:
    walls, poster = room(100), room(10, seed=1)
    right = standing(0.0, np.concatenate([walls[:70], poster]))
    wrong = [standing(7.0 * number, walls) for number in (1, 2, 3)]
    hypotheses = [*wrong, right]
    assert np.argmax(InlierCount().score(hypotheses, NO_SCENE)) == 0
    scores = DistinctiveInliers().score(hypotheses, NO_SCENE)
    # 70 points are in four rooms, 30 in three; ten in one
    np.testing.assert_allclose(scores, [*[70 / 4 + 30 / 3] * 3, 70 / 4 + 10])
    monkeypatch.undo()
    assert np.argmax(DistinctiveInliers().score(hypotheses, NO_SCENE)) == 3


def test_a_place_counts_where_it_has_an_inlier_nearby(
    monkeypatch: pytest.MonkeyPatch, exact: None
) -> None:
    walls = room(50)
    nearby = walls + (0.01, 0.0, 0.0)  # 1 to 2 px
    hypotheses = [standing(0.0, walls), standing(7.0, nearby)]
    np.testing.assert_allclose(DistinctiveInliers().score(hypotheses, NO_SCENE), 50.0)
    monkeypatch.setattr(ranking, "_RADIUS", 0.01)
    np.testing.assert_allclose(DistinctiveInliers().score(hypotheses, NO_SCENE), 25.0)
    np.testing.assert_allclose(DistinctiveInliers().score(hypotheses[:1], NO_SCENE), [50.0])


def test_two_clusters_of_one_place_do_not_count_against_each_other(exact: None) -> None:
    walls, poster = room(40), room(20, seed=1)
    everything = np.concatenate([walls, poster])
    twice = [standing(0.0, everything), standing(0.001, everything)]
    other = standing(7.0, walls)
    scores = DistinctiveInliers().score([*twice, other], NO_SCENE)
    np.testing.assert_allclose(scores, [40 / 2 + 20, 40 / 2 + 20, 40 / 3])
