"""RobotCar's twin with its bonnet, people and cars masked: nothing on them, and no worse recall."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from megloc_twins.frames import Frame
from megloc_twins.render import on_bonnet, on_moving_objects
from megloc_twins.robotcar import (
    RobotCarTwinOptions,
    build_robotcar_frames,
)
from megloc_twins.squares import build_place

from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import read_mask_counts
from megloc_kapture.pipeline.datasets import TWIN_PREFIX, choose_dataset, twin_of
from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.executors import open_executor, single_threaded
from megloc_kapture.pipeline.plan import run_plan
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.run import Run, find_benchmark
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.work import Work

pytestmark = pytest.mark.slow

SMALL = {"num_locations": 2, "size_px": 360, "moments_per_condition": 2}
OPTIONS = RobotCarTwinOptions(**SMALL)  # type: ignore[arg-type]
SEED = OPTIONS.world().seed


def localized(folder: Path, changes: Sequence[str]) -> Workspace:
    """The workspace of a finished run."""
    dataset = f"{TWIN_PREFIX}robotcar"
    benchmark = find_benchmark(dataset)
    source = choose_dataset(dataset, None, import_options=benchmark.import_options)
    source = replace(source, twin=twin_of("robotcar", **SMALL))
    cheap = ["local_features.options.max_keypoints=1500", "global_features.options.num_clusters=32"]
    options = options_of_preset(changes=[benchmark.options], assignments=[*cheap, *changes])
    workspace = Workspace(folder)
    with workspace.lock(), single_threaded(), open_executor("processes", 2) as executor:
        run = Run(source, "classic", options, workspace, benchmark)
        run_plan(plan_evaluation(run), workspace, Work(executor))
    return workspace


def shots_of(workspace: Workspace) -> dict[str, Frame]:
    """Image of the workspace to what was drawn."""
    frames = build_robotcar_frames(OPTIONS)
    drawn = {shot.name: shot for shot in (*frames.mapping, *frames.queries)}
    images = [
        name
        for part in ("mapping", "query")
        for name in KaptureFolder(workspace.path(part)).read().image_names()
    ]
    assert set(images) <= set(drawn), (sorted(images)[:3], sorted(drawn)[:3])
    return {name: drawn[name] for name in images}


def recall(workspace: Workspace) -> list[float]:
    found = json.loads(workspace.path("evaluation/recall.json").read_text())
    row = next(row for row in found["rows"] if row["name"] == "all")
    return [at["recall"] for at in row["recall"]]


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return localized(tmp_path_factory.mktemp("plain") / "workspace", [])


@pytest.fixture(scope="module")
def masked(plain: Workspace, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """The bonnet is found by itself, people and cars are masks that a user brings."""
    masks = tmp_path_factory.mktemp("masks")
    places = {place: build_place(OPTIONS.world(), place) for place in range(2)}
    for name, shot in shots_of(plain).items():
        still = ~on_moving_objects(shot, places[shot.place])
        path = masks / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, np.repeat(255 * still[:, :, None].astype(np.uint8), 3, axis=2))
    return localized(
        tmp_path_factory.mktemp("masked") / "workspace",
        [
            "preprocessing.masks.unchanging=true",
            f"preprocessing.masks.user_masks={masks}",
            "mask_margin_px=4",
        ],
    )


def test_no_keypoint_lies_on_the_bonnet_or_on_what_moves(
    plain: Workspace, masked: Workspace
) -> None:
    hidden = {"plain": 0, "masked": 0}
    places = {place: build_place(OPTIONS.world(), place) for place in range(2)}
    for name, shot in shots_of(plain).items():
        covered = on_bonnet(shot, SEED) | on_moving_objects(shot, places[shot.place])
        for label, workspace in (("plain", plain), ("masked", masked)):
            found = workspace.folder("query", "").keypoints("rootsift").read(name)
            column, row = np.floor(found[:, :2]).astype(int).T
            hidden[label] += int(covered[row, column].sum())
    assert hidden["plain"] > 500
    assert hidden["masked"] == 0
    removed = read_mask_counts(masked.root, "rootsift")
    assert sum(removed.values()) > 0.5 * hidden["plain"]


def test_masks_do_not_lower_recall_and_the_report_shows_them(
    plain: Workspace, masked: Workspace
) -> None:
    assert all(a >= b for a, b in zip(recall(masked), recall(plain), strict=True))
    assert "What masks hide" in masked.path("evaluation/report.html").read_text()
    assert "What masks hide" not in plain.path("evaluation/report.html").read_text()
