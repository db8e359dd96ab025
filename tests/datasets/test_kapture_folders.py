"""Kapture folders of a dataset: of the user's folders, or of the records of any adapter."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.datasets.kapture_folders import import_kapture_folders, input_files
from megloc_kapture.datasets.official import OfficialDataset, read_ground_truth, write_official
from megloc_kapture.errors import DataError
from megloc_kapture.io import dataset_tables as tables
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.values import RigidTransform
from tests.worlds import SMALL_CAMERA, one_camera


def write_part(
    root: Path, part: str, names: Sequence[str], *, poses: bool, images: bool = True
) -> None:
    write_sensors(root / part, one_camera(names, RigidTransform.identity() if poses else None))
    for name in names if images else ():
        path = root / part / "sensors" / "records_data" / name
        write_image(path, np.full((6, 8, 3), 99, np.uint8))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two map images, two queries, their truth."""
    place = tmp_path / "root"
    write_part(place, "mapping", ["a.png", "b/c.png"], poses=True)
    write_part(place, "query", ["b/q.png", "r.png"], poses=True)
    write_part(place, "query_gt", ["b/q.png", "r.png"], poses=True, images=False)
    return place


def test_folders_are_written_with_links_to_the_images_and_without_poses_of_queries(
    root: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    counts = {"map_images": 2, "map_images_with_pose": 2, "queries": 2, "queries_with_truth": 2}
    assert import_kapture_folders(root, out) == counts
    mapping, query = KaptureFolder(out / "mapping"), KaptureFolder(out / "query")
    assert mapping.read().poses().keys() == {"a.png", "b/c.png"}
    assert query.read().image_names() == ["b/q.png", "r.png"]
    # poses of queries are for the evaluation only
    assert query.read().poses() == {}
    assert len(KaptureFolder(out / "query_gt").read().poses()) == 2
    images = root / "mapping/sensors/records_data"
    assert (out / "mapping/sensors/records_data").readlink() == images
    assert query.image_path("b/q.png").is_file()
    assert tables.read_side_tables(out / "megloc").protocol == tables.Protocol()
    assert sorted(path.name for path in (out / "megloc").iterdir()) == ["protocol.json"]


def test_truth_is_optional_and_may_have_other_images(
    root: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_part(root, "query_gt", ["b/q.png", "s.png"], poses=True, images=False)
    assert import_kapture_folders(root, tmp_path / "a")["queries_with_truth"] == 1
    assert "query_gt: true poses of 1 images that are not queries" in caplog.text
    assert KaptureFolder(tmp_path / "a" / "query_gt").read().poses().keys() == {"b/q.png"}
    (root / "query_gt/sensors/sensors.txt").unlink()
    assert import_kapture_folders(root, tmp_path / "b")["queries_with_truth"] == 0
    assert not (tmp_path / "b" / "query_gt").exists()
    assert "query: its poses are ignored; true poses belong in query_gt/" in caplog.text


@pytest.mark.parametrize("prefix", ["", "q"])
def test_queries_keep_their_depth_and_masks(root: Path, tmp_path: Path, prefix: str) -> None:
    data = KaptureFolder(root / "query").read()
    data.sensors["depth"] = Sensor.from_camera(SMALL_CAMERA, sensor_type="depth")
    data.rigs["rig"] = {name: RigidTransform.identity() for name in ("cam", "depth")}
    data.records_depth[0, "depth"] = "b/q.depth"
    write_sensors(root / "query", data)
    sensors = root / "query/sensors"
    depth, mask = sensors / "records_data/b/q.depth", sensors / "masks/r.png.png"
    depth.write_bytes(np.ones((6, 8), np.float32).tobytes())
    write_image(mask, np.zeros((6, 8), np.uint8))
    import_kapture_folders(root, tmp_path / "out", query_prefix=prefix)
    query = KaptureFolder(tmp_path / "out" / "query")
    (name,) = query.read().records_depth.values()
    assert query.depth_path(name).read_bytes() == depth.read_bytes()
    copy = query.root / "sensors" / "masks" / prefix / "r.png.png"
    assert copy.read_bytes() == mask.read_bytes()
    assert query.read().poses() == {}
    assert KaptureFolder(tmp_path / "out" / "query_gt").read().records_depth == {}


def test_side_tables_are_imported_with_prefixed_queries(root: Path, tmp_path: Path) -> None:
    given, out = root / "megloc", tmp_path / "out" / "megloc"
    of_map = tables.ImageGroup(frame="f")
    of_query = tables.ImageGroup(condition="night", scored=False)
    moved = tables.SimilarityTransform(translation=(1.0, 2.0, 3.0))
    world = tables.World(official_from_local=moved)
    protocol = tables.Protocol(dataset="mine", thresholds=((1.0, 2.0),))
    listed = tables.SideTables(
        protocol=protocol,
        groups={"a.png": of_map, "r.png": of_query},
        priors={"r.png": ["a.png"]},
        names={"r.png": "R"},
        relocalization=[tables.RelocalizationPair("x.txt", "a.png", "r.png")],
        world=world,
    )
    tables.write_side_tables(given, listed)
    import_kapture_folders(root, tmp_path / "out", query_prefix="q")
    imported = tables.read_side_tables(out)
    assert imported.groups == {"a.png": of_map, "q/r.png": of_query}
    assert imported.priors == {"q/r.png": ("a.png",)}
    assert imported.names == {"q/r.png": "R"}
    assert imported.relocalization == [tables.RelocalizationPair("x.txt", "a.png", "q/r.png")]
    assert imported.world == world and imported.protocol == protocol


def test_equal_names_of_map_and_queries_need_a_prefix(root: Path, tmp_path: Path) -> None:
    write_part(root, "query", ["a.png", "r.png"], poses=False)
    write_part(root, "query_gt", ["a.png", "r.png"], poses=True, images=False)
    night = tables.ImageGroup(condition="night")
    tables.write_side_tables(root / "megloc", tables.SideTables(groups={"a.png": night}))
    out = tmp_path / "out"
    with pytest.raises(DataError, match=r"root: 1 images .* the first is a\.png; .*--query-prefix"):
        import_kapture_folders(root, out)
    import_kapture_folders(root, out, query_prefix="some/where/")
    query = KaptureFolder(out / "query")
    assert query.read().image_names() == ["some/where/a.png", "some/where/r.png"]
    assert query.image_path("some/where/a.png").is_file()
    truth = KaptureFolder(out / "query_gt").read()
    assert truth.poses().keys() == {"some/where/a.png", "some/where/r.png"}
    # the table applies to both images of the name
    imported = tables.read_side_tables(out / "megloc")
    assert imported.groups == {"a.png": night, "some/where/a.png": night}


@pytest.mark.parametrize(
    ("part", "names", "poses", "message"),
    [
        ("mapping", ["a.png"], False, "root/mapping: no image has a pose"),
        ("query", [], False, "root/query: there are no query images"),
        ("query", ["b/q.png"], False, "root/query/sensors/records_data: no such folder"),
        ("query_gt", ["b/q.jpg", "r.jpg"], True, "none of its 2 .*b/q.jpg.* is a query .*b/q.png"),
        ("query_gt", ["b/q.png"], False, "query_gt: no image has a pose: sensors/trajectories.txt"),
    ],
)
def test_unusable_parts_are_refused(
    root: Path, tmp_path: Path, part: str, names: list[str], poses: bool, message: str
) -> None:
    shutil.rmtree(root / part)
    write_part(root, part, names, poses=poses, images=part == "mapping")
    with pytest.raises(DataError, match=message):
        import_kapture_folders(root, tmp_path / "out")


def test_the_input_files_are_all_files_that_an_import_reads(root: Path) -> None:
    write_image(root / "query/sensors/masks/r.png.png", np.zeros((6, 8), np.uint8))
    tables.write_side_tables(root / "megloc", tables.SideTables(priors={"r.png": ["a.png"]}))
    read = {path for path in root.rglob("*") if path.is_file()}
    (root / "notes.txt").write_text("no input")
    files = list(input_files(root))
    assert set(files) == read and len(files) == len(read)


POSE = RigidTransform((0.5, 0.5, -0.5, 0.5), (1.0, 2.0, 3.0))


@pytest.fixture
def dataset(tmp_path: Path) -> OfficialDataset:
    """Two map images and a query below one folder."""
    images = tmp_path / "official" / "images"
    for name in ("db/1.jpg", "db/2.jpg", "query/3.jpg"):
        (images / name).parent.mkdir(parents=True, exist_ok=True)
        (images / name).write_bytes(name.encode())
    return OfficialDataset(
        mapping=one_camera(["db/1.jpg", "db/2.jpg"], POSE),
        query=one_camera(["query/3.jpg"]),
        links={"": images},
        protocol=tables.Protocol(dataset="toy"),
    )


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"mapping": one_camera(["db/1.jpg"])}, "no mapping image with a pose is left"),
        ({"query": KaptureData()}, "no query image is left"),
        ({"query": one_camera(["db/2.jpg"])}, "'db/2.jpg' is both a map image and a query"),
    ],
)
def test_a_dataset_without_map_or_queries_or_with_shared_images_is_refused(
    dataset: OfficialDataset, tmp_path: Path, part: dict[str, KaptureData], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        write_official(replace(dataset, **part), tmp_path / "out")  # type: ignore[arg-type]


def test_additional_truth_is_converted_to_the_local_frame(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    moved = tables.SimilarityTransform(quat_wxyz=(0.5, 0.5, 0.5, 0.5), translation=(4e6, 1e6, -2e6))
    world = tables.World(official_from_local=moved)
    assert read_ground_truth(tmp_path, one_camera(["q/1.jpg"]), world) == (None, {})
    truth = tmp_path / "ground_truth"
    write_sensors(truth / "query", one_camera(["q/1.jpg", "q/2.jpg"], POSE))
    of_truth = {"q/1.jpg": tables.ImageGroup(condition="DUC1")}
    tables.write_side_tables(truth / "megloc", tables.SideTables(groups=of_truth))
    poses, groups = read_ground_truth(tmp_path, one_camera(["q/0.jpg", "q/1.jpg"]), world)
    assert poses is not None and list(poses.poses()) == ["q/1.jpg"]
    assert groups == of_truth
    back = world.pose_in_official(poses.poses()["q/1.jpg"])
    np.testing.assert_allclose(back.center(), POSE.center(), atol=1e-6)
    np.testing.assert_allclose(back.quat_wxyz, POSE.quat_wxyz, atol=1e-12)
    assert "true poses of 1 images that are not queries are left out" in caplog.text
