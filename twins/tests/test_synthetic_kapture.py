"""The synthetic world: its views and its files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from kapture.io.csv import kapture_from_dir
from megloc_twins.options import SyntheticWorldOptions
from megloc_twins.synthetic_kapture import SyntheticWorld, build_world, depth_name
from megloc_twins.viewpoints import overlap, support, views_of

from megloc_kapture.io.dataset_tables import read_side_tables
from megloc_kapture.io.images import read_depth_map, read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import RigidTransform

LAYOUT = "synthetic"


def assert_same(result: RigidTransform, expected: RigidTransform) -> None:
    rotations = result.rotation_matrix(), expected.rotation_matrix()
    np.testing.assert_allclose(*rotations, atol=1e-12)
    np.testing.assert_allclose(result.translation, expected.translation, atol=1e-9)


def test_queries_have_their_own_cameras_and_moving_objects(world: SyntheticWorld) -> None:
    assert len({frame.camera.params for frame in world.queries}) == len(world.queries)
    assert all(frame.camera.model == "SIMPLE_RADIAL" for frame in world.queries)
    assert all(frame.moving_objects for frame in world.queries)
    spots = {m.position for frame in world.queries for m in frame.moving_objects}
    assert not spots & {m.position for frame in world.mapping for m in frame.moving_objects}


def test_every_query_shares_its_view_with_the_map_of_its_place_only(world: SyntheticWorld) -> None:
    for place in world.places:
        here = views_of(place, [m for m in world.mapping if m.place == place.index])
        for view in views_of(place, [q for q in world.queries if q.place == place.index]):
            assert max(overlap(view, other) for other in here) < 0.9
            assert support(view, here) > 0.5
    # walls surround places, so that a gap between them hides one from the other
    first, second = (place.place_from_world.inverse().translation for place in world.places)
    assert np.linalg.norm(np.subtract(first, second)) > 60


def test_the_same_options_give_the_same_world_and_others_another() -> None:
    # fewer stations support hardly a query, so that many are tried
    size = {"width": 160, "height": 120, "stations_per_place": 9}
    options = SyntheticWorldOptions(num_places=1, day_queries=2, night_queries=1, **size)

    def changed(**update: object) -> SyntheticWorld:
        return build_world(options.model_copy(update=update))

    few, more = build_world(options), changed(day_queries=3)
    # more queries leave the others as they are
    assert more.mapping == few.mapping and set(few.queries) < set(more.queries)
    other = changed(seed=1, moving_objects=0)
    assert other.mapping[0].cam_from_world != few.mapping[0].cam_from_world
    assert not any(frame.moving_objects for frame in other.frames())


def test_what_is_written_is_the_world(root: Path, world: SyntheticWorld) -> None:
    mapping, query, truth = (KaptureFolder(root / f) for f in ("mapping", "query", "query_gt"))
    mapping.validate(deep=True)
    query.validate(deep=True)
    assert mapping.read().image_names() == [frame.name for frame in world.mapping]
    assert list(mapping.read().rigs) == ["rig"]
    assert {device for _, device in mapping.read().trajectories} == {"rig"}
    assert query.read().image_names() == truth.read().image_names()
    assert not query.read().trajectories
    for folder, frames in ((mapping, world.mapping), (truth, world.queries)):
        poses = folder.read().poses()
        assert len(poses) == len(frames)
        for frame in frames:
            assert folder.read().camera_of(frame.name) == frame.camera
            assert_same(poses[frame.name], frame.cam_from_world)
    for folder, frames in ((mapping, world.mapping), (query, world.queries)):
        for frame in frames:
            assert read_image_rgb(folder.image_path(frame.name)).shape == (120, 160, 3)
    theirs = kapture_from_dir(str(root / "mapping"))
    ours = mapping.read()
    records = theirs.records_camera
    assert {key: records[key] for key in records.key_pairs()} == ours.records_camera
    assert theirs.sensors.keys() == ours.sensors.keys()
    assert len(theirs.records_depth.key_pairs()) == len(ours.records_depth)
    assert len(theirs.trajectories) == len(world.rig_from_world)
    # side tables
    tables = read_side_tables(root / "megloc")
    groups, protocol = tables.groups, tables.protocol
    conditions = {frame.name: frame.condition for frame in world.queries}
    assert {name: group.condition for name, group in groups.items()} == conditions
    assert {group.location for group in groups.values()} == {"place0", "place1"}
    assert (protocol.dataset, protocol.conditions) == ("synthetic", ("day", "night"))
    assert protocol.thresholds == ((0.05, 5), (0.25, 2), (0.5, 5), (5, 10))
    assert tables.world.unit == "m"


def test_depth_and_masks(root: Path, world: SyntheticWorld) -> None:
    data = KaptureFolder(root / "mapping").read()
    assert len(data.records_depth) == len(world.mapping)
    for frame in world.mapping:
        sensor = f"{frame.sensor_id}_depth"
        assert data.records_depth[frame.timestamp, sensor] == depth_name(frame.name)
        pose = data.device_from_world(frame.timestamp, sensor)
        assert pose == data.cam_from_world(frame.name)
        path = root / "mapping/sensors/records_data" / depth_name(frame.name)
        depth = read_depth_map(path, width=160, height=120)
        assert 0.5 < np.median(depth) < 20
        mask_path = root / "mapping/sensors/masks" / f"{frame.name}.png"
        assert mask_path.exists() == frame.bonnet
        if frame.bonnet:
            mask = read_image_rgb(mask_path)[..., 0]
            assert set(np.unique(mask)) == {0, 255}
            assert (depth[mask == 0] == 0).all()
