"""Time writing, checking and evaluating the poses of a whole benchmark.

    python benchmarks/speed/evaluation.py [--queries 12000] [--map-images 20862]

A synthetic dataset is generated deterministically: a map along a street and nearby queries with
true and estimated poses. Conditions, names and thresholds are those of RobotCar Seasons. Each step
runs once in this process, after all imports.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from timing import Timed, table

from megloc_kapture.evaluation.check import check_submission, read_reference
from megloc_kapture.evaluation.comparison import compare
from megloc_kapture.evaluation.evaluate import evaluate_results
from megloc_kapture.evaluation.pose_files import write_pose_file
from megloc_kapture.evaluation.protocols import benchmark_of, protocol_of
from megloc_kapture.evaluation.report.reports import report_text, write_report
from megloc_kapture.evaluation.results import context_of
from megloc_kapture.geometry.poses import unstack_poses
from megloc_kapture.io.dataset_tables import ImageGroup, write_groups, write_names, write_protocol
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.io.tables import STATUS_FILE, write_status
from megloc_kapture.values import Camera, LocalizationResult, RigidTransform

CANDIDATES = 20
FIRST_TIME_US = 1_417_176_458_000_000

T = TypeVar("T")
Poses = dict[str, RigidTransform]


def timed(steps: list[Timed], name: str, work: Callable[[], T]) -> T:
    """Run one step and append its wall-clock and CPU seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    steps.append(Timed(name, time.perf_counter() - wall, time.process_time() - cpu))
    return result


def street_poses(along_m: np.ndarray, spread: float, rng: np.random.Generator) -> np.ndarray:
    """Return (N, 7) quaternions and translations of upright cameras looking along a street."""
    heading = np.sin(along_m / 200.0) + rng.normal(0.0, 0.05 * spread, len(along_m))
    # camera axes: x right, y down, z forward; world: z up
    right = np.stack([np.sin(heading), -np.cos(heading), 0 * heading], axis=1)
    forward = np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1)
    down = np.tile([0.0, 0.0, -1.0], (len(heading), 1))
    rotations = np.stack([right, down, forward], axis=1)
    centers = np.stack(
        [along_m, 40.0 * np.sin(along_m / 150.0), np.full(len(along_m), 1.6)], axis=1
    ) + rng.normal(0.0, spread, (len(along_m), 3)) * [1.0, 1.0, 0.1]
    transforms = [
        RigidTransform.from_matrix(rotation, -rotation @ center)
        for rotation, center in zip(rotations, centers, strict=True)
    ]
    return np.array([(*pose.quat_wxyz, *pose.translation) for pose in transforms])


def write_part(folder: Path, names: list[str], poses: Poses) -> None:
    """Write a kapture folder with one camera."""
    camera = Sensor.from_camera(Camera("PINHOLE", 1024, 1024, (400.0, 400.0, 508.2, 498.2)))
    keys = {name: (FIRST_TIME_US + 91_000 * i, "rear") for i, name in enumerate(names)}
    data = KaptureData(
        sensors={"rear": camera},
        rigs={},
        trajectories={keys[name]: poses[name] for name in names if name in poses},
        records_camera={key: name for name, key in keys.items()},
    )
    write_sensors(folder, data)


def generate(workspace: Path, num_queries: int, num_map_images: int) -> Poses:
    """Write the dataset with a good and a worse result; return the poses of the good one."""
    rng = np.random.default_rng(0)
    protocol = protocol_of("robotcar")
    along = np.sort(rng.uniform(0.0, 8000.0, num_map_images))
    mapped = street_poses(along, 0.1, rng)
    map_names = [f"overcast-reference/rear/{FIRST_TIME_US + i}.jpg" for i in range(num_map_images)]
    nearest = rng.integers(num_map_images, size=num_queries)
    truth = street_poses(along[nearest], 1.0, rng)
    conditions = [protocol.conditions[i % len(protocol.conditions)] for i in range(num_queries)]
    names = [f"{c}/rear/{2 * FIRST_TIME_US + i}.jpg" for i, c in enumerate(conditions)]
    results = []
    for share_wrong in (0.1, 0.13):
        estimated = truth.copy()
        estimated[:, 4:] += rng.normal(0.0, 0.1, (num_queries, 3))
        wrong = rng.random(num_queries) < share_wrong
        estimated[wrong] = mapped[rng.integers(num_map_images, size=int(wrong.sum()))]
        poses = unstack_poses(estimated[:, :4], estimated[:, 4:])
        kept = rng.random(num_queries) < 0.97
        results.append({n: p for n, p, keep in zip(names, poses, kept, strict=True) if keep})
    map_poses = dict(zip(map_names, unstack_poses(mapped[:, :4], mapped[:, 4:]), strict=True))
    true_poses = dict(zip(names, unstack_poses(truth[:, :4], truth[:, 4:]), strict=True))
    write_part(workspace / "mapping", map_names, map_poses)
    write_part(workspace / "query", names, {})
    write_part(workspace / "query_gt", names, true_poses)
    for part, poses_of_part in zip(("localized", "worse"), results, strict=True):
        write_part(workspace / part, names, poses_of_part)
    statuses = []
    for i, name in enumerate(names):
        candidates = np.clip(
            nearest[i] + np.arange(CANDIDATES) - CANDIDATES // 2, 0, num_map_images - 1
        )
        localized = name in results[0]
        statuses.append(
            LocalizationResult(
                name=name,
                reason="" if localized else "6 inliers, 12 needed",
                num_matches=300,
                num_inliers=20 + i % 200 if localized else 6,
                candidates=tuple(map_names[k] for k in candidates),
            )
        )
    write_status(workspace / "localized" / STATUS_FILE, statuses)
    tables = workspace / "megloc"
    write_protocol(tables, protocol)
    groups = {n: ImageGroup(condition=c) for n, c in zip(names, conditions, strict=True)}
    write_groups(tables, groups)
    write_names(tables, {n: f"rear/{n.rsplit('/', 1)[-1]}" for n in names})
    return results[0]


def measure(workspace: Path, num_queries: int, num_map_images: int) -> list[Timed]:
    steps: list[Timed] = []
    estimated = generate(workspace, num_queries, num_map_images)
    rules = benchmark_of(workspace / "megloc")
    poses, truth = workspace / "poses.txt", workspace / "query_gt"
    localized, worse = workspace / "localized", workspace / "worse"
    timed(
        steps, "write the pose file", lambda: write_pose_file(poses, estimated, names=rules.names)
    )
    timed(
        steps,
        "check the pose file against the map",
        lambda: check_submission(
            poses, dataset="robotcar", reference=read_reference(workspace)
        ).lines(),
    )
    timed(
        steps,
        "evaluate the pose file",
        lambda: report_text(evaluate_results([poses], truth, rules)[0]),
    )
    (evaluation,) = timed(
        steps, "evaluate the kapture folder", lambda: evaluate_results([localized], truth, rules)
    )
    timed(
        steps,
        "write tables and report",
        lambda: write_report(workspace / "out", replace(evaluation, context=context_of(localized))),
    )
    timed(
        steps,
        "evaluate and compare two folders",
        lambda: report_text(compare(evaluate_results([localized, worse], truth, rules))),
    )
    return steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--queries", type=int, default=12_000)
    parser.add_argument("--map-images", type=int, default=20_862)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        steps = measure(Path(folder), options.queries, options.map_images)
    rows = [(f"{options.queries} queries, {options.map_images} map images", "s", "processor s")]
    rows += [(step.name, f"{step.wall_s:.2f}", f"{step.cpu_s:.2f}") for step in steps]
    print(table(rows))


if __name__ == "__main__":
    main()
