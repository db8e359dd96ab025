"""What each step adds: which runs there are, and that they leave the first one alone."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from megloc_kapture.io.tables import read_status
from megloc_kapture.pipeline.datasets import choose_dataset, find_benchmark
from megloc_kapture.pipeline.evaluation_plan import (
    fresh_copy,
    outcome,
    outcomes_text,
    plan_evaluation,
    variants,
    write_outcomes,
)
from megloc_kapture.pipeline.plan import run_plan
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.run import Run
from megloc_kapture.pipeline.workspace import Workspace
from tests.pipeline.runs import run_in

# the paper's steps, by what an option model calls what each changes
STEPS = {
    "masks": {"preprocessing"},
    "second local features": {"local_features"},
    "fusion": {"global_features"},
    "map refinement": {"refinement"},
    "reranking": {"reranking", "query_pairs"},
    "guided pyramid": {"guided_pyramid"},
    "clusters": {"localization"},  # ranked by inliers: there is no other ranking to leave out
}


def names(*assignments: str) -> list[str]:
    return list(variants(options_of_preset(assignments=assignments)))


def test_only_steps_that_are_there_are_left_out() -> None:
    assert names() == ["map refinement", "clusters", "pose ranking"]
    plain = ("localization.rank.name=inliers", "localization.clusters.by=none")
    assert names(*plain) == ["map refinement"]
    assert names('pose_refinement.by=[{name="icp"}]')[-1] == "icp"


def test_a_variant_lacks_its_step_and_nothing_else() -> None:
    changes = find_benchmark("aachen").changes("megloc", map_depth=False, query_depth=False)
    options = options_of_preset("megloc", changes=changes)
    assert list(variants(options)) == list(STEPS)
    whole = options.model_dump()
    for step, changed in variants(options).items():
        without = changed.model_dump()
        assert {name for name in whole if without[name] != whole[name]} == STEPS[step]
        assert step not in variants(changed)


@pytest.fixture(scope="module")
def first(fountain: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Workspace]:
    workspace = Workspace(tmp_path_factory.mktemp("ablation") / "workspace")
    options = options_of_preset(
        assignments=[
            "local_features.options.max_keypoints=400",
            "preprocessing.max_size_px=400",
            "global_features.options.num_clusters=8",
        ]
    )
    run_in(workspace, fountain, options)
    return Run(choose_dataset("kapture", fountain), "classic", options), workspace


def folder_bytes(root: Path) -> dict[str, bytes]:
    files = (path for path in root.rglob("*") if path.is_file() and not path.is_symlink())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


@pytest.mark.slow
def test_a_variant_runs_only_what_differs_and_leaves_the_first_run_alone(
    first: tuple[Run, Workspace],
) -> None:
    run, whole = first
    before = folder_bytes(whole.root)
    workspace = fresh_copy(whole, "without_pose_ranking")
    assert workspace.root == whole.root / "ablation" / "without_pose_ranking"
    reports = run_in(workspace, run.source, variants(run.options)["pose ranking"])
    again = {name for name, report in reports.items() if report.state == "run"}
    assert again == {"localization", "submission", "evaluation"}
    after = folder_bytes(whole.root)
    kept = {name: content for name, content in after.items() if not name.startswith("ablation/")}
    assert kept == before
    # what did not change is the same file, not another with the same bytes
    place = "map/reconstruction/points3d.txt"
    assert workspace.path(place).samefile(whole.path(place))


@pytest.mark.slow
def test_refinement_is_turned_on_and_off_in_one_workspace(first: tuple[Run, Workspace]) -> None:
    run, whole = first
    workspace = fresh_copy(whole, "with_rendering")
    plain = folder_bytes(whole.path("localized"))
    refined = run.options.model_validate(
        {**run.options.model_dump(), "pose_refinement": {"by": ["rendering"]}}
    )
    for options in (refined, run.options, refined):
        stages = plan_evaluation(Run(run.source, "classic", options))
        outputs = [output for stage in stages for output in stage.writes]
        assert len(outputs) == len(set(outputs))
        with workspace.lock():
            run_plan(stages, workspace)
        statuses = read_status(workspace.path("localized/status.csv")).values()
        said = {status.refinement for status in statuses}
        if options is refined:
            assert said == {"rendering: no map image with depth is seen by others from elsewhere"}
            assert folder_bytes(workspace.path("localized_unrefined")) == plain
        else:
            assert said == {""}
            assert folder_bytes(workspace.path("localized")) == plain
            assert not workspace.path("localized_unrefined").exists()


@pytest.mark.slow
def test_the_table_has_recall_medians_and_seconds(first: tuple[Run, Workspace]) -> None:
    run, whole = first
    found = outcome("all steps", whole, plan_evaluation(run))
    assert list(found.recall) == ["0.05 m, 5 deg", "0.25 m, 2 deg", "0.5 m, 5 deg", "5 m, 10 deg"]
    assert found.recall["5 m, 10 deg"] == 1 and 0 < found.median_position_m < 0.1
    assert found.seconds > 0
    path = write_outcomes(whole, [found, found])
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["run"] for row in rows] == ["all steps", "all steps"]
    assert float(rows[0]["5 m 10 deg"]) == 1
    assert float(rows[0]["median_m"]) == pytest.approx(found.median_position_m, abs=1e-6)
    assert outcomes_text([found]).count("all steps") == 1
