"""kapture and kapture-localization as oracles: the same figures, the same exported poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import kapture
import kapture.io.csv
import numpy as np
import pytest
from poses import random_pose
from scored import displaced, evaluate_poses
from tools.kapture_export_LTVL2020 import export_ltvl

from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.evaluation.metrics import Threshold, thresholds_from_pairs
from megloc_kapture.evaluation.pose_files import format_pose_file, read_pose_file
from megloc_kapture.geometry.poses import rotation_angles_deg, stack_poses
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import RigidTransform

Poses = dict[str, RigidTransform]
Figures = Callable[..., Any]
Bins = list[tuple[float, float]]
BINS = [(0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0)]


def kapture_of(poses: Poses, images: list[str]) -> kapture.Kapture:
    sensors = kapture.Sensors()
    sensors["camera0"] = kapture.Camera(
        kapture.CameraType.SIMPLE_PINHOLE, [640, 480, 500.0, 320.0, 240.0]
    )
    records, trajectories = kapture.RecordsCamera(), kapture.Trajectories()
    for timestamp, image in enumerate(sorted(images)):
        records[timestamp, "camera0"] = image
        if image in poses:
            quat, translation = poses[image].quat_wxyz, poses[image].translation
            pose = kapture.PoseTransform(list(quat), list(translation))
            trajectories[timestamp, "camera0"] = pose
    return kapture.Kapture(sensors=sensors, records_camera=records, trajectories=trajectories)


def random_poses(count: int, m: float, deg: float, *, missing: int = 0) -> tuple[Poses, Poses]:
    """Return estimated and true poses, with errors of about so many metres and degrees."""
    rng = np.random.default_rng(count + missing)
    truth = {f"q/{i:03d}.jpg": random_pose(rng) for i in range(count)}
    estimated = {
        name: displaced(
            pose, rng.normal(size=3) * m * 10 ** rng.normal(0, 0.5), rng.uniform(0, deg)
        )
        for name, pose in list(truth.items())[missing:]
    }
    return estimated, truth


@pytest.fixture
def figures_of_kapture() -> Figures:
    """kapture-localization's statistics of (estimated, truth, thresholds), and its errors."""
    evaluation = pytest.importorskip(
        "kapture_localization.evaluation",
        reason="the oracle: pip install --no-deps kapture-localization==1.1.10",
    )

    def figures(estimated: Poses, truth: Poses, bins: Bins) -> Any:
        images = sorted(truth)
        results = evaluation.evaluate(
            kapture_of(estimated, images), kapture_of(truth, images), images
        )
        return evaluation.EvaluationStatistics(results, bins), results

    return figures


