"""Options by preset, table and assignment, and the stages that they choose."""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
from aachen_files import write_v1_0, write_v1_1
from kapture_forms import aachen_with_kapture

from megloc_kapture.cli.main import main
from megloc_kapture.errors import MeglocError, OptionError, PluginError
from megloc_kapture.pipeline.datasets import DatasetChoice, choose_dataset, find_benchmark
from megloc_kapture.pipeline.evaluation_plan import (
    Run,
    choose_run,
    explain,
    explained,
    plan_evaluation,
)
from megloc_kapture.pipeline.presets import (
    PRESETS,
    PipelineOptions,
    assigned,
    options_of,
    options_of_preset,
)


def test_assignments_and_tables_are_equivalent_and_the_last_counts() -> None:
    assert options_of_preset("classic") == PRESETS["classic"] == PipelineOptions()
    assert options_of_preset(assignments=["query_pairs.top_k=50"]) == PipelineOptions()
    changes = {"matching": {"options": {"max_ratio": 0.9}}, "query_pairs": {"top_k": 5}}
    assignments = ["matching.options.max_ratio=0.9", "query_pairs.top_k = 5"]
    options = options_of_preset(changes=[changes])
    assert options == options_of_preset(assignments=assignments)
    assert options.matching.options == {"max_ratio": 0.9} and options.matching.name == "nn"
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
    for option in options_of(PipelineOptions()):
        if "None" in option.kind or "'none'" in option.kind:
            options = options_of_preset(changes=[assigned([f"{option.key}=none"])])
            found = attrgetter(option.key)(options)
            (off if "None" in option.kind else chosen).add(option.key)
            assert found == (None if "None" in option.kind else "none"), option.key
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
        (
            [SEVERAL, "local_features.options.max_keypoints=7"],
            r"choose one of: local_features\.sift, local_f",
        ),
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


def test_unknown_presets_and_repeated_types_are_refused() -> None:
    with pytest.raises(OptionError, match="unknown preset 'best'; known: classic, megloc, modern"):
        options_of_preset("best")
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


MISSING = "3D-models/aachen_v_1_1/points3D.txt: missing"


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
    changed = lines_of("aachen", "megloc", "guided_pyramid.mode=off")["query_pyramid"]
    assert not changed["on"] and changed["why"].startswith("guided_pyramid.mode = off")
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
    with pytest.raises(SystemExit) as end:
        main(["eval", "synthetic-inloc", "--preset", "megloc", "--explain"])
    assert end.value.code == 0
    expected = explained(explain(run_of("inloc", "megloc").options))
    assert capsys.readouterr().out.rstrip("\n") == expected
    assert list(tmp_path.iterdir()) == []


def test_pairs_by_covisibility_need_a_model() -> None:
    name = "synthetic-4seasons"
    options = options_of_preset(assignments=['mapping_pairs.by=["covisibility"]'])
    with pytest.raises(OptionError, match=f"{name} comes with no model: .*by covisibility"):
        plan_evaluation(Run(choose_dataset(name, None), "classic", options))
