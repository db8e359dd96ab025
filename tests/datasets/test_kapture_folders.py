"""Any pair of kapture folders as a dataset: checked, written anew, images linked."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.datasets.kapture_folders import (
    import_kapture_folders,
    input_files,
)
from megloc_kapture.errors import DataError
from megloc_kapture.io import dataset_tables as tables
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("SIMPLE_PINHOLE", 8, 6, (10.0, 4.0, 3.0))


def write_part(
    root: Path, part: str, names: Sequence[str], *, poses: bool, images: bool = True
) -> None:
    data = KaptureData(sensors={"cam": Sensor.from_camera(CAMERA)})
    for timestamp, name in enumerate(names):
        data.records_camera[timestamp, "cam"] = name
        if poses:
            data.trajectories[timestamp, "cam"] = RigidTransform.identity()
        if images:
            path = root / part / "sensors" / "records_data" / name
            write_image(path, np.full((6, 8, 3), 99, np.uint8))
    write_sensors(root / part, data)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two map images, two queries, their truth."""
    place = tmp_path / "root"
    write_part(place, "mapping", ["a.png", "b/c.png"], poses=True)
    write_part(place, "query", ["b/q.png", "r.png"], poses=True)
    write_part(place, "query_gt", ["b/q.png", "r.png"], poses=True, images=False)
    return place


