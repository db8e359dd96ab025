from __future__ import annotations

import hashlib
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions
from megloc_kapture.datasets.synthetic.world import SyntheticWorld, build_world
from megloc_kapture.datasets.synthetic.writing import depth_name, write_synthetic_kapture
from megloc_kapture.io.dataset_tables import read_groups, read_protocol, read_world
from megloc_kapture.io.images import read_depth_map, read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder, to_kapture

SMALL = SyntheticWorldOptions(
    num_places=2,
    stations_per_place=4,
    day_queries=2,
    night_queries=2,
    width=160,
    height=120,
    supersampling=1,
    depth=True,
    masks=True,
)


def hashes(root: Path) -> dict[str, str]:
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def world() -> SyntheticWorld:
    return build_world(SMALL)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("synthetic") / "world"
    counts = write_synthetic_kapture(root, SMALL)
    assert counts == {"places": 2, "mapping images": 24, "query images": 4}
    return root


def test_what_is_written_is_the_world(root: Path, world: SyntheticWorld) -> None:
    mapping, query, truth = (KaptureFolder(root / f) for f in ("mapping", "query", "query_gt"))
    mapping.validate(deep=True)
    query.validate(deep=True)
    assert mapping.read().image_names() == [shot.name for shot in world.mapping]
    assert list(mapping.read().rigs) == ["rig"]
    assert {device for _, device in mapping.read().trajectories} == {"rig"}
    assert query.read().image_names() == truth.read().image_names()
    assert not query.read().trajectories
    for folder, shots in ((mapping, world.mapping), (truth, world.queries)):
        poses = folder.read().poses()
        assert len(poses) == len(shots)
        for shot in shots:
            assert folder.read().camera_of(shot.name) == shot.camera
            np.testing.assert_allclose(
                poses[shot.name].rotation_matrix(),
                shot.cam_from_world.rotation_matrix(),
                atol=1e-12,
            )
            np.testing.assert_allclose(
                poses[shot.name].translation, shot.cam_from_world.translation, atol=1e-9
            )
    for folder, shots in ((mapping, world.mapping), (query, world.queries)):
        for shot in shots:
            assert read_image_rgb(folder.image_path(shot.name)).shape == (120, 160, 3)


def test_depth_and_masks(root: Path, world: SyntheticWorld) -> None:
    data = KaptureFolder(root / "mapping").read()
    assert len(data.records_depth) == len(world.mapping)
    for shot in world.mapping:
        assert data.records_depth[shot.timestamp, f"{shot.sensor_id}_depth"] == depth_name(
            shot.name
        )
        pose = data.device_from_world(shot.timestamp, f"{shot.sensor_id}_depth")
        assert pose == data.cam_from_world(shot.name)
        path = root / "mapping/sensors/records_data" / depth_name(shot.name)
        depth = read_depth_map(path, width=160, height=120)
        assert 0.5 < np.median(depth) < 20
        mask_path = root / "mapping/sensors/masks" / f"{shot.name}.png"
        assert mask_path.exists() == shot.bonnet
        if shot.bonnet:
            mask = read_image_rgb(mask_path)[..., 0]
            assert set(np.unique(mask)) == {0, 255}
            assert (depth[mask == 0] == 0).all()


def test_side_tables(root: Path, world: SyntheticWorld) -> None:
    groups = read_groups(root / "megloc")
    assert {name: g.condition for name, g in groups.items()} == {
        shot.name: shot.condition for shot in world.queries
    }
    assert {g.location for g in groups.values()} == {"place0", "place1"}
    protocol = read_protocol(root / "megloc")
    assert protocol.dataset == "synthetic"
    assert protocol.conditions == ("day", "night")
    assert protocol.thresholds == ((0.05, 5), (0.25, 2), (0.5, 5), (5, 10))
    assert read_world(root / "megloc").unit == "m"


def test_kapture_itself_reads_it(root: Path, world: SyntheticWorld) -> None:
    from kapture.io.csv import kapture_from_dir

    theirs = kapture_from_dir(str(root / "mapping"))
    ours = to_kapture(root / "mapping")
    assert theirs.records_camera == ours.records_camera
    assert theirs.sensors.keys() == ours.sensors.keys()
    assert len(theirs.records_depth) == len(ours.records_depth)
    assert len(theirs.trajectories) == len(world.rig_from_world)


def test_processes_write_the_same_bytes(root: Path, tmp_path: Path) -> None:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        write_synthetic_kapture(tmp_path, SMALL, executor)
    assert hashes(tmp_path) == hashes(root)


@pytest.mark.parametrize(
    "wrong", [{"num_places": 0}, {"supersampling": 9}, {"image_format": "gif"}, {"colour": "red"}]
)
def test_wrong_options_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        SyntheticWorldOptions(**wrong)  # type: ignore[arg-type]
