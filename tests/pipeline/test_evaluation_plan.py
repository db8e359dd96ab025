"""Refinement is turned on and off in one workspace."""

from __future__ import annotations

from pathlib import Path

import pandas
import pytest

from megloc_kapture.pipeline.datasets import choose_dataset
from megloc_kapture.pipeline.evaluation_plan import Run, plan_evaluation
from megloc_kapture.pipeline.plan import Workspace, run_plan
from megloc_kapture.pipeline.presets import options_of_preset
from tests.pipeline.runs import run_in


def folder_bytes(root: Path) -> dict[str, bytes]:
    files = (path for path in root.rglob("*") if path.is_file() and not path.is_symlink())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


@pytest.mark.slow
def test_refinement_is_turned_on_and_off_in_one_workspace(fountain: Path, tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "workspace")
    plain_options = options_of_preset(
        assignments=[
            "local_features.options.max_keypoints=400",
            "preprocessing.max_size_px=400",
            "global_features.options.num_clusters=8",
        ]
    )
    run_in(workspace, fountain, plain_options)
    plain = folder_bytes(workspace.path("localized"))
    refined = plain_options.model_validate(
        {**plain_options.model_dump(), "pose_refinement": {"by": ["rendering"]}}
    )
    for options in (refined, plain_options, refined):
        stages = plan_evaluation(Run(choose_dataset("kapture", fountain), "classic", options))
        outputs = [output for stage in stages for output in stage.writes]
        assert len(outputs) == len(set(outputs))
        with workspace.lock():
            run_plan(stages, workspace)
        table = pandas.read_csv(workspace.path("localized/status.csv"), keep_default_na=False)
        said = set(table["refinement"])
        if options is refined:
            reason = "no map image with depth overlaps with images from other viewpoints"
            assert said == {f"rendering: {reason}"}
            assert folder_bytes(workspace.path("localized_unrefined")) == plain
        else:
            assert said == {""}
            assert folder_bytes(workspace.path("localized")) == plain
            assert not workspace.path("localized_unrefined").exists()
