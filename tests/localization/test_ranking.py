"""Rankers of poses by inliers and by appearance, in rooms that differ by a poster on the wall."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import Scene

from megloc_kapture.geometry.cameras import pixel_rays, project
from megloc_kapture.geometry.warping import WarpedView, image_with_depth
from megloc_kapture.localization import ranking
from megloc_kapture.localization.ranking import (
    DistinctiveInliers,
    InlierCount,
    PerceptualRanker,
    aligned_view,
)
from megloc_kapture.plugins import DepthView, HypothesisView, PoseHypothesis
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("SIMPLE_PINHOLE", 160, 120, (120.0, 80.0, 60.0))
WALL_M = 3.0
APART_M = 20.0  # between rooms
RIGHT = 2


def stripes(seed: int, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    waves = rng.uniform(-6, 6, (8, 2))
    phases = rng.uniform(0, 6.3, 8)
    return sum(np.sin(w[0] * x + w[1] * y + p) for w, p in zip(waves, phases, strict=True))


def colours(room: int, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Paint the wall that all rooms share, and the room's poster."""
    poster = (np.abs(x - 0.6) < 0.45) & (np.abs(y) < 0.6)
    value = np.where(poster, stripes(100 + room, x, y), stripes(0, x, y))
    return np.repeat((128 + 18 * value).clip(0, 255).astype(np.uint8)[..., None], 3, axis=-1)


def standing(room: int, x: float = 0.0, z: float = 0.0) -> RigidTransform:
    return RigidTransform((1.0, 0.0, 0.0, 0.0), (-(APART_M * room + x), 0.0, -z))


@cache
def photograph(room: int, pose: RigidTransform) -> NDArray[np.uint8]:
    centre = pose.center()
    at = centre + pixel_rays(CAMERA) * (WALL_M - centre[2])
    image = colours(room, at[:, 0] - APART_M * room, at[:, 1])
    return image.reshape(CAMERA.height, CAMERA.width, 3)


# two images of each room
POSES = {
    f"{room}_{number}.jpg": standing(room, x, -0.2)
    for room in range(4)
    for number, x in enumerate((-0.4, 0.5))
}


def scene_of(poses: Mapping[str, RigidTransform]) -> Scene:
    """Return a map with depth, whose names begin with the room, and a query "q"."""
    images = {name: photograph(int(name[0]), pose) for name, pose in poses.items()}
    images["q"] = photograph(RIGHT, standing(RIGHT))
    shape = (CAMERA.height, CAMERA.width)
    depths = {
        name: DepthView(CAMERA, np.full(shape, WALL_M + 0.2, np.float32), RigidTransform.identity())
        for name in poses
    }
    return Scene(dict(poses), dict.fromkeys(poses, CAMERA), depths, images)


def hide_depth(scene: Scene, name: str, columns: slice) -> None:
    scene.depths[name].depth_m[:, columns] = 0


def hypothesis(room: int, inliers: int, views: int = 1) -> PoseHypothesis:
    """Return the query's pose in a room, with inliers on the part that all rooms share."""
    rng = np.random.default_rng(0)
    pose = standing(room)
    points = rng.uniform((-1.5, -1.0, WALL_M), (0.1, 1.0, WALL_M + 1e-9), (300, 3))[:inliers]
    world = points + (APART_M * room, 0.0, 0.0)
    pixels, every = project(CAMERA, pose, world), np.ones(inliers, bool)
    posed = HypothesisView("q", CAMERA, pose, pixels, world, np.zeros(inliers), every)
    return PoseHypothesis((f"{room}_0.jpg", f"{room}_1.jpg"), (posed,) * views, 4.0)


HYPOTHESES = [hypothesis(0, 300), hypothesis(1, 280), hypothesis(RIGHT, 120), hypothesis(3, 200)]


@pytest.fixture
def scene() -> Scene:
    return scene_of(POSES)


def test_the_room_that_looks_like_the_query_wins(scene: Scene) -> None:
    assert np.argmax(InlierCount().score(HYPOTHESES, scene)) == 0
    assert np.argmax(DistinctiveInliers().score(HYPOTHESES, scene)) == 0
    scores = PerceptualRanker().score(HYPOTHESES, scene)
    assert scores.shape == (4,) and np.isfinite(scores).all()
    assert np.argmax(scores) == 2
    assert scores[2] - np.delete(scores, 2).max() > 0.05
    assert len(scene.asked) == len(set(scene.asked)) == 1 + 8  # every picture is read once
    again = pickle.loads(pickle.dumps(PerceptualRanker()))
    np.testing.assert_array_equal(again.score(HYPOTHESES, scene), scores)
    # the views of a rig count together
    both, alone = (
        PerceptualRanker().score([hypothesis(0, 300, views), hypothesis(RIGHT, 120, views)], scene)
        for views in (2, 1)
    )
    np.testing.assert_allclose(both, alone, atol=1e-9)
    # one hypothesis or none
    scene.asked.clear()
    assert PerceptualRanker().score([], scene).shape == (0,)
    np.testing.assert_array_equal(PerceptualRanker().score(HYPOTHESES[:1], scene), [0.0])
    assert scene.asked == []


