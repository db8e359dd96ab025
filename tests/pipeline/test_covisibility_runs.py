"""Pairs by co-visibility in the model that a dataset comes with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from megloc_kapture.errors import OptionError
from megloc_kapture.io.kapture import KaptureFolder, read_pairs
from megloc_kapture.pipeline.datasets import DatasetChoice, choose_dataset, twin_of
from megloc_kapture.pipeline.evaluation_plan import Run, plan_evaluation
from megloc_kapture.pipeline.plan import Workspace
from megloc_kapture.pipeline.presets import options_of_preset
from tests.pipeline.runs import evaluated, run_in

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


def twin() -> DatasetChoice:
    source = choose_dataset("synthetic-aachen", None)
    return replace(source, twin=twin_of("aachen", **SMALL))


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


COVISIBLE = 'mapping_pairs.by=["covisibility"]'


@pytest.mark.parametrize(
    ("name", "assignments", "words"),
    [
        ("synthetic", [COVISIBLE], "synthetic comes with no model: .*by covisibility"),
        ("synthetic-4seasons", [COVISIBLE], "4seasons comes with no model: .*by covisibility"),
    ],
)
def test_what_needs_a_model_is_refused_without_it(
    tmp_path: Path, name: str, assignments: list[str], words: str
) -> None:
    source = choose_dataset(name, tmp_path if name == "kapture" else None)
    with pytest.raises(OptionError, match=words):
        run_in(Workspace(tmp_path / "w"), source, options_of_preset(assignments=assignments))


def test_covisibility_is_that_of_the_model_the_dataset_comes_with(tmp_path: Path) -> None:
    options = options_of_preset(
        changes=[CHEAP], assignments=[COVISIBLE, "preprocessing.max_size_px=320"]
    )
    workspace = evaluated(tmp_path / "workspace", twin(), options, last="mapping_pairs")
    # its points are needed, its features are not
    assert not list(workspace.path("world").rglob("*.db"))
    assert covisible_pairs(workspace)
    # points that are lifted need no pairs
    by = {"mapping_pairs": {"by": ["covisibility"]}}
    lifted = options_of_preset(changes=[by], assignments=["map=lift"])
    inloc = choose_dataset("synthetic-inloc", None)
    plan_evaluation(Run(inloc, "classic", lifted))
