"""Any pair of kapture folders as a dataset: checked, written anew, images linked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.datasets.kapture_folders import (
    check_root,
    import_kapture_folders,
    input_files,
    prefixed,
)
from megloc_kapture.errors import DataError
from megloc_kapture.io.dataset_tables import (
    ImageGroup,
    Protocol,
    RelocalizationPair,
    SimilarityTransform,
    World,
    read_groups,
    read_names,
    read_priors,
    read_protocol,
    read_relocalization,
    read_world,
    write_groups,
    write_names,
    write_priors,
    write_protocol,
    write_relocalization,
    write_world,
)
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("SIMPLE_PINHOLE", 8, 6, (10.0, 4.0, 3.0))


def write_part(
    root: Path, part: str, names: Sequence[str], *, poses: bool, images: bool = True
) -> None:
    keys = [(timestamp, "cam") for timestamp in range(len(names))]
    data = KaptureData(
        sensors={"cam": Sensor.from_camera(CAMERA)},
        rigs={},
        trajectories={key: RigidTransform.identity() for key in keys} if poses else {},
        records_camera=dict(zip(keys, names, strict=True)),
        records_depth={},
    )
    write_sensors(root / part, data)
    for name in names if images else ():
        write_image(
            root / part / "sensors" / "records_data" / name, np.full((6, 8, 3), 99, np.uint8)
        )


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two map images, two queries, their truth."""
    place = tmp_path / "root"
    write_part(place, "mapping", ["a.png", "b/c.png"], poses=True)
    write_part(place, "query", ["b/q.png", "r.png"], poses=True)
    write_part(place, "query_gt", ["b/q.png", "r.png"], poses=True, images=False)
    return place


