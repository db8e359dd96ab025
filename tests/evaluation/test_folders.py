"""Evaluation from disk: kapture folders, pose files, side tables."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.folders import evaluate_folders, load_poses
from megloc_kapture.evaluation.pose_file import write_pose_file
from megloc_kapture.evaluation.thresholds import Threshold
from megloc_kapture.io.kapture_store import KaptureData, Sensor, write_sensors
from megloc_kapture.io.side_tables import (
    ImageGroup,
    Protocol,
    SimilarityTransform,
    World,
    write_groups,
    write_protocol,
    write_world,
)
from megloc_kapture.io.status_table import write_status
from megloc_kapture.values import Camera, RigidTransform


@pytest.fixture
def truth(world: Any, tmp_path: Path, kaptures: Callable[..., Path]) -> Path:
    return kaptures(tmp_path / "query_gt", list(world.truth), world.truth)


@pytest.fixture
def result(world: Any, tmp_path: Path, kaptures: Callable[..., Path]) -> Path:
    folder = kaptures(tmp_path / "localized", list(world.truth), world.estimated)
    write_status(folder / "status.csv", world.statuses.values())
    return folder


def test_statuses_and_side_tables_are_used(
    world: Any, result: Path, truth: Path, tmp_path: Path
) -> None:
    unscored = sorted(world.truth)[0]
    groups = {
        name: ImageGroup(condition=condition, scored=name != unscored)
        for name, condition in world.conditions.items()
    }
    write_groups(tmp_path, groups)
    write_protocol(
        tmp_path,
        Protocol(
            thresholds=((0.1, None),),
            conditions=("night", "day"),
            pools={"any light": ("day", "night")},
        ),
    )
    evaluation = evaluate_folders(result, truth, side_tables=tmp_path, label="x")
    assert [row.name for row in evaluation.rows] == ["night", "day", "any light", "all"]
    assert evaluation.thresholds == (Threshold(position_m=0.1),)
    assert evaluation.not_scored == (unscored,)
    assert evaluation.row().num_queries == 39
    assert evaluation.row().num_fallback == 4
    other = evaluate_folders(
        result, truth, side_tables=tmp_path, thresholds=[Threshold(position_m=1.0)]
    )
    assert other.thresholds == (Threshold(position_m=1.0),)


def test_without_side_tables(result: Path, truth: Path) -> None:
    evaluation = evaluate_folders(result, truth)
    assert [row.name for row in evaluation.rows] == ["all"]
    assert len(evaluation.thresholds) == 4


def test_a_pose_file_gives_the_figures_of_its_folder(
    world: Any, result: Path, truth: Path, tmp_path: Path
) -> None:
    pose_file = tmp_path / "poses.txt"
    write_pose_file(pose_file, world.estimated, names="basename")
    from_file, from_folder = evaluate_folders(pose_file, truth), evaluate_folders(result, truth)
    np.testing.assert_array_equal(from_file.errors.position_m, from_folder.errors.position_m)
    assert from_file.without_truth == ()


def test_a_pose_file_in_the_official_frame_is_brought_back(
    world: Any, truth: Path, tmp_path: Path
) -> None:
    similarity = SimilarityTransform(
        quat_wxyz=(0.8, 0.0, 0.6, 0.0), translation=(4.1e6, 8.6e5, 4.7e6), scale=2.0
    )
    official = World(official_from_local=similarity)
    write_world(tmp_path, official)
    poses = {name: official.pose_in_official(pose) for name, pose in world.truth.items()}
    write_pose_file(tmp_path / "poses.txt", poses)
    evaluation = evaluate_folders(tmp_path / "poses.txt", truth, side_tables=tmp_path)
    assert evaluation.errors.position_m.max() < 1e-6
    # the guard: left where it is, the file is thousands of kilometres off
    assert evaluate_folders(tmp_path / "poses.txt", truth).errors.position_m.min() > 1e6


def test_rigs_are_resolved(tmp_path: Path, world: Any) -> None:
    name = sorted(world.truth)[0]
    offset = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0))
    camera = Sensor.from_camera(Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0)))
    data = KaptureData(
        sensors={"left": camera},
        rigs={"car": {"left": offset}},
        trajectories={(3, "car"): offset.inverse() @ world.truth[name]},
        records_camera={(3, "left"): name},
        records_depth={},
    )
    write_sensors(tmp_path / "rig", data)
    found = load_poses(tmp_path / "rig")
    np.testing.assert_allclose(found[name].center(), world.truth[name].center(), atol=1e-9)


def test_absent_results_are_named(truth: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere"):
        evaluate_folders(tmp_path / "nowhere", truth)
    with pytest.raises(DataError, match="nowhere"):
        evaluate_folders(truth, tmp_path / "nowhere")