def test_rooms_are_compared_on_common_pixels(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    # only the part that all rooms share is known of a wrong room
    narrow = PoseHypothesis(("0_0.jpg",), HYPOTHESES[0].views, 4.0)
    hide_depth(scene, "0_0.jpg", slice(60, None))
    # the query has noise on a part that is known of the right room
    query = scene.images["q"]
    noise = np.random.default_rng(0).normal(0, 12, query.shape)
    query = (query + noise).clip(0, 255).astype(np.uint8)
    right = query[:, 100:]
    more = np.random.default_rng(1).integers(0, 60, right.shape, dtype=np.uint8)
    query[:, 100:] = right // 2 + more
    scene.images["q"] = query
    pair = [narrow, hypothesis(RIGHT, 120)]
    together = PerceptualRanker().score(pair, scene)
    monkeypatch.setattr(ranking, "_FINALISTS", 1)
    alone = PerceptualRanker().score(pair, scene)
    assert alone[0] > alone[1] + 0.05
    assert abs(together[0] - together[1]) < 0.3 * (alone[0] - alone[1])


def test_rooms_apart_compare_their_distances(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranking, "_MIN_VALID", 0.05)
    # the poster of the wrong room and the wall of the right one are known
    for room, unknown in ((0, slice(90)), (RIGHT, slice(70, None))):
        for number in (0, 1):
            hide_depth(scene, f"{room}_{number}.jpg", unknown)
    for order in (1, -1):
        pair = [hypothesis(0, 300), hypothesis(RIGHT, 120)][::order]
        for hypotheses in (pair, [PoseHypothesis(h.images[:1], h.views, 4.0) for h in pair]):
            scores = PerceptualRanker().score(hypotheses, scene)[::order]
            assert scores[1] > scores[0] + 0.05
            assert scores.sum() == pytest.approx(0.0)


def test_poses_without_depth_or_pixels(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    # clusters with few inliers are skipped
    with monkeypatch.context() as changed:
        changed.setattr(ranking, "_MIN_INLIER_SHARE", 0.5)
        scores = PerceptualRanker().score(HYPOTHESES, scene)
    assert np.argmin(scores) == 2  # 120 of 300
    assert not any(name.startswith("2_") for name in scene.asked)
    # hypotheses without depth come last
    depths = scene.depths
    scene.depths = {name: view for name, view in depths.items() if name[0] != "3"}
    scores = PerceptualRanker().score(HYPOTHESES, scene)
    assert np.argmax(scores) == 2 and np.argmin(scores) == 3
    assert np.isfinite(scores).all()
    # inliers decide if the best by inliers has no depth, or the query is masked
    expected = DistinctiveInliers().score(HYPOTHESES, scene)
    scene.depths = {name: view for name, view in depths.items() if name[0] != "0"}
    np.testing.assert_array_equal(PerceptualRanker().score(HYPOTHESES, scene), expected)
    scene.depths = depths
    scene.masks["q"] = np.zeros((CAMERA.height, CAMERA.width), bool)
    np.testing.assert_array_equal(PerceptualRanker().score(HYPOTHESES, scene), expected)


def test_masked_parts_of_the_query_do_not_count(scene: Scene) -> None:
    plain = PerceptualRanker().score(HYPOTHESES, scene)
    # a person hides the right part of the view
    scene.images["q"] = scene.images["q"].copy()
    scene.images["q"][:, 125:] = 255 * (np.indices((CAMERA.height, 35)).sum(0) % 2)[..., None]
    spoilt = PerceptualRanker().score(HYPOTHESES, scene)
    scene.masks["q"] = np.ones((CAMERA.height, CAMERA.width), bool)
    scene.masks["q"][:, 125:] = False
    masked = PerceptualRanker().score(HYPOTHESES, scene)
    assert np.argmax(masked) == 2
    assert masked[2] - masked[0] > spoilt[2] - spoilt[0]
    assert plain[2] > 0


def view_at(pose: RigidTransform, images: list[str], scene: Scene) -> WarpedView:
    return aligned_view(CAMERA, pose, images, scene, partial(image_with_depth, scene=scene))


def test_the_nearest_references_are_taken(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranking, "_REFERENCES", 1)
    near = standing(RIGHT, 0.45)
    view_at(near, ["2_0.jpg", "2_1.jpg"], scene)
    assert scene.asked == ["2_1.jpg"]
    scene.asked = []
    del scene.depths["2_1.jpg"]
    view_at(near, ["2_0.jpg", "2_1.jpg"], scene)
    assert scene.asked == ["2_0.jpg"]
    assert not view_at(near, [], scene).valid.any()


def test_references_from_different_positions_come_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranking, "_REFERENCES", 2)
    # four images from nearly the same position, and another
    numbers = {0: -0.5, 1: -0.499, 2: -0.498, 3: -0.497, 9: 0.9}
    room = scene_of({f"2_{number}.jpg": standing(RIGHT, x, 0.5) for number, x in numbers.items()})
    film = [f"2_{number}.jpg" for number in range(4)]
    view = view_at(standing(RIGHT), [*film, "2_9.jpg"], room)
    assert room.asked == ["2_3.jpg", "2_9.jpg"]
    of_film = view_at(standing(RIGHT), film, room)
    assert view.valid.mean() > of_film.valid.mean() + 0.1
    # all are used if the number allows
    monkeypatch.undo()
    room.asked = []
    view_at(standing(RIGHT), [*film, "2_9.jpg"], room)
    assert room.asked == ["2_3.jpg", "2_9.jpg", "2_2.jpg", "2_1.jpg", "2_0.jpg"]


NO_SCENE: Any = None  # rankers by inliers use matches only


def room(count: int, seed: int = 0) -> NDArray[np.float64]:
    """Return points in front of a camera at the origin."""
    rng = np.random.default_rng(seed)
    return rng.uniform((-1.5, -1.0, 3.0), (1.5, 1.0, 5.0), (count, 3))


def in_room(at_x: float, points: NDArray[np.float64]) -> PoseHypothesis:
    """Return a hypothesis in the room at ``at_x`` that sees points of the room's frame."""
    pose = RigidTransform((1.0, 0.0, 0.0, 0.0), (-at_x, 0.0, 0.0))
    world = points + (at_x, 0.0, 0.0)
    errors, every = np.zeros(len(points)), np.ones(len(points), bool)
    seen = HypothesisView("q", CAMERA, pose, project(CAMERA, pose, world), world, errors, every)
    return PoseHypothesis((f"room{at_x}",), (seen,), max_error_px=5.0)


def test_inliers_are_counted_over_all_views() -> None:
    alone = in_room(0.0, room(3))
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


def test_distinctive_inliers_beat_common_ones(monkeypatch: pytest.MonkeyPatch, exact: None) -> None:
    walls, poster = room(100), room(10, seed=1)
    right = in_room(0.0, np.concatenate([walls[:70], poster]))
    wrong = [in_room(7.0 * number, walls) for number in (1, 2, 3)]
    hypotheses = [*wrong, right]
    assert np.argmax(InlierCount().score(hypotheses, NO_SCENE)) == 0
    scores = DistinctiveInliers().score(hypotheses, NO_SCENE)
    # 70 points are in four rooms, 30 in three; ten in one
    np.testing.assert_allclose(scores, [*[70 / 4 + 30 / 3] * 3, 70 / 4 + 10])
    monkeypatch.undo()
    assert np.argmax(DistinctiveInliers().score(hypotheses, NO_SCENE)) == 3


def test_a_place_counts_if_an_inlier_is_near(monkeypatch: pytest.MonkeyPatch, exact: None) -> None:
    walls = room(50)
    nearby = walls + (0.01, 0.0, 0.0)  # half a pixel
    hypotheses = [in_room(0.0, walls), in_room(7.0, nearby)]
    np.testing.assert_allclose(DistinctiveInliers().score(hypotheses, NO_SCENE), 50.0)
    monkeypatch.setattr(ranking, "_RADIUS", 0.01)
    np.testing.assert_allclose(DistinctiveInliers().score(hypotheses, NO_SCENE), 25.0)
    np.testing.assert_allclose(DistinctiveInliers().score(hypotheses[:1], NO_SCENE), [50.0])


def test_two_clusters_of_one_place_do_not_count_against_each_other(exact: None) -> None:
    walls, poster = room(40), room(20, seed=1)
    everything = np.concatenate([walls, poster])
    twice = [in_room(0.0, everything), in_room(0.001, everything)]
    other = in_room(7.0, walls)
    scores = DistinctiveInliers().score([*twice, other], NO_SCENE)
    np.testing.assert_allclose(scores, [40 / 2 + 20, 40 / 2 + 20, 40 / 3])
