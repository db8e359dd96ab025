"""Matches that agree by chance: random ones never count as a pair, true ones do."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import px_from_cam
from megloc_kapture.matching.chance import agree_by_chance
from megloc_kapture.matching.verification import TwoViewOptions, verify_two_view
from megloc_kapture.values import Camera

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
OPTIONS = TwoViewOptions(min_matches=5, max_iterations=5000)  # of matches in no order


Pixels = NDArray[np.float64]


def verified(first: Pixels, second: Pixels) -> tuple[Pixels, Camera, Pixels, Camera, int]:
    """What RANSAC keeps of matches, as ``agree_by_chance`` takes it."""
    kept = verify_two_view(first, CAMERA, second, CAMERA, OPTIONS)
    return first[kept], CAMERA, second[kept], CAMERA, len(first)


def of_one_scene(number: int, share: float, seed: int) -> tuple[Pixels, Pixels]:
    """Matches of which a share is of one scene, the others of anything."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (number, 3))
    first, second = px_from_cam(CAMERA, points), px_from_cam(CAMERA, points - (0.6, 0.1, 0.2))
    wrong = rng.random(number) >= share
    second[wrong] = rng.uniform((0, 0), (640, 480), (wrong.sum(), 2))
    return first, second


@pytest.mark.parametrize("number", [40, 150, 600, 2000])
def test_random_matches_agree_by_chance(number: int) -> None:
    for seed in range(5):
        found = verified(*of_one_scene(number, 0.0, seed))
        assert agree_by_chance(*found, OPTIONS), len(found[0])


@pytest.mark.parametrize(("number", "share"), [(40, 0.8), (150, 0.4), (600, 0.2), (2000, 0.15)])
def test_true_ones_do_not(number: int, share: float) -> None:
    found = verified(*of_one_scene(number, share, seed=1))
    assert not agree_by_chance(*found, OPTIONS), len(found[0])


@pytest.mark.parametrize("seed", range(5))
def test_wrong_matches_along_a_shelf(seed: int) -> None:
    """Keypoints in one band: most wrong matches are near the line of a camera that moved along
    it, more than of an image full of keypoints, and still they say nothing."""
    rng = np.random.default_rng(seed)
    first, second = (
        np.column_stack([rng.uniform(0, 640, 200), 240 + rng.normal(0, 4, 200)]) for _ in range(2)
    )
    found = verified(first, second)
    assert len(found[0]) > 60
    assert agree_by_chance(*found, OPTIONS), len(found[0])


def test_a_bare_sample_says_nothing() -> None:
    first, second = of_one_scene(5, 1.0, seed=0)
    assert agree_by_chance(first, CAMERA, second, CAMERA, 5, OPTIONS)
