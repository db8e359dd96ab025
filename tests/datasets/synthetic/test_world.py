from __future__ import annotations

import numpy as np
import pytest

from megloc_kapture.datasets.synthetic.covisibility import coarse_view, overlap, support
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions
from megloc_kapture.datasets.synthetic.world import SyntheticWorld, build_world
from megloc_kapture.values import RigidTransform


@pytest.fixture(scope="module")
def world() -> SyntheticWorld:
    return build_world()


@pytest.mark.slow
def test_the_default_world_is_real_work(world: SyntheticWorld) -> None:
    assert len(world.mapping) >= 80
    assert len(world.queries) >= 40
    assert len({shot.place for shot in world.queries}) >= 3
    assert {shot.condition for shot in world.queries} == {"day", "night"}
    assert all(s.camera.width >= 640 and s.camera.height >= 480 for s in world.shots())
    names = [shot.name for shot in world.shots()]
    assert len(set(names)) == len(names)
    assert names == sorted(names, key=lambda name: (name.startswith("query"), name))
    records = {(shot.timestamp, shot.sensor_id) for shot in world.shots()}
    assert len(records) == len(names)


def test_queries_have_their_own_cameras_and_moving_objects(world: SyntheticWorld) -> None:
    assert len({shot.camera.params for shot in world.queries}) == len(world.queries)
    assert all(shot.camera.model == "SIMPLE_RADIAL" for shot in world.queries)
    assert all(shot.movers for shot in world.queries)
    spots = {m.position for shot in world.queries for m in shot.movers}
    assert not spots & {m.position for shot in world.mapping for m in shot.movers}
    assert any(m.kind == "car" for shot in world.shots() for m in shot.movers)


def test_every_query_shares_its_view_with_the_map_of_its_place_only(world: SyntheticWorld) -> None:
    views = world.coarse_views()
    for query in world.queries:
        shares = {m.name: overlap(views[query.name], views[m.name]) for m in world.mapping}
        here = [views[m.name] for m in world.mapping if m.place == query.place]
        assert max(shares.values()) < 0.9
        assert support(views[query.name], here) > 0.5
        assert all(shares[m.name] == 0 for m in world.mapping if m.place != query.place)


def test_queries_stand_elsewhere_than_the_map_images(world: SyntheticWorld) -> None:
    map_centers = np.array([shot.cam_from_world.center() for shot in world.mapping])
    gaps = [
        np.linalg.norm(map_centers - shot.cam_from_world.center(), axis=1).min()
        for shot in world.queries
    ]
    assert np.median(gaps) > 0.8


def test_poses_of_the_map_are_those_of_the_rig(world: SyntheticWorld) -> None:
    assert len(world.rig_from_world) * 3 == len(world.mapping)
    for shot in world.mapping:
        expected = world.sensor_from_rig[shot.sensor_id] @ world.rig_from_world[shot.timestamp]
        np.testing.assert_allclose(
            shot.cam_from_world.rotation_matrix(), expected.rotation_matrix(), atol=1e-12
        )
        np.testing.assert_allclose(shot.cam_from_world.translation, expected.translation, atol=1e-9)
    offsets = [pose.center() for pose in world.sensor_from_rig.values()]
    assert max(np.linalg.norm(a - b) for a in offsets for b in offsets) > 0.5


def test_the_same_options_give_the_same_world() -> None:
    options = SyntheticWorldOptions(num_places=2, day_queries=2, night_queries=2)
    first, second = build_world(options), build_world(options)
    assert first.shots() == second.shots()
    assert first.shots() != build_world(options.model_copy(update={"seed": 1})).shots()


def test_more_queries_leave_the_others_as_they_are() -> None:
    few = build_world(SyntheticWorldOptions(num_places=1, day_queries=2, night_queries=1))
    more = build_world(SyntheticWorldOptions(num_places=1, day_queries=3, night_queries=1))
    assert more.mapping == few.mapping
    assert set(few.queries) < set(more.queries)


def test_without_extras() -> None:
    options = SyntheticWorldOptions(
        num_places=1,
        day_queries=1,
        night_queries=0,
        moving_objects=0,
        bonnet=False,
        distortion=False,
    )
    world = build_world(options)
    assert not any(shot.movers or shot.bonnet for shot in world.shots())
    assert world.queries[0].camera.model == "SIMPLE_PINHOLE"


def test_overlap_is_whole_with_itself_and_none_behind(world: SyntheticWorld) -> None:
    shot = world.mapping[0]
    views = world.coarse_views()
    assert overlap(views[shot.name], views[shot.name]) > 0.97
    opposite = RigidTransform((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0)) @ shot.cam_from_world
    surfaces = world.places[shot.place].surfaces_in_world()
    behind = coarse_view(surfaces, shot.camera, opposite)
    assert overlap(views[shot.name], behind) == 0
    assert support(views[shot.name], [behind, behind]) == 0
    assert support(views[shot.name], []) == 0
