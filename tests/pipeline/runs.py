"""Runs of commands in this process, and of ``megloc eval`` from Python."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture import Failure, Pose
from megloc_kapture.cli.main import main
from megloc_kapture.geometry.poses import movement
from megloc_kapture.pipeline.datasets import (
    KAPTURE,
    TWIN_PREFIX,
    BenchmarkFile,
    DatasetChoice,
    choose_dataset,
    find_benchmark,
    twin_of,
)
from megloc_kapture.pipeline.evaluation_plan import Run, plan_evaluation
from megloc_kapture.pipeline.executors import open_executor, single_threaded
from megloc_kapture.pipeline.plan import Manifest, StageReport, Workspace, run_plan
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.work import Work
from megloc_kapture.values import RigidTransform


def run_command(*arguments: str | Path) -> None:
    """Run ``megloc`` in this process; it must succeed."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    assert end.value.code == 0, arguments


def run_in(
    workspace: Workspace,
    source: Path | DatasetChoice,
    options: PipelineOptions,
    *,
    workers: int = 1,
    benchmark: BenchmarkFile | None = None,
    **how: Any,
) -> dict[str, StageReport]:
    """Run the stages of a scene or a dataset; return their reports by name."""
    chosen = choose_dataset("kapture", source) if isinstance(source, Path) else source
    run = Run(chosen, "classic", options, benchmark or BenchmarkFile(dataset=KAPTURE))
    with workspace.lock(), single_threaded(), open_executor("processes", workers) as executor:
        reports = run_plan(plan_evaluation(run), workspace, Work(executor), **how)
    return {report.name: report for report in reports}


def evaluated(
    root: Path, source: Path | DatasetChoice, options: PipelineOptions, **how: Any
) -> Workspace:
    workspace = Workspace(root)
    run_in(workspace, source, options, **how)
    return workspace


def run_twin(workspace: Workspace, name: str, world: dict[str, Any]) -> dict[str, StageReport]:
    """Run a small twin of a dataset with its benchmark file, in two processes."""
    dataset = f"{TWIN_PREFIX}{name}"
    benchmark = find_benchmark(dataset)
    source = choose_dataset(dataset, None, import_options=benchmark.import_options)
    source = replace(source, twin=twin_of(name, **world))
    few = ["local_features.options.max_keypoints=1500", "global_features.options.num_clusters=32"]
    options = options_of_preset(changes=[benchmark.options], assignments=few)
    return run_in(workspace, source, options, workers=2, benchmark=benchmark)


def errors(found: Pose | Failure, truth: RigidTransform | None) -> tuple[float, float]:
    """Return the pose error in metres and degrees."""
    assert isinstance(found, Pose) and truth is not None, found
    return movement(truth, found.cam_from_world)


def manifest(stage: str, **changes: Any) -> Manifest:
    content: dict[str, Any] = {"options": {}, "inputs": {}, "outputs": (), "versions": {}}
    content |= {"seconds": 1.5, "started": "2024-01-01T00:00:00"}
    mark = f"print of {stage}"
    content |= {"version": 1, "fingerprint": mark, "output": mark, **changes}
    return Manifest(stage=stage, **content)