def test_what_is_imported(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    counts = import_kapture_folders(root, out)
    assert counts == {
        "map_images": 2,
        "map_images_with_pose": 2,
        "queries": 2,
        "queries_with_truth": 2,
    }
    mapping, query = KaptureFolder(out / "mapping"), KaptureFolder(out / "query")
    assert mapping.read().poses().keys() == {"a.png", "b/c.png"}
    assert query.read().image_names() == ["b/q.png", "r.png"]
    # the queries' poses are nobody's business but the evaluation's
    assert query.read().poses() == {}
    assert len(KaptureFolder(out / "query_gt").read().poses()) == 2
    assert (out / "mapping/sensors/records_data").readlink() == (
        root / "mapping/sensors/records_data"
    )
    assert query.image_path("b/q.png").is_file()
    assert read_protocol(out / "megloc") == Protocol()
    assert sorted(path.name for path in (out / "megloc").iterdir()) == ["protocol.json"]


@pytest.mark.parametrize("prefix", ["", "q"])
def test_queries_keep_their_depth(root: Path, tmp_path: Path, prefix: str) -> None:
    data = KaptureFolder(root / "query").read()
    data.sensors["depth"] = Sensor.from_camera(CAMERA, sensor_type="depth")
    data.rigs["rig"] = {name: RigidTransform.identity() for name in ("cam", "depth")}
    data.records_depth[0, "depth"] = "b/q.depth"
    write_sensors(root / "query", data)
    depth = root / "query/sensors/records_data/b/q.depth"
    before = set(input_files(root))
    depth.write_bytes(np.ones((6, 8), np.float32).tobytes())
    # another depth map is another data set
    assert set(input_files(root)) - before == {depth}
    import_kapture_folders(root, tmp_path / "out", query_prefix=prefix)
    query = KaptureFolder(tmp_path / "out" / "query")
    (name,) = query.read().records_depth.values()
    assert query.depth_path(name).read_bytes() == depth.read_bytes()
    assert query.read().poses() == {}
    assert KaptureFolder(tmp_path / "out" / "query_gt").read().records_depth == {}


def test_without_truth(root: Path, tmp_path: Path) -> None:
    (root / "query_gt/sensors/sensors.txt").unlink()
    assert import_kapture_folders(root, tmp_path / "out")["queries_with_truth"] == 0
    assert not (tmp_path / "out" / "query_gt").exists()


def test_side_tables_come_along(root: Path, tmp_path: Path) -> None:
    tables = root / "megloc"
    groups = {"a.png": ImageGroup(frame="f"), "r.png": ImageGroup(condition="night", scored=False)}
    world = World(official_from_local=SimilarityTransform(translation=(1.0, 2.0, 3.0)))
    write_groups(tables, groups)
    write_priors(tables, {"r.png": ["a.png"]})
    write_names(tables, {"r.png": "R"})
    write_relocalization(tables, [RelocalizationPair("x.txt", "a.png", "r.png")])
    write_world(tables, world)
    write_protocol(tables, Protocol(dataset="mine", thresholds=((1.0, 2.0),)))
    out = tmp_path / "out"
    import_kapture_folders(
        root,
        out,
        query_prefix="q",
        protocol_change=lambda given: given.model_copy(update={"conditions": ("night",)}),
    )
    assert read_groups(out / "megloc") == {"a.png": groups["a.png"], "q/r.png": groups["r.png"]}
    assert read_priors(out / "megloc") == {"q/r.png": ("a.png",)}
    assert read_names(out / "megloc") == {"q/r.png": "R"}
    pairs = read_relocalization(out / "megloc")
    assert pairs == [RelocalizationPair("x.txt", "a.png", "q/r.png")]
    assert read_world(out / "megloc") == world
    assert read_protocol(out / "megloc") == Protocol(
        dataset="mine", thresholds=((1.0, 2.0),), conditions=("night",)
    )


def test_equal_names_are_refused_or_prefixed(root: Path, tmp_path: Path) -> None:
    write_part(root, "query", ["a.png", "r.png"], poses=False)
    write_part(root, "query_gt", ["a.png", "r.png"], poses=True, images=False)
    night = ImageGroup(condition="night")
    write_groups(root / "megloc", {"a.png": night})
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
    assert read_groups(out / "megloc") == {"a.png": night, "some/where/a.png": night}


def test_masks_are_linked_under_the_prefix_too(root: Path, tmp_path: Path) -> None:
    mask = root / "query" / "sensors" / "masks" / "r.png.png"
    write_image(mask, np.zeros((6, 8), np.uint8))
    import_kapture_folders(root, tmp_path / "out", query_prefix="q")
    there = tmp_path / "out" / "query" / "sensors" / "masks" / "q" / "r.png.png"
    assert there.read_bytes() == mask.read_bytes()


@pytest.mark.parametrize("prefix", ["..", "/q", "a/../b", "a//b", "a\\b"])
def test_a_prefix_is_a_plain_relative_path(prefix: str) -> None:
    with pytest.raises(DataError):
        prefixed(prefix)


@pytest.mark.parametrize(
    ("part", "names", "poses", "message"),
    [
        ("mapping", ["a.png"], False, r"root/mapping: no mapping image has a pose"),
        ("query", [], False, r"root/query: there are no query images"),
    ],
)
def test_too_little_is_refused(
    root: Path, tmp_path: Path, part: str, names: list[str], poses: bool, message: str
) -> None:
    for file in (root / part / "sensors").glob("*.txt"):
        file.unlink()
    write_part(root, part, names, poses=poses)
    with pytest.raises(DataError, match=message):
        import_kapture_folders(root, tmp_path / "out")


@pytest.mark.parametrize("part", ["mapping", "query"])
def test_a_root_has_both_parts(root: Path, part: str) -> None:
    assert check_root(root) == root
    (root / part / "sensors" / "sensors.txt").unlink()
    with pytest.raises(DataError, match=f"root: {part}/sensors/sensors.txt is missing"):
        check_root(root)
    with pytest.raises(DataError, match="nowhere: no such folder"):
        check_root(root / "nowhere")


def test_every_file_an_import_reads_counts(root: Path) -> None:
    write_image(root / "query/sensors/masks/r.png.png", np.zeros((6, 8), np.uint8))
    write_priors(root / "megloc", {"r.png": ["a.png"]})
    (root / "notes.txt").write_text("no input")
    found = sorted(str(path.relative_to(root)) for path in input_files(root))
    tables = ["records_camera.txt", "sensors.txt", "trajectories.txt"]
    assert found == sorted(
        [
            *(f"{part}/sensors/{t}" for part in ("mapping", "query", "query_gt") for t in tables),
            *("mapping/sensors/records_data/a.png", "mapping/sensors/records_data/b/c.png"),
            *("query/sensors/records_data/b/q.png", "query/sensors/records_data/r.png"),
            *("query/sensors/masks/r.png.png", "megloc/priors.csv"),
        ]
    )
