"""Plans of a run: stages, their reasons and their weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from aachen_files import write_v1_0, write_v1_1
from kapture_forms import aachen_with_kapture

from megloc_kapture.cli.main import main
from megloc_kapture.errors import MeglocError, OptionError
from megloc_kapture.pipeline.datasets import DatasetChoice, choose_dataset, find_benchmark
from megloc_kapture.pipeline.evaluation_plan import (
    Run,
    choose_run,
    explain,
    explained,
    plan_evaluation,
)
from megloc_kapture.pipeline.presets import options_of_preset

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
