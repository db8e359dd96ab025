"""Datasets by name and their benchmark files; options by preset, and the stages they choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import EntryPoints, entry_points
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from aachen_files import NIGHT, write_v1_0, write_v1_1
from kapture_forms import aachen_with_kapture

from megloc_kapture.errors import DataError, MeglocError, OptionError, PluginError
from megloc_kapture.io.dataset_tables import Protocol, read_side_tables
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.pipeline.datasets import (
    SUMMARY_FILE,
    TWIN_PREFIX,
    BenchmarkFile,
    DatasetChoice,
    choose_dataset,
    dataset_names,
    find_benchmark,
    read_benchmark,
)
from megloc_kapture.pipeline.evaluation_plan import (
    Run,
    choose_run,
    explain,
    explanation_table,
    plan_evaluation,
)
from megloc_kapture.pipeline.presets import (
    PRESETS,
    PipelineOptions,
    options_of,
    options_of_preset,
    parse_assignments,
)
from megloc_kapture.plugins import DATASETS, RENDERED_DATASETS
from megloc_kapture.values import Camera, RigidTransform
from tests.pipeline.runs import run_command

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
    with pytest.raises(PluginError, match="rejects its options: unknown option 'colour'"):
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


def test_an_import_writes_a_summary_and_the_protocol(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root, out = tmp_path / "root", tmp_path / "out"
    choice = choose_dataset("aachen", root)
    with pytest.raises(DataError, match="root: no such folder"):
        choice.check()
    write_v1_0(root)
    (root / "images_upright" / NIGHT[0]).unlink()
    with pytest.raises(DataError, match="1 files are missing: .*--allow-missing"):
        choice.import_to(root, out)
    counts = replace(choice, allow_missing=True).import_to(root, out)
    assert counts == {"map_images": 3, "queries": 3, "queries_with_truth": 0}
    assert read_side_tables(out / "megloc").protocol.dataset == "aachen"
    foreign: Any = SimpleNamespace(read=lambda root, allow_missing: {})
    with pytest.raises(PluginError, match="'aachen': read returned dict, not OfficialDataset"):
        replace(choice, adapter=foreign).rehearse()
    text = (out / SUMMARY_FILE).read_text()
    assert "published: 824, -821" in text and NIGHT[0] in text
    assert "3 counts differ from the published ones: 3 database images (4328), 3 day" in caplog.text
    caplog.clear()
    twin = replace(choice, name="synthetic-aachen", allow_missing=True)
    twin.import_to(root, tmp_path / "twin")
    assert not caplog.text


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
        (b'\xef\xbb\xbfdataset = "x"\n[option]\n', "option 'option'; did you mean 'options'"),
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


def test_assignments_and_tables_are_equivalent_and_the_last_counts() -> None:
    assert options_of_preset("classic") == PRESETS["classic"] == PipelineOptions()
    assert options_of_preset(assignments=["query_pairs.top_k=50"]) == PipelineOptions()
    changes = {"matching": {"options": {"max_ratio": 0.9}}, "query_pairs": {"top_k": 5}}
    assignments = ["matching.options.max_ratio=0.9", "query_pairs.top_k = 5"]
    options = options_of_preset(changes=[changes])
    assert options == options_of_preset(assignments=assignments)
    assert options.matching.options == {"max_ratio": 0.9} and options.matching.name == "nn"
    named = ["matching=nn", *assignments, "localization.rank=inliers", "localization.rank.name=x"]
    assert options_of_preset("megloc", assignments=named).matching == options.matching
    tables = [{"query_pairs": {"top_k": 4}}, {"query_pairs": {"top_k": 5}}]
    assert options_of_preset(changes=tables).query_pairs.top_k == 5
    typed = ["query_pairs.top_k=6", "query_pairs.top_k=7"]
    assert options_of_preset(changes=tables, assignments=typed).query_pairs.top_k == 7


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("none", "none"),
        ("3", 3),
        ("true", True),
        ('"quoted"', "quoted"),
        ("[1, 2]", [1, 2]),
        ("a=b", "a=b"),
    ],
)
def test_values_of_assignments(text: str, value: object) -> None:
    options = options_of_preset(assignments=[f"matching.options.x={text}"])
    found = options.matching.options["x"]
    assert found == value and type(found) is type(value)


def test_none_disables_optional_steps() -> None:
    off, chosen = set(), set()
    for key, _, field in options_of(PipelineOptions()):
        kind = str(field.annotation)
        if "None" in kind or "'none'" in kind:
            options = options_of_preset(changes=[parse_assignments([f"{key}=none"])])
            found = attrgetter(key)(options)
            (off if "None" in kind else chosen).add(key)
            assert found == (None if "None" in kind else "none"), key
    assert {"refinement.depth.max_sigmas", "preprocessing.masks.segmenter"} <= off
    assert {"reranking.by", "localization.fallback", "localization.clusters.by"} <= chosen
    with pytest.raises(OptionError, match="option query_pairs.top_k: .*integer"):
        options_of_preset(assignments=["query_pairs.top_k=none"])


SEVERAL = 'local_features=["sift", "rootsift"]'


@pytest.mark.parametrize(
    ("assignments", "message"),
    [
        (["query_pairs.top_k"], "--set takes key=value, got 'query_pairs.top_k'"),
        (["querypairs.top_k=3"], r"option querypairs; did you mean query_pairs\?"),
        (["query_pairs.topk=3"], r"query_pairs.topk; did you mean query_pairs.top_k\?"),
        (["query_pairs.top_k=many"], "option query_pairs.top_k: "),
        (["device=gpu"], "option device: "),
        ([SEVERAL, "local_features.options.max_keypoints=7"], r"choose one of: local_features\.si"),
    ],
)
def test_invalid_assignments_are_refused(assignments: list[str], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        options_of_preset(assignments=assignments)


@pytest.mark.parametrize(
    ("assignments", "expected"),
    [
        (["local_features=sift"], {"sift": None}),
        (["local_features=sift", "local_features.sift.options.max_keypoints=7"], {"sift": 7}),
        (
            [
                *(SEVERAL, "local_features.sift.options.max_keypoints=7"),
                "local_features.rootsift.options.max_keypoints=8",
            ],
            {"sift": 7, "rootsift": 8},
        ),
        (["local_features.rootsift.options.max_keypoints=9"], {"rootsift": 9}),
    ],
)
def test_local_features_are_a_name_or_a_list(
    assignments: list[str], expected: dict[str, int | None]
) -> None:
    options = options_of_preset(assignments=assignments)
    found = {one.name: one.options.get("max_keypoints") for one in options.local_features}
    assert found == expected
    assert all(one.options.keys() <= {"max_keypoints"} for one in options.local_features)
    assert options.local_types() == list(expected)
    assert options.main_type() == next(iter(expected))


def test_repeated_types_are_refused() -> None:
    with pytest.raises(OptionError, match="global features 'vlad_rootsift' are listed twice"):
        options_of_preset(assignments=['global_features=["vlad","vlad"]']).retrieval()
    with pytest.raises(OptionError, match="'sift' is listed twice"):
        options_of_preset(assignments=['local_features=["sift", "sift"]']).local_types()


def test_plugins_are_made_with_their_options() -> None:
    options = options_of_preset(
        assignments=["local_features.options.max_keypoints=7", "verification=none"]
    )
    (extractor,) = options.make_extractors()
    assert extractor.name == "rootsift"
    assert extractor.options.max_keypoints == 7  # type: ignore[attr-defined]
    assert options.verify_queries() == options.verify_mapping()
    assert options_of_preset().verify_queries() != options_of_preset().verify_mapping()
    # a type may have another matcher
    second = ["local_features.sift.matching.name=nn"]
    second += ["local_features.sift.matching.options.max_ratio=0.8"]
    of_two = options_of_preset(assignments=[SEVERAL, *second])
    for name, max_ratio in (("sift", 0.8), ("rootsift", None)):
        assert of_two.make_matcher(name).options.max_ratio == max_ratio  # type: ignore[attr-defined]
    with pytest.raises(PluginError, match="no plugin 'surf' .*; registered: .*nn"):
        options_of_preset(assignments=["matching.name=surf"]).make_matcher("rootsift")


MISSING = "3D-models/aachen_v_1_1/points3D.txt: file is missing; the points are read from it"


def run_of(dataset: str, preset: str, *assignments: str) -> Run:
    benchmark = find_benchmark(dataset)
    changes = benchmark.changes(preset, map_depth=dataset == "inloc", query_depth=False)
    options = options_of_preset(preset, changes=changes, assignments=assignments)
    return Run(DatasetChoice(dataset, None), preset, options, benchmark)


def lines_of(dataset: str, preset: str, *assignments: str) -> dict[str, dict[str, Any]]:
    return {line["name"]: line for line in explain(run_of(dataset, preset, *assignments).options)}


def test_each_stage_has_a_reason() -> None:
    lines = lines_of("aachen", "megloc")
    off = {name for name, line in lines.items() if not line["on"]}
    assert off == {"densify", "refine_poses"}
    assert lines["local_features"]["why"] == "local_features = superpoint + aslfeat"
    assert "local_features = superpoint + aslfeat" in lines["query_matches"]["why"]
    assert lines["mapping_pairs"]["why"].endswith("by = poses + covisibility + retrieval")
    assert lines["query_pairs"]["why"] == (
        "reranking.by = verified, reranking.keep = 20, reranking.local_type = superpoint"
    )
    assert "localization.min_confidence = 0.0" in lines["localization"]["why"]
    changed = lines_of("aachen", "megloc", "guided_pyramid.mode=off")["query_rematching"]
    assert not changed["on"] and "guided_pyramid.mode = off" in changed["why"]
    assert changed["why"].startswith("second_matching.queries = true, ")
    inloc = lines_of("inloc", "megloc")
    assert inloc["points"] == {"name": "points", "on": True, "why": "map = lift"}
    assert inloc["refine_poses"]["why"].endswith("references = map images of the query's cluster")


def test_data_without_a_model_have_no_pairs_by_covisibility(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(tmp_path / "none"))
    official = write_v1_1(write_v1_0(tmp_path / "official"))
    whole = choose_run("aachen", official, preset="megloc")
    assert "covisibility" in whole.options.mapping_pairs.by
    kapture = aachen_with_kapture(official, tmp_path / "kapture")
    (official / "3D-models" / "aachen_v_1_1" / "points3D.txt").unlink()
    for root, error in ((kapture, "has kapture folders"), (official, MISSING)):
        run = choose_run("aachen", root, preset="megloc")
        assert run.options.mapping_pairs.by == ("poses", "retrieval")
        # an explicit request is refused before weights are checked
        typed = ['mapping_pairs.by=["covisibility"]']
        with pytest.raises(MeglocError, match=error):
            plan_evaluation(choose_run("aachen", root, preset="megloc", assignments=typed))


def test_explain_runs_nothing_and_needs_no_data(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.delenv("MEGLOC_DATA", raising=False)
    monkeypatch.chdir(tmp_path)
    run_command("eval", "synthetic-inloc", "--preset", "megloc", "--explain")
    expected = explanation_table(explain(run_of("inloc", "megloc").options))
    assert capsys.readouterr().out.rstrip("\n") == expected
    assert list(tmp_path.iterdir()) == []


def test_pairs_by_covisibility_need_a_model() -> None:
    name = "synthetic-4seasons"
    options = options_of_preset(assignments=['mapping_pairs.by=["covisibility"]'])
    with pytest.raises(OptionError, match=f"{name} comes with no model, .*by covisibility"):
        plan_evaluation(Run(choose_dataset(name, None), "classic", options))
