"""Nearness to the map's cameras: against distances and angles worked out one by one."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from megloc_kapture.evaluation.check.neighbourhood import Neighbourhood
from megloc_kapture.evaluation.check.reference import MapCameras


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


def test_pools_do_not_see_each_other() -> None:
    own = cameras(40)
    pools = [np.arange(20), np.arange(20, 40), np.array([7])]
    hood = Neighbourhood(own, pools)
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
    pools = np.zeros(9, dtype=np.int64)
    scores = Neighbourhood(own, [np.arange(60)]).look(quats, centers, pools).score
    for scale in (1e-3, 1e4):
        scaled = MapCameras(own.images, own.quats, own.centers * scale)
        hood = Neighbourhood(scaled, [np.arange(60)])
        np.testing.assert_allclose(hood.look(quats, centers * scale, pools).score, scores)


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
