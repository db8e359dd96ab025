"""RobotCar's twin with its bonnet, people and cars masked: nothing on them, and no worse recall."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from megloc_twins.frames import Frame
from megloc_twins.render import on_bonnet, on_moving_objects
from megloc_twins.robotcar import RobotCarTwinOptions, build_robotcar_frames
from megloc_twins.squares import build_place

from megloc_kapture.io.csv_table import read_csv_table
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import mask_counts_path
from megloc_kapture.pipeline.plan import Workspace
from tests.pipeline.runs import recall, run_twin

SMALL = {"num_locations": 2, "size_px": 360, "moments_per_condition": 2}
OPTIONS = RobotCarTwinOptions(**SMALL)  # type: ignore[arg-type]


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


@pytest.mark.slow
def test_masks_hide_bonnet_and_what_moves_and_do_not_lower_recall(tmp_path: Path) -> None:
    plain, masked = (Workspace(tmp_path / name) for name in ("plain", "masked"))
    run_twin(plain, "robotcar", SMALL)
    places = {place: build_place(OPTIONS.world(), place) for place in range(2)}
    shots = shots_of(plain)
    moving = {name: on_moving_objects(shot, places[shot.place]) for name, shot in shots.items()}
    # the bonnet is found by itself, people and cars are masks that a user brings
    for name, covered in moving.items():
        path = tmp_path / "masks" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, np.repeat(255 * (~covered)[:, :, None].astype(np.uint8), 3, axis=2))
    brought = f"preprocessing.masks.user_masks={tmp_path / 'masks'}"
    changes = ["preprocessing.masks.unchanging=true", brought, "mask_margin_px=4"]
    run_twin(masked, "robotcar", SMALL, changes)

    hidden = {plain.root: 0, masked.root: 0}
    for name, shot in shots.items():
        covered = on_bonnet(shot, OPTIONS.world().seed) | moving[name]
        for workspace in (plain, masked):
            found = workspace.folder("query", "").keypoints("rootsift").read(name)
            column, row = np.floor(found[:, :2]).astype(int).T
            hidden[workspace.root] += int(covered[row, column].sum())
    assert hidden[plain.root] > 500
    assert hidden[masked.root] == 0
    table = read_csv_table(mask_counts_path(masked.root, "rootsift"), ("image", "num_masked"))
    removed = {row["image"]: int(row["num_masked"]) for _, row in table}
    assert sum(removed.values()) > 0.5 * hidden[plain.root]

    assert all(a >= b for a, b in zip(recall(masked), recall(plain), strict=True))
