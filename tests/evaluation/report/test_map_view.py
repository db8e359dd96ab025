"""The view from above: right plane, not mirrored, no degenerate page."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.evaluation.report.document import Heading
from megloc_kapture.evaluation.report.map_view import (
    DrawnQuery,
    top_view,
    views_from_above,
    views_of,
)
from megloc_kapture.evaluation.scoring import evaluate_poses
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.values import RigidTransform


def moved(x: float, quat: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)) -> RigidTransform:
    return RigidTransform(quat, (x, 0.0, 0.0))


def arrays(poses: Iterable[RigidTransform]) -> tuple[np.ndarray, np.ndarray]:
    quats, translations = stack_poses(poses)
    return quats, camera_centers(quats, translations)


def turned(world: Any, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same cameras in a world turned by ``rotation``."""
    turn = RigidTransform.from_matrix(rotation, np.zeros(3))
    return arrays(pose @ turn.inverse() for pose in world.truth.values())


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
    level = top_view(*arrays(world.truth.values()))
    assert level.labels == ("x", "y")
    np.testing.assert_array_equal(level.project(np.array([[1.0, 2.0, 3.0]])), [[1.0, 2.0]])
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
    turn = moved(0.0, (float(np.cos(slant)), float(np.sin(slant)), 0.0, 0.0))
    poses = [upright(np.array([1.0, 2.0, float(i)]), 0.3) @ turn for i in range(count)]
    view = top_view(*arrays(poses))
    page = np.stack([view.right, view.up])
    np.testing.assert_allclose(page @ page.T, np.eye(2), atol=1e-12)


def test_frames_are_drawn_apart() -> None:
    mapped = {f"DUC1/{i}.jpg": moved(i) for i in range(5)}
    mapped |= {f"DUC2/{i}.jpg": moved(1000.0 + i) for i in range(5)}
    frames = {name: name[:4] for name in mapped}
    truth = {"a.jpg": moved(1.0), "b.jpg": moved(1002.0), "c.jpg": moved(1003.0)}
    conditions = {"a.jpg": "DUC1", "b.jpg": "DUC2", "c.jpg": "DUC2"}
    evaluation = evaluate_poses({"a.jpg": moved(1.5)}, truth, conditions=conditions)
    # on one page the two would be a kilometre apart; that nothing lies outside is not worth a word
    blocks = views_of(evaluation, mapped, frames)
    one, first, other, second = blocks
    assert (one, other) == (Heading("DUC1"), Heading("DUC2"))
    assert first.svg.count("<use ") < second.svg.count("<use ") + 20
    assert "truth, no pose" in second.svg and "truth, no pose" not in first.svg
    ids = re.findall(r'\sid="([^"]*)"', first.svg + second.svg)
    assert len(ids) == len(set(ids))


def test_one_frame_needs_no_name(world: Any) -> None:
    evaluation = evaluate_poses(world.estimated, world.truth, conditions=world.conditions)
    (view,) = views_of(evaluation, world.mapped, {})
    # a frame that all images share is one page too
    (again,) = views_of(evaluation, world.mapped, dict.fromkeys(world.mapped, "town"))
    assert again.svg == view.svg


def test_without_truth_estimates_span_the_page_where_there_is_no_map() -> None:
    placed = [DrawnQuery(None, moved(10.0 * i)) for i in range(4)]
    (view,) = views_from_above(placed, {}, {}, with_truth=False)
    assert "truth" not in re.sub(r"<[^>]*>", "", view.svg)
