"""Runs that localize in the model a dataset comes with, alone and beside points of our own."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from megloc_kapture.errors import OptionError
from megloc_kapture.io.kapture import KaptureFolder, read_pairs
from megloc_kapture.pipeline.datasets import choose_dataset, twin_of
from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.executors import open_executor, single_threaded
from megloc_kapture.pipeline.plan import run_plan
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.run import Run
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.work import Work

pytestmark = pytest.mark.slow

SMALL = {
    "num_places": 1,
    "stations_per_place": 6,
    "day_queries": 3,
    "night_queries": 1,
    "width": 400,
    "height": 300,
}
CHEAP = {
    "local_features": {"options": {"max_keypoints": 800}},
    "global_features": {"options": {"num_clusters": 16}},
}
BOTH = ["map=given+triangulate", 'mapping_pairs.by=["covisibility"]']


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Workspace]:
    """Runs the twin with some options in one workspace; renders once."""
    workspace = Workspace(tmp_path_factory.mktemp("given") / "workspace")
    source = choose_dataset("synthetic-aachen", None)
    source = replace(source, twin=twin_of("aachen", **SMALL))

    def run_with(*assignments: str) -> Workspace:
        options = options_of_preset(changes=[CHEAP], assignments=assignments)
        with workspace.lock(), single_threaded(), open_executor("processes", 2) as executor:
            of = Run(source, "classic", options, workspace)
            run_plan(plan_evaluation(of), workspace, Work(executor))
        return workspace

    return run_with


def day_recall(workspace: Workspace) -> float:
    found = json.loads(workspace.path("evaluation/recall.json").read_text())
    (day,) = (row for row in found["rows"] if row["name"] == "day")
    return float(day["recall"][1]["recall"])


def test_the_model_alone(run: Callable[..., Workspace]) -> None:
    workspace = run("map=given")
    assert day_recall(workspace) == 1.0
    assert not workspace.path("matches/mapping").exists()  # nothing of our own was matched
    reference, found = workspace.folder("reference"), workspace.folder("map")
    assert (
        list(found.observations()) == ["sift"] == workspace.folder("query", "").types("keypoints")
    )
    assert len(found.points3d()) == len(reference.points3d())


def test_the_model_and_points_of_our_own(run: Callable[..., Workspace]) -> None:
    workspace = run(*BOTH)
    assert day_recall(workspace) == 1.0
    found = workspace.folder("map")
    observations = found.observations()
    assert sorted(observations) == ["rootsift", "sift"]
    given, own = (set(observations[name].point_ids.tolist()) for name in ("sift", "rootsift"))
    assert given and own and not given & own  # every point is of one type
    assert len(given | own) == len(found.points3d())
    assert covisible_pairs(workspace)


def covisible_pairs(workspace: Workspace) -> int:
    """How many pairs there are; every pair sees points of the model in common."""
    seen = KaptureFolder(workspace.path("reference")).observations()["sift"]
    points = {
        name: set(seen.point_ids[seen.image_ids == row].tolist())
        for row, name in enumerate(seen.image_names)
    }
    pairs = read_pairs(workspace.path("pairs/mapping.txt"))
    assert all(points[pair.query] & points[pair.map] for pair in pairs)
    return len(pairs)


def test_a_dataset_without_a_model_is_refused(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "workspace")
    for name, root in (("synthetic", None), ("synthetic-inloc", None), ("kapture", tmp_path)):
        run = Run(
            choose_dataset(name, root),
            "classic",
            options_of_preset(assignments=["map=given"]),
            workspace,
        )
        with pytest.raises(OptionError, match="map = given"):
            plan_evaluation(run)


def test_both_need_features_of_two_types(tmp_path: Path) -> None:
    options = options_of_preset(assignments=["map=given+triangulate", "local_features.name=sift"])
    run = Run(
        choose_dataset("synthetic-aachen", None),
        "classic",
        options,
        Workspace(tmp_path / "workspace"),
    )
    with pytest.raises(OptionError, match="'sift' is asked for twice"):
        plan_evaluation(run)


@pytest.mark.slow
def test_covisibility_is_that_of_the_model_the_dataset_comes_with(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "workspace")
    options = options_of_preset(
        changes=[CHEAP],
        assignments=['mapping_pairs.by=["covisibility"]', "preprocessing.max_size_px=320"],
    )
    source = choose_dataset("synthetic-aachen", None)
    source = replace(source, twin=twin_of("aachen", **SMALL))
    with workspace.lock(), single_threaded():
        planned = plan_evaluation(Run(source, "classic", options, workspace))
        run_plan(planned, workspace, last="mapping_pairs")
    # its points are needed, its features are not
    assert not list(workspace.path("world").rglob("*.db"))
    assert covisible_pairs(workspace)


def test_without_a_model_there_is_no_covisibility(tmp_path: Path) -> None:
    for name in ("synthetic", "synthetic-4seasons"):
        options = options_of_preset(assignments=['mapping_pairs.by=["covisibility"]'])
        run = Run(choose_dataset(name, None), "classic", options, Workspace(tmp_path / name))
        with pytest.raises(OptionError, match=f"{name} comes with no model: .*by covisibility"):
            plan_evaluation(run)
    # points that are lifted need no pairs
    by = {"mapping_pairs": {"by": ["covisibility"]}}
    options = options_of_preset(changes=[by], assignments=["map=lift"])
    plan_evaluation(
        Run(choose_dataset("synthetic-inloc", None), "classic", options, Workspace(tmp_path / "i"))
    )
