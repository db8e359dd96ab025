"""Which of the map's depth is put together around a query."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from megloc_kapture.plugins import DepthView
from megloc_kapture.refinement.depth_cloud import DepthCloudOptions, depth_cloud
from megloc_kapture.refinement.icp_map_cloud import MapCloudOptions, map_cloud
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
OPTIONS = MapCloudOptions(DepthCloudOptions(), max_references=2, voxel_m=0.05, margin_m=0.3)
QUERY = DepthView(CAMERA, np.full((48, 64), 2.0, np.float32), RigidTransform.identity())


def shifted(x: float, z: float = 0.0) -> RigidTransform:
    """A camera at (x, 0, z) that looks along z."""
    return RigidTransform((1.0, 0.0, 0.0, 0.0), (-x, 0.0, -z))


@dataclass
class Scene:
    """Every image sees a wall at z = 2, and one with an x of its own can be told by it."""

    poses: dict[str, RigidTransform]
    points: np.ndarray | None = None

    def map_depth(self, name: str) -> DepthView | None:
        if self.points is not None:
            return None
        depth = 2.0 - self.poses[name].center()[2]
        return DepthView(CAMERA, np.full((48, 64), depth, np.float32), RigidTransform.identity())

    def map_mask(self, name: str) -> None:
        return None

    def map_camera(self, name: str) -> Camera:
        return CAMERA

    def map_pose(self, name: str) -> RigidTransform:
        return self.poses[name]

    def map_points(self, name: str) -> np.ndarray:
        assert self.points is not None
        return self.points


def cloud_of(scene: Any, references: list[str]) -> np.ndarray:
    points = depth_cloud(QUERY)
    return map_cloud(QUERY, points, RigidTransform.identity(), references, scene, OPTIONS)


def test_those_that_overlap_most_one_of_each_view() -> None:
    scene = Scene(
        {
            "beside": shifted(1.8),
            "near": shifted(0.3),
            "same": shifted(0.35),
            "left": shifted(-0.5),
            "away": shifted(9.0),
        }
    )
    found = cloud_of(scene, list(scene.poses))
    # near and left: a wall from -0.5 - 1.07 m to 0.3 + 1.07 m, of which the query's box takes all
    assert found[:, 0].min() == pytest.approx(-1.37, abs=0.06)
    assert found[:, 0].max() == pytest.approx(1.37, abs=0.06)
    np.testing.assert_allclose(found[:, 2], 2.0, atol=1e-6)
    only = cloud_of(scene, ["beside", "near", "same", "away"])
    np.testing.assert_array_equal(only, cloud_of(scene, ["near", "beside"]))


def test_depth_that_contradicts_the_querys_is_no_overlap() -> None:
    """A wall in another room, seen through ours."""
    behind = Scene({"behind": shifted(0.0, z=-1.0)})
    behind.map_depth = lambda name: DepthView(  # type: ignore[method-assign]
        CAMERA, np.full((48, 64), 3.9, np.float32), RigidTransform.identity()
    )
    assert cloud_of(behind, ["behind"]).shape == (0, 3)


def test_points_where_no_reference_has_depth() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-5.0, 5.0, (5000, 3))
    scene = Scene({"a": shifted(0.0), "b": shifted(1.0)}, points)
    found = cloud_of(scene, ["a", "b"])
    query = depth_cloud(QUERY)
    low, high = query.min(axis=0) - 0.3, query.max(axis=0) + 0.3
    inside = ((points >= low) & (points <= high)).all(axis=1)
    # each point once, although both images observe it
    assert len(found) == inside.sum() > 0
    assert cloud_of(scene, []).shape == (0, 3)
