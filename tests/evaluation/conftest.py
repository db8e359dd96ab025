"""A small world of known poses: what the evaluation tests are run on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from megloc_kapture.io.status_table import QueryStatus
from megloc_kapture.values import RigidTransform


@dataclass
class World:
    """Truth, estimates with known errors, conditions and statuses of some queries."""

    truth: dict[str, RigidTransform] = field(default_factory=dict)
    estimated: dict[str, RigidTransform] = field(default_factory=dict)
    conditions: dict[str, str] = field(default_factory=dict)
    statuses: dict[str, QueryStatus] = field(default_factory=dict)
    mapped: dict[str, RigidTransform] = field(default_factory=dict)


def upright_camera(center: np.ndarray, heading_rad: float) -> RigidTransform:
    """``cam_from_world`` of a level camera in a world whose z points up."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    # rows are the camera's right, down and forward in the world
    rotation = np.array([[s, -c, 0.0], [0.0, 0.0, -1.0], [c, s, 0.0]])
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
    for i in range(60):
        along = 2 * np.pi * i / 60
        center = np.array([20 * np.cos(along), 10 * np.sin(along), 1.6])
        world.mapped[f"map/{i:03d}.jpg"] = upright_camera(center, along)
    for i in range(num_queries):
        condition = "night" if i % 4 == 0 else "day"
        name = f"query/{condition}/{i:05d}.jpg"
        along = rng.uniform(0, 2 * np.pi)
        center = np.array([20 * np.cos(along), 10 * np.sin(along), 1.6]) + rng.normal(size=3)
        world.truth[name] = upright_camera(center, along)
        world.conditions[name] = condition
        if i % 10 == 8:
            world.statuses[name] = QueryStatus(
                image=name, status="failed", reason="6 inliers, 12 needed", num_inliers=6
            )
            continue
        if i % 10 == 4:
            world.statuses[name] = QueryStatus(
                image=name, status="failed", reason="no matches", fallback="retrieval"
            )
            world.estimated[name] = world.mapped[f"map/{i % 60:03d}.jpg"]
            continue
        error = 10 ** rng.normal(-1.5, 0.7)
        shift = rng.normal(size=3)
        shift *= error / np.linalg.norm(shift)
        world.estimated[name] = displaced(world.truth[name], shift, 5 * error)
        world.statuses[name] = QueryStatus(
            image=name, status="localized", num_matches=300, num_inliers=int(rng.integers(12, 250))
        )
    return world


@pytest.fixture
def world() -> World:
    return make_world()


@pytest.fixture
def worlds() -> Callable[..., World]:
    return make_world


@pytest.fixture
def displace() -> Callable[[RigidTransform, np.ndarray, float], RigidTransform]:
    return displaced


@pytest.fixture
def upright() -> Callable[[np.ndarray, float], RigidTransform]:
    return upright_camera
