"""The view from above: right plane, not mirrored, and no degenerate page."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.evaluation.top_view import top_view
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.values import RigidTransform


def arrays(world: Any) -> tuple[np.ndarray, np.ndarray]:
    quats, translations = stack_poses(world.truth.values())
    return quats, camera_centers(quats, translations)


def turned(world: Any, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same cameras in a world turned by ``rotation``."""
    turn = RigidTransform.from_matrix(rotation, np.zeros(3))
    poses = [pose @ turn.inverse() for pose in world.truth.values()]
    quats, translations = stack_poses(poses)
    return quats, camera_centers(quats, translations)


def test_a_world_with_z_up_is_seen_in_x_and_y(world: Any) -> None:
    view = top_view(*arrays(world))
    assert view.labels == ("x", "y")
    np.testing.assert_array_equal(view.project(np.array([[1.0, 2.0, 3.0]])), [[1.0, 2.0]])


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_any_axis_may_be_up_and_the_page_is_not_mirrored(world: Any, axis: int, sign: int) -> None:
    up = np.zeros(3)
    up[axis] = sign
    rotation = Rotation.align_vectors(up[None], np.array([[0.0, 0, 1]]))[0].as_matrix()
    view = top_view(*turned(world, rotation))
    np.testing.assert_allclose(np.cross(view.right, view.up), up, atol=1e-12)
    assert set(view.labels) == set("xyz") - {"xyz"[axis]}


def test_a_slanted_world_is_seen_along_its_own_vertical(world: Any) -> None:
    rotation = Rotation.from_euler("xyz", [40, 25, 10], degrees=True).as_matrix()
    quats, centers = turned(world, rotation)
    view = top_view(quats, centers)
    np.testing.assert_allclose(np.cross(view.right, view.up), rotation[:, 2], atol=1e-9)
    assert view.labels == ("along the map", "across the map")
    # distances on the ground are kept
    flat = view.project(centers)
    ground = np.stack([pose.center()[:2] for pose in world.truth.values()])
    np.testing.assert_allclose(
        np.linalg.norm(flat - flat[0], axis=1), np.linalg.norm(ground - ground[0], axis=1)
    )


def test_cameras_that_agree_on_no_vertical_are_seen_where_they_spread() -> None:
    rng = np.random.default_rng(0)
    quats = Rotation.random(200, rng=rng).as_quat(scalar_first=True)
    centers = rng.normal(size=(200, 3)) * [30.0, 0.1, 20.0]
    view = top_view(quats, centers)
    assert set(view.labels) == {"x", "z"}


@pytest.mark.parametrize("slant", [0.0, 0.7])
@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_few_cameras_on_one_vertical_line(
    upright: Callable[..., RigidTransform], count: int, slant: float
) -> None:
    turn = RigidTransform((float(np.cos(slant)), float(np.sin(slant)), 0.0, 0.0), (0.0, 0.0, 0.0))
    poses = [upright(np.array([1.0, 2.0, float(i)]), 0.3) @ turn for i in range(count)]
    quats, translations = stack_poses(poses)
    view = top_view(quats, camera_centers(quats, translations))
    page = np.stack([view.right, view.up])
    np.testing.assert_allclose(page @ page.T, np.eye(2), atol=1e-12)
