"""The steps of the paper: what each dataset's file turns on, and what is said of the rest."""

from __future__ import annotations

from pathlib import Path

import pytest
from aachen_files import write_v1_0, write_v1_1
from kapture_forms import aachen_with_kapture

from megloc_kapture.cli.main import main
from megloc_kapture.errors import MeglocError
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.pipeline.datasets import DatasetChoice, find_benchmark
from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.presets import check_weights, options_of_preset
from megloc_kapture.pipeline.run import DatasetFacts, PaperStep, Run, choose_run, steps_text

FACTS = {
    "aachen": DatasetFacts(map_depth=False, query_depth=False, model=True),
    "robotcar": DatasetFacts(map_depth=False, query_depth=False, model=True),
    "4seasons": DatasetFacts(map_depth=False, query_depth=False, model=False),
    "inloc": DatasetFacts(map_depth=True, query_depth=False, model=False),
    "kapture": DatasetFacts(map_depth=True, query_depth=True, model=False),
}
MISSING = "3D-models/aachen_v_1_1/points3D.txt: missing"
TRAINED = "descriptors and matcher trained anew"
STEREO = "depth of map images by multi-view stereo"
# on each dataset: stereo gains nothing that was shown, and the paper's weights are not public
OFF_EVERYWHERE = {STEREO, TRAINED}
WITHOUT_FIELD = "a map as a neural field (NeRF-W)"
WITHOUT_DEPTH = {
    WITHOUT_FIELD,
    "points verified by depth",
    "clusters ranked by LPIPS of aligned views",
    "poses refined by ICP",
    "poses refined by rendering",
}
BY_INLIERS = "clusters ranked by the number of inliers"
SEQUENCE, COVISIBLE = "map pairs by sequence", "map pairs by co-visibility"
OFF = {
    "aachen": {*WITHOUT_DEPTH, "the own car masked", SEQUENCE},
    "robotcar": {*WITHOUT_DEPTH, SEQUENCE},
    "4seasons": {*WITHOUT_DEPTH, COVISIBLE},
    "inloc": {
        WITHOUT_FIELD,
        "people and vehicles masked",
        "the own car masked",
        "map pairs by poses",
        COVISIBLE,
        "map pairs by retrieval",
        SEQUENCE,
        "points triangulated with known poses",
        "uncertain points rejected",
        BY_INLIERS,
        "poses refined by ICP",
    },
    # nobody knows what is in a user's folders
    "kapture": {
        WITHOUT_FIELD,
        "people and vehicles masked",
        "the own car masked",
        COVISIBLE,
        SEQUENCE,
        BY_INLIERS,
    },
}


def run_of(dataset: str, preset: str, *assignments: str) -> Run:
    benchmark, facts = find_benchmark(dataset), FACTS[dataset]
    changes = benchmark.changes(preset, map_depth=facts.map_depth, query_depth=facts.query_depth)
    options = options_of_preset(preset, changes=changes, assignments=assignments)
    return Run(DatasetChoice(dataset, None), preset, options, benchmark, facts)


def steps_of(dataset: str, preset: str, *assignments: str) -> dict[str, PaperStep]:
    return {step.name: step for step in run_of(dataset, preset, *assignments).steps()}


@pytest.mark.parametrize("dataset", FACTS)
def test_the_preset_does_every_step_that_a_dataset_permits(dataset: str) -> None:
    steps = steps_of(dataset, "megloc")
    assert {name for name, step in steps.items() if not step.on} == OFF[dataset] | OFF_EVERYWHERE
    assert all(step.why for step in steps.values())
    # the paper's rules, each with the option that has it
    kept = steps["M images retrieved, N kept by local matches"]
    assert kept.why.endswith("by verified matches of superpoint")
    assert "100 matches of the matcher" in steps["guided pyramid matching"].why
    assert steps["references of the top-1 cluster only"].on
    assert "min_confidence 0" in steps["every pose kept"].why
    # outdoors and indoors differ as the networks do
    network = {"inloc": "4 px, superglue_indoor", "kapture": ""}.get(
        dataset, "3 px, superglue_outdoor"
    )
    assert network in steps["SuperPoint matched by SuperGlue"].why
    # with its own options each dataset needs no download
    check_weights(run_of(dataset, "classic").options)


def test_stereo_and_a_field_are_on_where_they_are_asked_for() -> None:
    rendering = 'pose_refinement.by=["rendering",{name="field",options={field="a"}}]'
    without = steps_of("aachen", "megloc", rendering)
    assert without["poses refined by rendering"].why == "the map images have no depth"
    assert without[WITHOUT_FIELD].on and not without[STEREO].on
    steps = steps_of("aachen", "megloc", rendering, "mvs.mode=depth")
    assert steps[STEREO].on and steps["poses refined by rendering"].on
    assert steps_of("inloc", "megloc", "mvs.mode=depth")[STEREO].why == "the map images have depth"


