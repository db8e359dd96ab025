"""Heights of a storey, and what is none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.evaluation.check.heights import storey_offset
from megloc_kapture.evaluation.check.reference import MapCameras

LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def building(
    heights: np.ndarray | float = 1.5, tilt: Rotation | None = None
) -> tuple[MapCameras, np.ndarray]:
    """Cameras every two metres on a floor, in a world that may be tilted, and places between."""
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
    cameras, places = building(tilt=tilt)
    world = tilt or Rotation.identity()
    found = storey_offset(cameras, world.apply(places + [0, 0, offset]))
    assert found is not None and abs(found - offset) < 0.15
    assert storey_offset(cameras, world.apply(places)) is None
    assert storey_offset(cameras, world.apply(places + [0, 0, 1.0])) is None


def test_a_few_strays_and_infinities_change_nothing() -> None:
    cameras, places = building()
    places = places + [0, 0, 3.0]
    places[:40, 2] -= 3.0
    places[40:45] = np.inf
    found = storey_offset(cameras, places)
    assert found is not None and abs(found - 3.1) < 0.01
    places[:120, 2] = 1.6
    assert storey_offset(cameras, places) is None


def test_a_map_of_both_storeys_has_all_heights() -> None:
    cameras, places = building(np.where(np.arange(200) % 2, 1.5, 5.0))
    assert storey_offset(cameras, places + [0, 0, 3.4]) is None


def test_a_hilly_map_says_nothing() -> None:
    cameras, places = building(np.random.default_rng(0).uniform(0, 8, 200))
    assert storey_offset(cameras, places + [0, 0, 5.0]) is None


def test_maps_that_do_not_know_up_or_have_one_place() -> None:
    cameras, places = building()
    every_way = np.roll(Rotation.random(200, random_state=0).as_quat(), 1, axis=1)
    tumbling = MapCameras(cameras.images, every_way, cameras.centers)
    assert storey_offset(tumbling, places + [0, 0, 3.0]) is None
    one = MapCameras(cameras.images, cameras.quats, np.ones((200, 3)))
    assert storey_offset(one, places) is None
    assert storey_offset(cameras, places[:0]) is None
