"""ICP on rendered depth with exact poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import room
from corner import pose_at
from numpy.typing import NDArray
from poses import displaced, pose_errors, rigid
from pydantic import ValidationError
from scenes import Scene

from megloc_kapture.plugins import DepthView, PoseRefinement
from megloc_kapture.refinement import icp
from megloc_kapture.refinement.icp import Icp, IcpOptions, map_cloud
from megloc_kapture.refinement.icp_surface import depth_cloud
from megloc_kapture.values import Camera, RigidTransform

COLOUR = Camera("PINHOLE", 640, 480, (525.0, 525.0, 320.0, 240.0))
DEPTH = Camera("PINHOLE", 240, 180, (219.0, 219.0, 120.0, 90.0))
IDENTITY = RigidTransform.identity()
WALL_CAMERA = Camera("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
WALL_OPTIONS = IcpOptions(voxels_m=(0.05,), max_distances_m=(0.3,))
WALL_QUERY = DepthView(WALL_CAMERA, np.full((48, 64), 2.0, np.float32), IDENTITY)
OFFSET = rigid(np.radians([0.5, -1.5, 0.3]), [-0.06, 0.004, 0.01])


QUERY = pose_at((0.1, -0.2, -1.4), 10, 10)
REFERENCES = {
    "map/a.png": pose_at((-0.4, -0.1, -1.7), 4, 8),
    "map/b.png": pose_at((0.6, -0.3, -1.5), 22, 14),
    "map/c.png": pose_at((0.2, -0.6, -1.8), 12, 16),
    "map/d.png": pose_at((-0.7, -0.2, -0.9), -4, 12),
    "map/e.png": pose_at((0.8, 0.1, -1.0), 30, 6),
}


def sensed(
    image_from_world: RigidTransform, image_from_depth: RigidTransform, seed: int
) -> DepthView:
    """Render depth with a Kinect's noise, single pixels without depth, and three large holes."""
    exact = room.render(image_from_depth.inverse() @ image_from_world, camera=DEPTH).depth_m
    rng = np.random.default_rng(seed)
    deviation = 0.0012 + 0.0019 * (exact - 0.4) ** 2
    depth = np.where(exact > 0, exact + deviation * rng.standard_normal(exact.shape), 0.0)
    depth[rng.random(depth.shape) < 0.05] = 0.0
    for _ in range(3):
        row, column = rng.integers(0, 150), rng.integers(0, 195)
        depth[row : row + 30, column : column + 45] = np.nan
    return DepthView(DEPTH, depth.astype(np.float32), image_from_depth)


def scene_of(query_offset: RigidTransform = OFFSET, map_offset: RigidTransform = IDENTITY) -> Scene:
    """Return a map of the room; the query is ``query.png``."""
    views = {"query.png": sensed(QUERY, query_offset, 0)}
    for seed, (image, pose) in enumerate(REFERENCES.items(), 1):
        views[image] = sensed(pose, map_offset, seed)
    return Scene(dict(REFERENCES), dict.fromkeys(REFERENCES, COLOUR), views)


@pytest.fixture(scope="module")
def furnished() -> Scene:
    return scene_of()


def refine(
    scene: Scene, start: RigidTransform, options: IcpOptions | None = None
) -> PoseRefinement:
    return Icp(options).refine("query.png", COLOUR, start, list(REFERENCES), scene)


def assert_accurate(
    result: PoseRefinement,
    distance_m: float = 0.005,
    angle_deg: float = 0.2,
    truth: RigidTransform = QUERY,
) -> None:
    assert result.accepted, result.reason
    off_m, off_deg = pose_errors(result.cam_from_world, truth)
    assert off_m < distance_m and off_deg < angle_deg