def assert_equal_figures(estimated: Poses, truth: Poses, bins: Bins, oracle: Figures) -> None:
    statistics, results = oracle(estimated, truth, bins)
    result = evaluate_poses(estimated, truth, thresholds=thresholds_from_pairs(bins))
    row = result.row()
    assert row.num_queries == statistics.number_of_images
    assert row.num_localized == statistics.number_of_localized_positions
    counts = [count for _, _, count in statistics.filled_bins]
    assert [at.num_within for at in row.recall] == counts
    shares = [count / statistics.number_of_images for count in counts]
    assert [at.recall for at in row.recall] == pytest.approx(shares, abs=1e-9)
    assert all(at.low <= at.recall <= at.high for at in row.recall)
    ours = (
        *(row.median_position_m, row.median_angle_deg),
        *(row.median_localized_position_m, row.median_localized_angle_deg),
    )
    theirs = (
        *(statistics.median_all_positions, statistics.median_all_rotations),
        *(statistics.median_localized_positions, statistics.median_localized_rotations),
    )
    assert ours == pytest.approx(theirs, abs=1e-9)
    assert list(result.errors.names) == [name for name, _, _ in results]
    theirs_by_query = np.nan_to_num([errors for _, *errors in results], nan=np.inf)
    np.testing.assert_allclose(result.errors.position_m, theirs_by_query[:, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.errors.angle_deg, theirs_by_query[:, 1], rtol=0, atol=1e-9)


@pytest.mark.parametrize("num_missing", [0, 21, 40])
def test_equal_on_random_poses(num_missing: int, figures_of_kapture: Figures) -> None:
    estimated, truth = random_poses(40, 0.2, 9.0, missing=num_missing)
    assert_equal_figures(estimated, truth, BINS, figures_of_kapture)


def test_equal_at_exact_thresholds(figures_of_kapture: Figures) -> None:
    truth, estimated = {}, {}
    for i, (position_m, angle_deg) in enumerate(BINS):
        half = np.deg2rad(angle_deg) / 2
        truth[f"{i}.jpg"] = RigidTransform.identity()
        estimated[f"{i}.jpg"] = RigidTransform(
            (float(np.cos(half)), 0.0, 0.0, float(np.sin(half))), (0.0, 0.0, position_m)
        )
    statistics, _ = figures_of_kapture(estimated, truth, BINS)
    # by hand: each query meets its own bounds; (0.05, 5) misses 2 deg, the last one nearly all
    assert [count for _, _, count in statistics.filled_bins] == [1, 1, 3, 4]
    assert_equal_figures(estimated, truth, BINS, figures_of_kapture)


@pytest.mark.parametrize("share", [1 - 1e-9, 1 + 1e-9])
def test_equal_near_every_measured_error(share: float, figures_of_kapture: Figures) -> None:
    # each query's own errors as kapture computes them are a threshold, but for the last bits, which
    # differ between processors: a figure that is off by more gains or loses a query
    estimated, truth = random_poses(60, 1.0, 20.0)
    _, results = figures_of_kapture(estimated, truth, BINS)
    bins = [(float(metres) * share, float(degrees) * share) for _, metres, degrees in results]
    assert_equal_figures(estimated, truth, bins, figures_of_kapture)


def test_equal_without_rotation(figures_of_kapture: Figures) -> None:
    # MLAD's thresholds: kapture leaves the rotation out where its bound is negative
    estimated, truth = random_poses(50, 0.2, 90.0, missing=4)
    _, results = figures_of_kapture(estimated, truth, BINS)
    # thresholds that single queries just meet
    errors = [float(position_m) for _, position_m, _ in results if np.isfinite(position_m)]
    bounds = [(1 + 1e-9) * error for error in errors[:8]]
    statistics, _ = figures_of_kapture(estimated, truth, [(bound, -1.0) for bound in bounds])
    thresholds = thresholds_from_pairs((bound, None) for bound in bounds)
    row = evaluate_poses(estimated, truth, thresholds=thresholds).row()
    assert [at.num_within for at in row.recall] == [count for _, _, count in statistics.filled_bins]
    assert len({at.num_within for at in row.recall}) == len(bounds)


@pytest.fixture
def localized(world: Any, tmp_path: Path) -> Path:
    folder = tmp_path / "localized"
    kapture.io.csv.kapture_to_dir(str(folder), kapture_of(world.estimated, list(world.truth)))
    return folder


@pytest.mark.parametrize(("names", "full"), [("basename", False), ("full", True)])
def test_equal_to_kaptures_export(names: Any, full: bool, localized: Path, tmp_path: Path) -> None:
    theirs_path, ours_path = tmp_path / "theirs.txt", tmp_path / "ours.txt"
    export_ltvl(str(localized), str(theirs_path), full, False, False, False)
    ours_path.write_text(format_pose_file(KaptureFolder(localized).read().poses(), names=names))
    ours, theirs = read_pose_file(ours_path), read_pose_file(theirs_path)
    assert len(ours) == 36 and sorted(ours) == sorted(theirs)
    quats, translations = stack_poses(ours[name] for name in ours)
    their_quats, their_translations = stack_poses(theirs[name] for name in ours)
    np.testing.assert_allclose(translations, their_translations, rtol=0, atol=1e-12)
    assert rotation_angles_deg(quats, their_quats).max() < 1e-10


def test_folders_of_kapture_are_evaluated(world: Any, localized: Path, tmp_path: Path) -> None:
    truth = tmp_path / "query_gt"
    kapture.io.csv.kapture_to_dir(str(truth), kapture_of(world.truth, list(world.truth)))
    result = evaluate(localized, truth)
    expected = evaluate_poses(world.estimated, world.truth).errors.position_m
    assert result.row().num_queries == 40
    np.testing.assert_allclose(result.errors.position_m, expected, rtol=0, atol=1e-9)
    assert result.thresholds[1] == Threshold(position_m=0.25, angle_deg=2.0)
