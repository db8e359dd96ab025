"""Turns of the camera from which an alignment begins."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.refinement.photometric import perturbed
from megloc_kapture.refinement.photometric_points import ChosenPoints
from megloc_kapture.refinement.photometric_pyramid import Level
from megloc_kapture.refinement.photometric_search import best_turns, turn_grid
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("OPENCV", 640, 480, (500.0, 505.0, 322.0, 239.0, -0.05, 0.01, 1e-3, 0.0))
HERE = RigidTransform((0.8, 0.6, 0.0, 0.0), (1.0, -2.0, 0.5))


def scene() -> tuple[ChosenPoints, Level]:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.normal(size=(120, 160)), (0, 0), 2.5).astype(np.float32)
    rows, columns = rng.integers(5, 115, 1500), rng.integers(5, 155, 1500)
    rays = bearing_rays(CAMERA, 4.0 * np.stack([columns + 0.5, rows + 0.5], axis=1))
    points = HERE.inverse().apply(rays * rng.uniform(3.0, 8.0, (1500, 1)))
    values = 3.0 * image[rows, columns][:, None].astype(np.float64) + 1.0
    chosen = ChosenPoints(points, values, np.zeros(1500, np.int64))
    return chosen, Level(image[..., None], np.ones((120, 160), bool), 0.25, 0.25)


@pytest.mark.parametrize(
    "turn_deg", [(2.0, 0.0, 0.0), (0.0, -3.0, 0.0), (1.5, 2.0, 1.0), (0.0, 0.0, -3.0)]
)
def test_the_turn_is_found(turn_deg: tuple[float, float, float]) -> None:
    chosen, level = scene()
    start = perturbed(HERE, np.radians([*turn_deg, 0.0, 0.0, 0.0]))
    found = best_turns(chosen, level, CAMERA, start, max_deg=4.0, count=3)
    assert found[0] is start and 2 <= len(found) <= 4
    left = found[1] @ HERE.inverse()
    # within a step of the grid in each direction
    assert np.degrees(2 * np.linalg.norm(left.quat_wxyz[1:])) < 1.3
    np.testing.assert_allclose(found[1].center(), start.center(), atol=1e-9)
    again = best_turns(chosen, level, CAMERA, start, max_deg=4.0, count=3)
    assert again == found


def test_nothing_is_searched_where_nothing_is_asked_for() -> None:
    chosen, level = scene()
    assert best_turns(chosen, level, CAMERA, HERE, max_deg=0.0, count=3) == [HERE]


def test_the_grid_has_no_turn_beyond_the_limit_and_none_at_all() -> None:
    _, level = scene()
    for limit in (1.0, 4.0, 20.0):
        grid = turn_grid(level, CAMERA, limit)
        lengths = np.degrees(np.linalg.norm(grid, axis=1))
        assert lengths[0] == 0.0 and lengths[-1] <= limit + 1e-9
        assert (np.diff(lengths) >= 0).all() and len(grid) < 6000