def test_a_pose_is_refined_despite_noise_and_holes(furnished: Scene) -> None:
    start = displaced(QUERY, 1, 0.05, 3.0)
    assert pose_errors(start, QUERY) == pytest.approx((0.05, 3.0))
    plugin = Icp()
    assert plugin.name == "icp"
    result = refine(furnished, start)
    assert_accurate(result)
    measures = result.measures
    assert measures["residual_after_m"] < measures["residual_before_m"]
    assert measures["overlap_after"] >= measures["overlap_before"]
    assert measures["moved_m"] == pytest.approx(0.05, abs=0.005)
    assert measures["moved_deg"] == pytest.approx(3.0, abs=0.2)
    assert measures["condition"] < 30  # furniture determines the pose
    assert result.covariance is not None and result.covariance.shape == (6, 6)


def test_the_offset_between_depth_and_colour_counts(furnished: Scene) -> None:
    start = displaced(QUERY, 1, 0.03, 1.0)
    assert_accurate(refine(scene_of(query_offset=IDENTITY, map_offset=OFFSET), start))
    # the query's offset replaced by none
    views = {n: replace(v, image_from_depth=IDENTITY) for n, v in furnished.depths.items()}
    wrong = refine(replace(furnished, depths=views), start)
    assert pose_errors(wrong.cam_from_world, QUERY)[0] > 0.02


def test_a_wall_alone_determines_no_pose() -> None:
    poses = {f"{x}": shifted(x) for x in (-0.5, 0.0, 0.5)}
    views = dict.fromkeys([*poses, "query.png"], depth_of(2.0))
    scene, start = Scene(poses, dict.fromkeys(poses, WALL_CAMERA), views), shifted(0.02)
    result = Icp().refine("query.png", WALL_CAMERA, start, list(poses), scene)
    assert not result.accepted and "do not determine" in result.reason
    assert result.cam_from_world == start and result.covariance is None


def test_a_world_far_from_its_origin(furnished: Scene) -> None:
    world = RigidTransform((1.0, 0.0, 0.0, 0.0), (-4.1e6, -1.2e6, -4.7e6))
    poses = {name: pose @ world for name, pose in furnished.poses.items()}
    result = refine(replace(furnished, poses=poses), displaced(QUERY, 0, 0.05, 3.0) @ world)
    assert result.accepted, result.reason
    distance_m, angle_deg = pose_errors(result.cam_from_world @ world.inverse(), QUERY)
    assert distance_m < 0.005 and angle_deg < 0.2


