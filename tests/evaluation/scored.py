"""Worlds of known poses, their evaluation in memory."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from megloc_kapture.evaluation import scoring
from megloc_kapture.evaluation.results import Result
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.io.dataset_tables import ImageGroup, Protocol, SideTables
from megloc_kapture.io.kapture import write_sensors
from megloc_kapture.values import Camera, LocalizationResult, RigidTransform
from tests.worlds import one_camera

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))


@dataclass
class World:
    """Truth, estimates with known errors, conditions and statuses of some queries."""

    truth: dict[str, RigidTransform] = field(default_factory=dict)
    estimated: dict[str, RigidTransform] = field(default_factory=dict)
    conditions: dict[str, str] = field(default_factory=dict)
    statuses: dict[str, LocalizationResult] = field(default_factory=dict)


def shifted(x_m: float) -> RigidTransform:
    """A camera at ``-x_m`` that looks along z."""
    return RigidTransform((1.0, 0.0, 0.0, 0.0), (x_m, 0.0, 0.0))


def upright_camera(
    center: np.ndarray, heading_rad: float, pitch_rad: float = 0.0
) -> RigidTransform:
    """``cam_from_world`` of a camera without roll in a world whose z points up."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    forward = np.cos(pitch_rad) * np.array([c, s, np.tan(pitch_rad)])
    right = np.array([s, -c, 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    return RigidTransform.from_matrix(rotation, -rotation @ center)


def displaced(pose: RigidTransform, shift_m: np.ndarray, angle_deg: float) -> RigidTransform:
    """The camera moved by ``shift_m`` in the world and turned by ``angle_deg`` about its axis."""
    half = np.deg2rad(angle_deg) / 2
    turn = RigidTransform((float(np.cos(half)), 0.0, 0.0, float(np.sin(half))), (0.0, 0.0, 0.0))
    rotation = (turn @ RigidTransform(pose.quat_wxyz, (0.0, 0.0, 0.0))).rotation_matrix()
    return RigidTransform.from_matrix(rotation, -rotation @ (pose.center() + shift_m))


def make_world(num_queries: int = 40, seed: int = 0) -> World:
    rng = np.random.default_rng(seed)
    world = World()

    def on_ring(along: float) -> np.ndarray:
        return np.array([20 * np.cos(along), 10 * np.sin(along), 1.6])

    for i in range(num_queries):
        condition = "night" if i % 4 == 0 else "day"
        name = f"query/{condition}/{i:05d}.jpg"
        along = rng.uniform(0, 2 * np.pi)
        world.truth[name] = upright_camera(on_ring(along) + rng.normal(size=3), along)
        world.conditions[name] = condition
        if i % 10 == 8:
            fields = {"reason": "6 inliers, 12 needed", "num_inliers": 6}
        elif i % 10 == 4:
            fields = {"reason": "no matches", "fallback": "retrieval"}
            world.estimated[name] = upright_camera(on_ring(i / 10), i / 10)
        else:
            error = 10 ** rng.normal(-1.5, 0.7)
            shift = rng.normal(size=3)
            shift *= error / np.linalg.norm(shift)
            world.estimated[name] = displaced(world.truth[name], shift, 5 * error)
            inliers = int(rng.integers(12, 250))
            fields = {"num_matches": 300, "num_inliers": inliers}
        counts = {"num_matches": 0, "num_inliers": 0}
        world.statuses[name] = LocalizationResult(name=name, **counts | fields)
    return world


def write_kapture(
    root: Path, images: Sequence[str], poses: Mapping[str, RigidTransform], camera: Camera = CAMERA
) -> Path:
    """A kapture folder of one camera: all ``images`` recorded, ``poses`` as trajectories."""
    write_sensors(root, one_camera(sorted(images), poses, camera=camera))
    return root


def evaluate_poses(
    estimated: Mapping[str, RigidTransform],
    truth: Mapping[str, RigidTransform],
    *,
    label: str = "",
    conditions: Mapping[str, str] | None = None,
    scored: Collection[str] | None = None,
    thresholds: Sequence[Any] | None = None,
    nowhere: Collection[str] = (),
    **options: Any,
) -> Evaluation:
    """``options`` are statuses and covariances by image."""
    groups = {
        image: ImageGroup(
            condition=(conditions or {}).get(image, ""), scored=scored is None or image in scored
        )
        for image in {*estimated, *truth, *nowhere}
    }
    result = Result(label, estimated, tuple(sorted(estimated)), **options)
    limits = {"thresholds": [(t.position_m, t.angle_deg) for t in thresholds]} if thresholds else {}
    benchmark = SideTables(protocol=Protocol(**limits), groups=groups)
    return scoring.evaluate_poses(result, truth, benchmark, nowhere=nowhere)


def evaluation_of(world: World, label: str = "") -> Evaluation:
    options = {"conditions": world.conditions, "statuses": world.statuses}
    return evaluate_poses(world.estimated, world.truth, label=label, **options)
