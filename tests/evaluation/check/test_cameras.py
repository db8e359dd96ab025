"""The map's cameras around poses: those compared with, how near they are, and heights."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.evaluation.check.cameras import Neighbourhood, camera_sets, storey_offset
from megloc_kapture.evaluation.check.reading import MapCameras, Reference
from megloc_kapture.io.dataset_tables import ImageGroup

IMAGES = ("m1", "m2", "m3", "m4")
CAMERAS = MapCameras(IMAGES, np.tile([1.0, 0, 0, 0], (4, 1)), np.zeros((4, 3)))
FLOORS = {
    "m1": ImageGroup(frame="DUC1", location="a"),
    "m2": ImageGroup(frame="DUC1", location="b"),
    "m3": ImageGroup(frame="DUC2"),
    "m4": ImageGroup(frame="DUC2"),
}


def test_without_tables_everything_is_compared_with_everything() -> None:
    sets = camera_sets(Reference(folder=""), CAMERAS, ["q1", None])
    assert sets.own.tolist() == [0, 0] and not sets.has_other.any()
    assert sets.members[0].tolist() == [0, 1, 2, 3]


def test_priors_frames_and_conditions() -> None:
    groups = FLOORS | {
        "by condition": ImageGroup(condition="DUC2"),
        "day": ImageGroup(condition="day"),
    }
    priors = {
        "by location": ("b",),
        "by two": ("a", "DUC2"),
        "by frame": ("DUC1",),
        "by image": ("m4",),
        "by nothing there": ("c",),
    }
    reference = Reference(folder="", groups=groups, priors=priors)
    expected: dict[str | None, tuple[list[int], list[int]]] = {
        "by location": ([1], [2, 3]),
        "by two": ([0, 2, 3], [0, 2, 3]),
        "by frame": ([0, 1], [2, 3]),
        "by image": ([2, 3], [0, 1]),
        "by condition": ([2, 3], [0, 1]),
        "by nothing there": ([0, 1, 2, 3], [0, 1, 2, 3]),
        "day": ([0, 1, 2, 3], [0, 1, 2, 3]),
        None: ([0, 1, 2, 3], [0, 1, 2, 3]),
    }
    sets = camera_sets(reference, CAMERAS, list(expected))
    for number, (query, (own, other)) in enumerate(expected.items()):
        assert sets.members[sets.own[number]].tolist() == own, query
        assert sets.members[sets.other[number]].tolist() == other, query
    assert sets.has_other.tolist() == [own != other for own, other in expected.values()]
    assert sets.labels[sets.own[2]] == "DUC1" and sets.labels[sets.other[2]] == "DUC2"


def cameras(number: int, seed: int = 0) -> MapCameras:
    rng = np.random.default_rng(seed)
    quats = Rotation.random(number, random_state=seed).as_quat()
    return MapCameras(
        tuple(map(str, range(number))), np.roll(quats, 1, axis=1), rng.uniform(0, 10, (number, 3))
    )


def test_against_all_cameras_one_by_one() -> None:
    own = cameras(40)
    rng = np.random.default_rng(1)
    quats = np.roll(Rotation.random(25, random_state=1).as_quat(), 1, axis=1)
    centers = rng.uniform(-2, 12, (25, 3))
    hood = Neighbourhood(own, [np.arange(40)])
    found = hood.look(quats, centers, np.zeros(25, dtype=np.int64))
    for i in range(25):
        distances = np.linalg.norm(own.centers - centers[i], axis=1)
        turn = Rotation.from_quat(np.roll(own.quats, -1, axis=1))
        relative = turn * Rotation.from_quat(np.roll(quats[i], -1)).inv()
        angles = np.rad2deg(relative.magnitude())
        assert found.distance[i] == distances.min()
        scores = -np.log1p(distances / hood.spacing[0])
        scores -= np.log1p((np.minimum(angles, 90) / 20) ** 2)
        assert np.isclose(found.score[i], scores.max())
        assert found.fits[i] == ((distances <= found.near[i]) & (angles <= 45)).any()


def test_sets_do_not_see_each_other() -> None:
    own = cameras(40)
    sets = [np.arange(20), np.arange(20, 40), np.array([7])]
    hood = Neighbourhood(own, sets)
    at = own.centers[[3, 30, 3]]
    found = hood.look(own.quats[[3, 30, 3]], at, np.array([0, 0, 2]))
    assert found.distance[0] == 0 and found.score[0] == 0 and found.fits[0]
    others = np.linalg.norm(own.centers[:20] - own.centers[30], axis=1)
    assert np.isclose(found.distance[1], others.min())
    assert np.isclose(found.distance[2], np.linalg.norm(own.centers[3] - own.centers[7]))
    alone = hood.look(own.quats[[8]], own.centers[[8]], np.array([2]))
    assert not alone.fits[0] and np.isfinite(alone.score[0])


def test_scores_know_no_unit() -> None:
    own = cameras(60)
    quats, centers = own.quats[:9], own.centers[:9] + 0.3
    sets = np.zeros(9, dtype=np.int64)
    scores = Neighbourhood(own, [np.arange(60)]).look(quats, centers, sets).score
    for scale in (1e-3, 1e4):
        scaled = MapCameras(own.images, own.quats, own.centers * scale)
        hood = Neighbourhood(scaled, [np.arange(60)])
        np.testing.assert_allclose(hood.look(quats, centers * scale, sets).score, scores)


def test_cameras_of_one_place_are_one_for_the_spacing() -> None:
    line = np.column_stack([np.arange(20) * 5.0, np.zeros(20), np.zeros(20)])
    scans = np.repeat(line, 36, axis=0) + np.random.default_rng(0).normal(0, 1e-3, (720, 3))
    quats = np.tile([1.0, 0, 0, 0], (720, 1))
    hood = Neighbourhood(MapCameras((), quats, scans), [np.arange(720)])
    assert abs(hood.spacing[0] - 5) < 0.3


def test_a_map_in_one_place_says_nothing_of_positions() -> None:
    quats = cameras(5).quats
    hood = Neighbourhood(MapCameras((), quats, np.ones((5, 3))), [np.arange(5)])
    found = hood.look(quats, np.full((5, 3), 9.0), np.zeros(5, dtype=np.int64))
    assert np.isinf(hood.spacing[0])
    np.testing.assert_allclose(found.score, 0.0, atol=1e-12)


def test_what_is_not_finite_is_infinitely_far() -> None:
    own = cameras(10)
    centers = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e200, 0, 0], [1.0, 1, 1]])
    found = Neighbourhood(own, [np.arange(10)]).look(own.quats[:4], centers, np.zeros(4, np.int64))
    assert np.isinf(found.distance).tolist() == [True, True, True, False]
    assert not found.fits[:3].any() and np.isneginf(found.score[:3]).all()


LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def building(
    heights: np.ndarray | float = 1.5, tilt: Rotation | None = None
) -> tuple[MapCameras, np.ndarray]:
    """Cameras every two metres on a floor, in a world that may be tilted, and stands between."""
    x, y = np.meshgrid(np.arange(0, 40, 2.0), np.arange(0, 20, 2.0))
    centers = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size) + heights])
    world = tilt or Rotation.identity()
    rotation = LEVEL @ world.as_matrix().T
    quat = np.roll(Rotation.from_matrix(rotation).as_quat(), 1)
    own = MapCameras(("",) * len(centers), np.tile(quat, (len(centers), 1)), world.apply(centers))
    return own, np.column_stack([x.ravel() + 0.7, y.ravel() - 0.4, np.full(x.size, 1.6)])


@pytest.mark.parametrize("tilt", [None, Rotation.from_rotvec([0.8, -0.3, 0.4])])
@pytest.mark.parametrize("offset", [3.2, -4.0])
def test_a_storey(tilt: Rotation | None, offset: float) -> None:
    cameras, stands = building(tilt=tilt)
    world = tilt or Rotation.identity()
    found = storey_offset(cameras, world.apply(stands + [0, 0, offset]))
    assert found is not None and abs(found - offset) < 0.15
    assert storey_offset(cameras, world.apply(stands)) is None
    assert storey_offset(cameras, world.apply(stands + [0, 0, 1.0])) is None


def test_a_few_strays_and_infinities_change_nothing() -> None:
    cameras, stands = building()
    stands = stands + [0, 0, 3.0]
    stands[:40, 2] -= 3.0
    stands[40:45] = np.inf
    found = storey_offset(cameras, stands)
    assert found is not None and abs(found - 3.1) < 0.01
    stands[:120, 2] = 1.6
    assert storey_offset(cameras, stands) is None


def test_a_map_of_both_storeys_has_all_heights() -> None:
    cameras, stands = building(np.where(np.arange(200) % 2, 1.5, 5.0))
    assert storey_offset(cameras, stands + [0, 0, 3.4]) is None


def test_a_hilly_map_says_nothing() -> None:
    cameras, stands = building(np.random.default_rng(0).uniform(0, 8, 200))
    assert storey_offset(cameras, stands + [0, 0, 5.0]) is None


def test_maps_that_do_not_know_up_or_have_one_place() -> None:
    cameras, stands = building()
    every_way = np.roll(Rotation.random(200, random_state=0).as_quat(), 1, axis=1)
    tumbling = MapCameras(cameras.images, every_way, cameras.centers)
    assert storey_offset(tumbling, stands + [0, 0, 3.0]) is None
    one = MapCameras(cameras.images, cameras.quats, np.ones((200, 3)))
    assert storey_offset(one, stands) is None
    assert storey_offset(cameras, stands[:0]) is None
