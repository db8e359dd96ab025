"""Matches that agree by chance: random ones never count as a pair, true ones do."""

from __future__ import annotations

import numpy as np
import pytest

from megloc_kapture.geometry.cameras import px_from_cam
from megloc_kapture.matching.chance import agree_by_chance
from megloc_kapture.matching.verification import TwoViewOptions, verify_two_view
from megloc_kapture.values import Camera

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
OPTIONS = TwoViewOptions(min_matches=5)


def agreeing(number: int, share: float, seed: int) -> int:
    """Inliers that RANSAC finds among matches of which a share is of one scene."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (number, 3))
    first, second = px_from_cam(CAMERA, points), px_from_cam(CAMERA, points - (0.6, 0.1, 0.2))
    wrong = rng.random(number) >= share
    second[wrong] = rng.uniform((0, 0), (640, 480), (wrong.sum(), 2))
    return int(verify_two_view(first, CAMERA, second, CAMERA, OPTIONS).sum())


@pytest.mark.parametrize("number", [40, 150, 600, 2000])
def test_random_matches_agree_by_chance(number: int) -> None:
    for seed in range(5):
        found = agreeing(number, 0.0, seed)
        assert agree_by_chance(found, number, CAMERA, CAMERA, 4.0), found


@pytest.mark.parametrize(("number", "share"), [(40, 0.8), (150, 0.4), (600, 0.2), (2000, 0.15)])
def test_true_ones_do_not(number: int, share: float) -> None:
    found = agreeing(number, share, seed=1)
    assert not agree_by_chance(found, number, CAMERA, CAMERA, 4.0), found


def test_a_bare_sample_says_nothing() -> None:
    assert agree_by_chance(5, 5, CAMERA, CAMERA, 4.0)