def test_what_is_imported(root: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    out = tmp_path / "out"
    counts = {"map_images": 2, "map_images_with_pose": 2, "queries": 2, "queries_with_truth": 2}
    assert import_kapture_folders(root, out) == counts
    mapping, query = KaptureFolder(out / "mapping"), KaptureFolder(out / "query")
    assert mapping.read().poses().keys() == {"a.png", "b/c.png"}
    assert query.read().image_names() == ["b/q.png", "r.png"]
    # the queries' poses are nobody's business but the evaluation's
    assert query.read().poses() == {}
    assert len(KaptureFolder(out / "query_gt").read().poses()) == 2
    images = root / "mapping/sensors/records_data"
    assert (out / "mapping/sensors/records_data").readlink() == images
    assert query.image_path("b/q.png").is_file()
    assert tables.read_protocol(out / "megloc") == tables.Protocol()
    assert sorted(path.name for path in (out / "megloc").iterdir()) == ["protocol.json"]
    write_part(root, "query_gt", ["b/q.png", "s.png"], poses=True, images=False)
    assert import_kapture_folders(root, tmp_path / "c") == counts | {"queries_with_truth": 1}
    assert "query_gt: true poses of 1 images that are not queries" in caplog.text
    (root / "query_gt/sensors/sensors.txt").unlink()
    assert import_kapture_folders(root, tmp_path / "b") == counts | {"queries_with_truth": 0}
    assert not (tmp_path / "b" / "query_gt").exists()


@pytest.mark.parametrize("prefix", ["", "q"])
def test_queries_keep_their_depth_and_masks(root: Path, tmp_path: Path, prefix: str) -> None:
    data = KaptureFolder(root / "query").read()
    data.sensors["depth"] = Sensor.from_camera(CAMERA, sensor_type="depth")
    data.rigs["rig"] = {name: RigidTransform.identity() for name in ("cam", "depth")}
    data.records_depth[0, "depth"] = "b/q.depth"
    write_sensors(root / "query", data)
    sensors = root / "query/sensors"
    depth, mask = sensors / "records_data/b/q.depth", sensors / "masks/r.png.png"
    before = set(input_files(root))
    depth.write_bytes(np.ones((6, 8), np.float32).tobytes())
    write_image(mask, np.zeros((6, 8), np.uint8))
    # another depth map is another data set
    assert set(input_files(root)) - before == {depth, mask}
    import_kapture_folders(root, tmp_path / "out", query_prefix=prefix)
    query = KaptureFolder(tmp_path / "out" / "query")
    (name,) = query.read().records_depth.values()
    assert query.depth_path(name).read_bytes() == depth.read_bytes()
    there = query.root / "sensors" / "masks" / prefix / "r.png.png"
    assert there.read_bytes() == mask.read_bytes()
    assert query.read().poses() == {}
    assert KaptureFolder(tmp_path / "out" / "query_gt").read().records_depth == {}


def test_side_tables_come_along(root: Path, tmp_path: Path) -> None:
    given, out = root / "megloc", tmp_path / "out" / "megloc"
    of_map = tables.ImageGroup(frame="f")
    of_query = tables.ImageGroup(condition="night", scored=False)
    moved = tables.SimilarityTransform(translation=(1.0, 2.0, 3.0))
    world = tables.World(official_from_local=moved)
    tables.write_groups(given, {"a.png": of_map, "r.png": of_query})
    tables.write_priors(given, {"r.png": ["a.png"]})
    tables.write_names(given, {"r.png": "R"})
    tables.write_relocalization(given, [tables.RelocalizationPair("x.txt", "a.png", "r.png")])
    tables.write_world(given, world)
    protocol = tables.Protocol(dataset="mine", thresholds=((1.0, 2.0),))
    tables.write_protocol(given, protocol)
    change = {"conditions": ("night",)}
    import_kapture_folders(
        root,
        tmp_path / "out",
        query_prefix="q",
        protocol_change=lambda given: given.model_copy(update=change),
    )
    assert tables.read_groups(out) == {"a.png": of_map, "q/r.png": of_query}
    assert tables.read_priors(out) == {"q/r.png": ("a.png",)}
    assert tables.read_names(out) == {"q/r.png": "R"}
    assert tables.read_relocalization(out) == [
        tables.RelocalizationPair("x.txt", "a.png", "q/r.png")
    ]
    assert tables.read_world(out) == world
    assert tables.read_protocol(out) == protocol.model_copy(update=change)


def test_equal_names_are_refused_or_prefixed(root: Path, tmp_path: Path) -> None:
    write_part(root, "query", ["a.png", "r.png"], poses=False)
    write_part(root, "query_gt", ["a.png", "r.png"], poses=True, images=False)
    night = tables.ImageGroup(condition="night")
    tables.write_groups(root / "megloc", {"a.png": night})
    out = tmp_path / "out"
    with pytest.raises(DataError, match=r"root: 1 images .* the first is a\.png; .*--query-prefix"):
        import_kapture_folders(root, out)
    import_kapture_folders(root, out, query_prefix="some/where/")
    query = KaptureFolder(out / "query")
    assert query.read().image_names() == ["some/where/a.png", "some/where/r.png"]
    assert query.image_path("some/where/a.png").is_file()
    truth = KaptureFolder(out / "query_gt").read()
    assert truth.poses().keys() == {"some/where/a.png", "some/where/r.png"}
    # the table cannot tell which of the two it means
    assert tables.read_groups(out / "megloc") == {"a.png": night, "some/where/a.png": night}


@pytest.mark.parametrize(
    ("part", "names", "message"),
    [
        ("mapping", ["a.png"], r"root/mapping: no mapping image has a pose"),
        ("query", [], r"root/query: there are no query images"),
    ],
)
def test_too_little_is_refused(
    root: Path, tmp_path: Path, part: str, names: list[str], message: str
) -> None:
    shutil.rmtree(root / part)
    write_part(root, part, names, poses=False)
    with pytest.raises(DataError, match=message):
        import_kapture_folders(root, tmp_path / "out")


def test_every_file_an_import_reads_counts(root: Path) -> None:
    write_image(root / "query/sensors/masks/r.png.png", np.zeros((6, 8), np.uint8))
    tables.write_priors(root / "megloc", {"r.png": ["a.png"]})
    read = {path for path in root.rglob("*") if path.is_file()}
    (root / "notes.txt").write_text("no input")
    found = list(input_files(root))
    assert set(found) == read and len(found) == len(read)