@pytest.mark.parametrize(
    ("assignment", "name"),
    [
        ("preprocessing.undistort=false", "lens distortion removed"),
        ("preprocessing.masks.segmenter=null", "people and vehicles masked"),
        ('mapping_pairs.by=["poses", "retrieval"]', COVISIBLE),
        ("guided_pyramid.mode=off", "guided pyramid matching"),
        ("localization.clusters.by=none", "one pose per cluster of candidates"),
        ('local_features=["superpoint"]', "ASLFeat"),
        ("refinement.uncertainty.max_robust_sigmas=null", "uncertain points rejected"),
        ("reranking.by=none", "M images retrieved, N kept by local matches"),
    ],
)
def test_who_turned_a_step_off_is_said(assignment: str, name: str) -> None:
    before, after = steps_of("aachen", "megloc"), steps_of("aachen", "megloc", assignment)
    assert before[name].on and not after[name].on
    assert after[name].why.startswith("an option of this run (")
    others = {other for other in before if other != name}
    changed = {other for other in others if before[other].on != after[other].on}
    assert changed <= {"SuperPoint matched by SuperGlue"}  # a list typed anew has other matchers
    assert steps_of("aachen", "classic")["ASLFeat"].why.startswith("neither preset classic nor")


def test_who_turned_a_step_on_is_said() -> None:
    steps = steps_of("robotcar", "megloc", "mapping_pairs.by=['sequence']")
    assert steps[SEQUENCE] == PaperStep(SEQUENCE, True, "an option of this run (mapping_pairs.by)")
    assert steps["ASLFeat"].why == "preset megloc"
    masked = steps["people and vehicles masked"]
    assert masked.why == "the dataset's file (preprocessing.masks.segmenter); deeplabv3plus"
    # weights of one's own training
    assert "megloc train descriptor makes such" in steps_of("aachen", "megloc")[TRAINED].why
    own = "local_features.superpoint.options.descriptor_weights=night.safetensors"
    step = steps_of("aachen", "megloc", own)[TRAINED]
    assert step == PaperStep(TRAINED, True, "an option of this run (local_features)")
    # a step without its data is off whoever asks for it
    icp = "poses refined by ICP"
    asked = steps_of("aachen", "classic", 'pose_refinement.by=["icp"]')
    assert asked[icp] == PaperStep(icp, False, "the queries have no depth")
    assert steps_of("kapture", "classic")[icp].on


def test_pairs_by_covisibility_are_off_where_the_data_have_no_model(
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
        step = {one.name: one for one in run.steps()}[COVISIBLE]
        assert not step.on and step.why.startswith("the dataset comes with no model")
        # one that is asked for by hand is refused before any weights are asked for
        typed = ['mapping_pairs.by=["covisibility"]']
        with pytest.raises(MeglocError, match=error):
            plan_evaluation(choose_run("aachen", root, preset="megloc", assignments=typed))


@pytest.mark.parametrize("dataset", ["aachen", "robotcar", "4seasons", "inloc"])
def test_all_weights_that_the_steps_need_are_named_at_once(
    dataset: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(tmp_path))
    with pytest.raises(MissingWeightsError) as told:
        check_weights(run_of(dataset, "megloc").options)
    needed = ["superpoint_v1", "aslfeat", "netvlad-pitts30k", "delg-r101-gldv2clean", "openibl"]
    needed += ["apgem-resnet101-lm18"]
    if dataset == "inloc":
        needed += ["superglue_indoor", "lpips-trunk-alex", "lpips-alex"]
    else:
        needed += ["superglue_outdoor", "deeplabv3plus-resnet101"]
    *lines, together = str(told.value).splitlines()
    if dataset == "inloc":  # the preset's matcher is another
        lines.append(together)
    else:
        assert together.endswith("megloc weights fetch --preset megloc --accept-licence")
    assert sorted(line.split()[2] for line in lines) == sorted(needed)
    assert all("megloc weights " in line for line in lines)


def test_the_page_about_the_paper_has_every_step() -> None:
    page = (Path(__file__).parents[2] / "docs" / "paper.md").read_text(encoding="utf-8")
    for name in steps_of("aachen", "megloc"):
        assert f"| **{name}** |" in page


def test_explaining_runs_nothing_and_needs_no_data(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.delenv("MEGLOC_DATA", raising=False)
    monkeypatch.chdir(tmp_path)
    for dataset in ("inloc", "synthetic-inloc"):
        with pytest.raises(SystemExit) as end:
            main(["eval", dataset, "--preset", "megloc", "--explain"])
        assert end.value.code == 0
        expected = steps_text(run_of("inloc", "megloc").steps())
        assert capsys.readouterr().out.rstrip("\n") == expected
    assert list(tmp_path.iterdir()) == []
