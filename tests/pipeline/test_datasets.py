"""Datasets by name: their roots, their imports and their benchmark files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import EntryPoints, entry_points
from pathlib import Path

import pytest
from aachen_files import NIGHT, write_v1_0

from megloc_kapture.errors import DataError, OptionError, PluginError
from megloc_kapture.io.dataset_tables import Protocol, read_protocol
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.pipeline.datasets import (
    SUMMARY_FILE,
    TWIN_PREFIX,
    BenchmarkFile,
    choose_dataset,
    dataset_names,
    find_benchmark,
    read_benchmark,
)
from megloc_kapture.pipeline.evaluation_plan import choose_run
from megloc_kapture.pipeline.presets import PRESETS, options_of_preset
from megloc_kapture.plugins import DATASETS, RENDERED_DATASETS
from megloc_kapture.values import Camera, RigidTransform

OFFICIAL = ("4seasons", "aachen", "inloc", "robotcar")


@pytest.mark.parametrize("name", OFFICIAL)
def test_an_official_dataset_has_a_download_page_and_a_twin(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MEGLOC_DATA", raising=False)
    with pytest.raises(OptionError) as refused:
        choose_dataset(name, None)
    text = str(refused.value)
    assert "--root or MEGLOC_DATA" in text and "://" in text
    assert f"`megloc eval synthetic-{name}`" in text
    choice = choose_dataset(f"synthetic-{name}", None)
    assert choice.root is None and choice.twin is not None
    assert choice.adapter is not None and choice.adapter.name == name


def test_the_root_is_found_below_the_environment(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MEGLOC_DATA", str(tmp_path))
    with pytest.raises(OptionError, match="MEGLOC_DATA contains none of aachen, Aachen-Day-Night"):
        choose_dataset("aachen", None)
    (tmp_path / "Aachen-Day-Night").mkdir()
    assert choose_dataset("aachen", None).root == tmp_path / "Aachen-Day-Night"
    (tmp_path / "aachen").mkdir()
    assert choose_dataset("aachen", None).root == tmp_path / "aachen"
    assert choose_dataset("aachen", tmp_path).root == tmp_path


def test_unknown_datasets_and_options_are_refused() -> None:
    with pytest.raises(OptionError, match="unknown dataset 'venice'; known: kapture, "):
        choose_dataset("venice", None)
    with pytest.raises(PluginError, match="refuses its options: unknown option 'colour'"):
        choose_dataset("aachen", Path(), import_options={"colour": "red"})
    with pytest.raises(OptionError, match="--query-prefix"):
        choose_dataset("inloc", Path(), query_prefix="q")


def test_without_megloc_twins_the_message_has_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = {group: entry_points(group=group) for group in (DATASETS, RENDERED_DATASETS)}
    others[RENDERED_DATASETS] = EntryPoints()
    monkeypatch.setattr("megloc_kapture.plugin_names.entry_points", lambda group: others[group])
    for name in ("synthetic", "synthetic-aachen"):
        with pytest.raises(OptionError, match="pip install megloc-twins"):
            choose_dataset(name, None)
        # a folder that is already rendered needs no renderer
        assert choose_dataset(name, tmp_path).twin is None


def test_an_import_writes_a_summary_and_the_changed_protocol(tmp_path: Path) -> None:
    root, out = write_v1_0(tmp_path / "root"), tmp_path / "out"
    (root / "images_upright" / NIGHT[0]).unlink()
    choice = choose_dataset("aachen", root)
    with pytest.raises(DataError, match="1 files are missing: .*--allow-missing"):
        choice.import_to(root, out)
    counts = replace(choice, allow_missing=True).import_to(
        root, out, lambda given: given.model_copy(update={"truth": "mine"})
    )
    assert counts == {"map_images": 3, "queries": 3, "queries_with_truth": 0}
    assert read_protocol(out / "megloc").truth == "mine"
    text = (out / SUMMARY_FILE).read_text()
    assert "published: 824, -821" in text and NIGHT[0] in text


FILES = sorted(Path(__file__).parents[2].glob("benchmarks/*.toml"))


def test_a_benchmark_file_has_options_by_preset_and_depth(tmp_path: Path) -> None:
    path = tmp_path / "b.toml"
    path.write_text(
        'dataset = "kapture"\nthresholds = [[0.25, 2], [0.5, 5]]\n'
        "[options.query_pairs]\ntop_k = 9\n"
        "[options_with_query_depth.pose_refinement]\nby = ['icp']\n"
        "[presets.modern.options_with_map_depth.pose_refinement]\nby = ['rendering']\n"
        "[presets.modern.options_with_both_depths.query_pairs]\ntop_k = 8\n"
    )
    benchmark = read_benchmark(path)
    assert benchmark.thresholds == ((0.25, 2.0), (0.5, 5.0))
    for preset, map_depth, query_depth, refiners, top_k in (
        ("classic", True, False, [], 9),
        ("classic", True, True, ["icp"], 9),
        ("modern", True, False, ["rendering"], 9),
        ("modern", True, True, ["rendering"], 8),
    ):
        changes = benchmark.changes(preset, map_depth=map_depth, query_depth=query_depth)
        options = options_of_preset(preset, changes=changes)
        assert options.query_pairs.top_k == top_k
        assert [one.name for one in options.pose_refinement.by] == refiners


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_our_benchmark_files_are_valid(path: Path) -> None:
    benchmark = read_benchmark(path)
    assert benchmark.dataset == path.stem
    for preset in PRESETS:
        changes = benchmark.changes(preset, map_depth=True, query_depth=True)
        options_of_preset(preset, changes=changes)
    benchmark.change(Protocol())
    if benchmark.import_options:
        choose_dataset(benchmark.dataset, Path(), import_options=benchmark.import_options)


def test_every_dataset_has_a_benchmark_file() -> None:
    assert {path.stem for path in FILES} == {n for n in dataset_names() if TWIN_PREFIX not in n}


def test_a_twin_has_the_options_of_its_dataset_without_published_figures() -> None:
    real, twin = (find_benchmark(name) for name in ("inloc", "synthetic-inloc"))
    assert real.published
    assert twin == real.model_copy(update={"dataset": "synthetic-inloc", "published": ()})
    assert find_benchmark("venice") == BenchmarkFile(dataset="venice")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"dataset = ", "b.toml: not TOML: "),
        (b'dataset = "x"\n[presets.best]\n', "b.toml: presets: .*unknown preset 'best'; known: "),
    ],
)
def test_an_invalid_benchmark_file_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "b.toml").write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_benchmark(tmp_path / "b.toml")


CAMERA = Sensor.from_camera(Camera("SIMPLE_PINHOLE", 10, 8, (9.0, 5.0, 4.0)))
RIG = {"rig": dict.fromkeys(("cam", "deep"), RigidTransform.identity())}


def write_part(root: Path, *, depth: bool, rig: bool = True) -> None:
    """Write a kapture folder with one image and, if asked for, its depth map."""
    data = KaptureData({"cam": CAMERA}, records_camera={(1, "cam"): "1.jpg"})
    if depth:
        data.sensors["deep"] = replace(CAMERA, sensor_type="depth")
        data.records_depth[1, "deep"] = "1.depth"
    write_sensors(root, replace(data, rigs=RIG if depth and rig else {}))


def test_depth_without_a_rig_is_reported_and_not_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for part in ("mapping", "query"):
        write_part(tmp_path / part, depth=True, rig=False)
    choice = choose_dataset("kapture", tmp_path)
    assert not choice.has_query_depth() and not choice.has_map_depth()
    assert caplog.text.count("depth is not used") == 2


@pytest.mark.parametrize(
    ("with_depth", "rank", "refiners"),
    [
        ((), None, []),
        (("mapping",), "lpips", ["rendering"]),
        (("query",), None, ["icp"]),
        (("mapping", "query"), "lpips", ["icp", "rendering"]),
    ],
)
def test_depth_of_kapture_folders_adds_steps_to_a_preset(
    tmp_path: Path, with_depth: Sequence[str], rank: str | None, refiners: list[str]
) -> None:
    for part in ("mapping", "query"):
        write_part(tmp_path / part, depth=part in with_depth)
    options = choose_run("kapture", tmp_path, preset="megloc").options
    distance = options.localization.rank.options.get("distance", {}).get("name")
    assert (distance, [one.name for one in options.pose_refinement.by]) == (rank, refiners)