def test_movement_and_overlap_are_bounded(
    furnished: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = displaced(QUERY, 0, 0.05, 3.0)
    with monkeypatch.context() as patch:
        patch.setattr(icp, "_MAX_MOVED_DEG", 2.5)
        assert "rotated" in refine(furnished, start).reason
        forced = refine(furnished, start, IcpOptions(accept_always=True))
        assert forced.accepted and forced.cam_from_world != start
    with monkeypatch.context() as patch:
        patch.setattr(icp, "_MIN_OVERLAP", 1.0)
        assert "of the query's points are on the map" in refine(furnished, start).reason
    # the true pose does not get worse
    distance_m, angle_deg = pose_errors(refine(furnished, QUERY).cam_from_world, QUERY)
    assert distance_m < 0.003 and angle_deg < 0.1
    # a camera may move as far as its points may be from the map's
    assert icp._reason_too_far(shifted(0.0), shifted(0.29), IcpOptions()) == ""
    assert "moved by 0.310 m" in icp._reason_too_far(shifted(0.0), shifted(0.31), IcpOptions())


def test_the_overlap_may_fall_by_its_noise() -> None:
    def reason(overlap: float, residual_m: float, num_points: int) -> str:
        before: Any = SimpleNamespace(overlap=0.98, residual_m=0.004)
        after: Any = SimpleNamespace(overlap=overlap, residual_m=residual_m)
        return icp._reason_to_refuse(before, after, num_points, 10.0, IcpOptions())

    # two deviations of 2000 points are 0.0063
    assert reason(0.974, 0.0039, 2000) == "" and "overlap fell" in reason(0.973, 0.0039, 2000)
    assert "overlap fell" in reason(0.974, 0.0039, 4000)
    assert "residual did not fall" in reason(0.974, 0.0041, 2000)


def test_poses_without_depth_have_a_reason(furnished: Scene) -> None:
    start, views = displaced(QUERY, 0, 0.05, 3.0), furnished.depths
    assert "no depth" in refine(replace(furnished, depths={}), start).reason
    empty = replace(views["query.png"], depth_m=np.zeros((180, 240), np.float32))
    masked = {"query.png": np.zeros((480, 640), bool)}
    for scene in (
        replace(furnished, depths=views | {"query.png": empty}),
        replace(furnished, masks=masked),
    ):
        assert "query's depth" in refine(scene, start).reason
    nothing_there = Icp().refine("query.png", COLOUR, start, [], furnished)
    assert "the map has only 0 points" in nothing_there.reason


def test_a_map_of_few_points_is_refused(furnished: Scene) -> None:
    few = np.random.default_rng(0).uniform(*room.ROOM, (4000, 3))
    only_query = {"query.png": furnished.depths["query.png"]}
    result = refine(replace(furnished, depths=only_query, points=few), QUERY)
    assert not result.accepted and "too sparse" in result.reason


@pytest.mark.parametrize(
    "wrong",
    [
        {"voxels_m": (0.05, 0.1), "max_distances_m": (0.3, 0.1)},
        {"voxels_m": (0.1, 0.05)},
        {"voxels_m": (), "max_distances_m": ()},
        {"max_distances_m": (0.3, 0.1, 0.0)},
        {"noise": (0.001, -0.01, 0.002)},
    ],
)
def test_options_that_cannot_be_used(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        IcpOptions.model_validate(wrong)


def shifted(x: float, z: float = 0.0) -> RigidTransform:
    """Return a camera at (x, 0, z) that looks along z."""
    return RigidTransform((1.0, 0.0, 0.0, 0.0), (-x, 0.0, -z))


def depth_of(depth_m: float) -> DepthView:
    return DepthView(WALL_CAMERA, np.full((48, 64), depth_m, np.float32), IDENTITY)


def cloud_of(scene: Scene, references: Sequence[str]) -> NDArray[np.float64]:
    points = depth_cloud(WALL_QUERY)
    return map_cloud(WALL_QUERY, points, IDENTITY, references, scene, WALL_OPTIONS)


def test_references_with_most_overlap_from_different_views() -> None:
    """Every image sees a wall at z = 2."""
    x = {"aside": 1.8, "near": 0.3, "same": 0.35, "left": -0.5, "away": 9.0}
    poses = {name: shifted(at) for name, at in x.items()}
    views = dict.fromkeys(poses, depth_of(2.0))
    scene = Scene(poses, dict.fromkeys(poses, WALL_CAMERA), views)
    result = cloud_of(scene, list(poses))
    # near and left: a wall from -0.5 - 1.07 m to 0.3 + 1.07 m
    assert result[:, 0].min() == pytest.approx(-1.37, abs=0.06)
    assert result[:, 0].max() == pytest.approx(1.37, abs=0.06)
    np.testing.assert_allclose(result[:, 2], 2.0, atol=1e-6)
    only = cloud_of(scene, ["aside", "near", "same", "away"])
    np.testing.assert_array_equal(only, cloud_of(scene, ["near", "aside"]))
    # depth that contradicts the query's does not overlap: a wall of another room
    behind = replace(scene, poses={"behind": shifted(0.0, -1.0)}, depths={"behind": depth_of(3.9)})
    assert cloud_of(behind, ["behind"]).shape == (0, 3)


def test_map_points_are_used_if_no_reference_has_depth() -> None:
    points = np.random.default_rng(0).uniform(-5.0, 5.0, (5000, 3))
    poses = {"a": shifted(0.0), "b": shifted(1.0)}
    scene = Scene(poses, dict.fromkeys(poses, WALL_CAMERA), points=points)
    result = cloud_of(scene, ["a", "b"])
    query = depth_cloud(WALL_QUERY)
    low, high = query.min(axis=0) - 0.3, query.max(axis=0) + 0.3
    inside = ((points >= low) & (points <= high)).all(axis=1)
    # each point once, although both images observe it
    assert len(result) == inside.sum() > 0
    assert cloud_of(scene, []).shape == (0, 3)
