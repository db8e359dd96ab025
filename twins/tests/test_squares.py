from __future__ import annotations

import numpy as np
import pytest
from megloc_twins.moving_objects import (
    FloorPlan,
    MovingObject,
    Obstacle,
    moving_object_recipes,
    moving_object_surfaces,
)
from megloc_twins.options import SyntheticWorldOptions
from megloc_twins.portable import looking_at
from megloc_twins.rasterization import NO_SURFACE, sample_grid, visible_surfaces
from megloc_twins.squares import Place, build_place

from megloc_kapture.values import Camera

OPTIONS = SyntheticWorldOptions()


@pytest.fixture(scope="module")
def places() -> list[Place]:
    return [build_place(OPTIONS, index) for index in range(OPTIONS.num_places)]


def test_from_the_rigs_path_there_is_no_hole_in_the_walls(places: list[Place]) -> None:
    camera = Camera("SIMPLE_PINHOLE", 64, 48, (32.0, 32.0, 24.0))
    grid = sample_grid(camera, 1)
    for place in places:
        for spot, _ in place.plan.stops(3):
            position = np.array([*spot, 1.9])
            for yaw in np.arange(4) * np.pi / 2:
                seen = visible_surfaces(place.surfaces, looking_at(position, yaw, 0, 0), grid)
                # all that lies below the horizon must be something
                assert (seen.surface[24:] != NO_SURFACE).all()


def test_a_floor_plan_knows_what_is_free() -> None:
    square = np.array([(-5.0, -5.0), (5.0, -5.0), (5.0, 5.0), (-5.0, 5.0)])
    plan = FloorPlan(square, square / 2, (Obstacle(2.0, 0.0, 1.0),))
    assert plan.is_free(-2.0, 0.0, 2.9)
    assert not plan.is_free(-2.0, 0.0, 3.1)  # the obstacle's or the wall's margin
    assert not plan.is_free(2.5, 0.0, 0.1)
    assert not plan.is_free(6.0, 0.0, 0.1)
    assert plan.is_free(3.5, 0.0, 0.4) and not plan.is_free(3.5, 0.0, 0.6)
    assert plan.distance_to_path(0.0, 0.0) == pytest.approx(2.5)


def test_every_mover_is_a_closed_body_of_its_size() -> None:
    for kind, height, width in (("person", 1.76, 0.6), ("car", 1.45, 4.6)):
        item = MovingObject(kind, 1, (3.0, -2.0), 0.7)  # type: ignore[arg-type]
        surfaces = moving_object_surfaces((item,))
        corners = surfaces.corners().reshape(-1, 3)
        assert corners[:, 2].max() == pytest.approx(height, abs=0.01)
        assert np.linalg.norm(corners[:, :2] - item.position, axis=1).max() <= width / 2
        assert surfaces.texture.max() < len(moving_object_recipes(0))
        # seen from outside, normals point away from its axis
        sides = np.abs(surfaces.normals()[:, 2]) < 0.5
        middle = corners.reshape(-1, 4, 3).mean(1)[sides, :2] - item.position
        assert ((surfaces.normals()[sides, :2] * middle).sum(1) > 0).all()
    assert len(moving_object_surfaces(())) == 0
