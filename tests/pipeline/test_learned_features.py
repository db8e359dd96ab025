"""Learned features in whole runs: several types in one map, presets, and queries from Python."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture import KaptureMap, Localizer
from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.metrics import pose_errors
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.datasets import choose_dataset
from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.plan import run_plan
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.run import Run
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.options import PipelineOptions

pytestmark = pytest.mark.slow

SMALL = [
    "local_features.aliked.options.max_keypoints=600",
    "preprocessing.max_size_px=640",
    "global_features.options.num_clusters=16",
]


@pytest.fixture(autouse=True)
def real_weights(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(shared_data / "weights"))


def run(scene: Path, place: Path, options: PipelineOptions) -> Workspace:
    workspace = Workspace(place)
    with workspace.lock():
        run_plan(
            plan_evaluation(Run(choose_dataset("kapture", scene), "modern", options, workspace)),
            workspace,
        )
    return workspace


def test_several_types_are_one_map_and_one_problem(fountain: Path, tmp_path: Path) -> None:
    options = options_of_preset(
        "modern",
        assignments=[
            'local_features=["aliked", "xfeat"]',
            "local_features.xfeat.matching.name=lighterglue",
            "local_features.xfeat.options.max_keypoints=300",
            *SMALL,
        ],
    )
    workspace = run(fountain, tmp_path / "workspace", options)
    seen = workspace.folder("map").observations()
    assert {name for name, some in seen.items() if len(some)} == {"aliked-n16", "xfeat"}
    found = json.loads(workspace.path("evaluation/recall.json").read_text())
    assert found["rows"][-1]["recall"][0]["recall"] == 1.0
    manifest = json.loads(workspace.path("stages/local_features.json").read_text())
    weights = manifest["options"]["weights"]
    assert list(weights) == ["aliked-n16.pth", "xfeat.pt"]
    assert all(len(sha256) == 64 for sha256 in weights.values())
    matching = json.loads(workspace.path("stages/query_matches.json").read_text())["options"]
    assert list(matching["weights"]) == ["xfeat-lighterglue.pt"]


def test_modern_maps_smaller_images_and_localizes_whole_ones(
    fountain: Path, tmp_path: Path
) -> None:
    options = options_of_preset("modern", assignments=SMALL)
    workspace = run(fountain, tmp_path / "workspace", options)
    cameras = workspace.folder("map").read()
    assert {cameras.camera_of(image).width for image in cameras.image_names()} == {640}
    # what is written of the queries is as they were imported
    queries = workspace.folder("localized").read()
    assert {queries.camera_of(image).width for image in queries.image_names()} == {1536}

    opened = KaptureMap.open(workspace.path("map"))
    assert opened.pixel_origin.intrinsics == "corner"
    localizer = Localizer(opened, options=options)
    found = dict(localizer.localize_kapture(fountain / "query"))
    assert all(found.values()), found
    truth = KaptureFolder(fountain / "query_gt").read().poses()
    errors = pose_errors({name: pose.cam_from_world for name, pose in found.items()}, truth)
    assert np.median(errors.position_m) < 0.02

    masked = options_of_preset(
        "modern", assignments=[*SMALL, "preprocessing.masks.unchanging=true"]
    )
    with pytest.raises(OptionError, match=r"Query\(mask=...\)"):
        Localizer(opened, options=masked)


def test_a_given_map_is_not_resized(fountain: Path, tmp_path: Path) -> None:
    options = options_of_preset("modern", assignments=[*SMALL, "map=given+triangulate"])
    with pytest.raises(OptionError, match="keypoints are in the original images"):
        run(fountain, tmp_path / "workspace", options)
