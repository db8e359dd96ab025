"""The view from above: right plane, not mirrored, no degenerate page."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scored import evaluate_poses, shifted

from megloc_kapture.evaluation.report.figures import views_from_above
from megloc_kapture.evaluation.report.queries import shown_queries, top_view
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.values import RigidTransform


def arrays(poses: Iterable[RigidTransform]) -> tuple[np.ndarray, np.ndarray]:
    quats, translations = stack_poses(poses)
    return quats, camera_centers(quats, translations)


def turned(world: Any, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same cameras in a world turned by ``rotation``."""
    turn = RigidTransform.from_matrix(rotation, np.zeros(3))
    return arrays(pose @ turn.inverse() for pose in world.truth.values())


@pytest.mark.parametrize(("axis", "sign"), [(0, 1), (1, -1), (2, 1), (2, -1)])
def test_top_view_along_any_axis_is_not_mirrored(world: Any, axis: int, sign: int) -> None:
    up = np.zeros(3)
    up[axis] = sign
    rotation = Rotation.align_vectors(up[None], np.array([[0.0, 0, 1]]))[0].as_matrix()
    page, labels = top_view(*turned(world, rotation))
    np.testing.assert_allclose(np.cross(*page), up, atol=1e-12)
    assert set(labels) == set("xyz") - {"xyz"[axis]}


def test_top_view_of_a_slanted_world(world: Any) -> None:
    level, labels = top_view(*arrays(world.truth.values()))
    assert labels == ("x", "y")
    np.testing.assert_array_equal(np.array([[1.0, 2.0, 3.0]]) @ level.T, [[1.0, 2.0]])
    rotation = Rotation.from_euler("xyz", [40, 25, 10], degrees=True).as_matrix()
    quats, centers = turned(world, rotation)
    page, labels = top_view(quats, centers)
    np.testing.assert_allclose(np.cross(*page), rotation[:, 2], atol=1e-9)
    assert labels == ("along the map", "across the map")
    # distances on the ground are kept
    flat = centers @ page.T
    ground = np.stack([pose.center()[:2] for pose in world.truth.values()])
    np.testing.assert_allclose(
        np.linalg.norm(flat - flat[0], axis=1), np.linalg.norm(ground - ground[0], axis=1)
    )


def test_frames_have_separate_figures() -> None:
    mapped = {f"DUC1/{i}.jpg": shifted(i) for i in range(5)}
    mapped |= {f"DUC2/{i}.jpg": shifted(1000.0 + i) for i in range(5)}
    frames = {name: name[:4] for name in mapped}
    truth = {"a.jpg": shifted(1.0), "b.jpg": shifted(1002.0), "c.jpg": shifted(1003.0)}
    conditions = {"a.jpg": "DUC1", "b.jpg": "DUC2", "c.jpg": "DUC2"}
    evaluation = evaluate_poses({"a.jpg": shifted(1.5)}, truth, conditions=conditions)
    views = views_from_above(shown_queries(evaluation), mapped, frames, "m")
    assert list(views) == ["DUC1", "DUC2"]
    assert b"truth, no pose" in views["DUC2"] and b"truth, no pose" not in views["DUC1"]
    # without frames there is one view, and without poses or truth none
    assert list(views_from_above(shown_queries(evaluation), mapped, {}, "m")) == [""]
    assert views_from_above([], mapped, {}, "m") == {}
