"""ICP against rendered depth whose poses are known exactly."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from megloc_twins.frames import looking_at
from megloc_twins.rasterization import depth_map, sample_grid, visible_surfaces
from megloc_twins.surfaces import SurfaceBuilder, Surfaces
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from megloc_kapture.plugins import DepthView, PoseRefinement, PoseRefiner
from megloc_kapture.refinement.icp import Icp, IcpOptions, map_cloud, refine_by_icp
from megloc_kapture.refinement.icp_surface import depth_cloud
from megloc_kapture.values import Camera, RigidTransform

COLOUR = Camera("PINHOLE", 640, 480, (525.0, 525.0, 320.0, 240.0))
DEPTH = Camera("PINHOLE", 240, 180, (219.0, 219.0, 120.0, 90.0))
IDENTITY = RigidTransform.identity()
WALL_CAMERA = Camera("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
WALL_OPTIONS = IcpOptions(max_references=2, voxels_m=(0.05,), max_distances_m=(0.3,))
WALL_QUERY = DepthView(WALL_CAMERA, np.full((48, 64), 2.0, np.float32), IDENTITY)
OFFSET = RigidTransform.from_matrix(
    Rotation.from_euler("xyz", [0.5, -1.5, 0.3], degrees=True).as_matrix(),
    np.array([-0.06, 0.004, 0.01]),
)


def both_sides(builder: SurfaceBuilder, origin: Sequence[float], u: object, v: object) -> None:
    corner, along, across = (np.array(each, np.float64) for each in (origin, u, v))
    builder.add(corner, along, across, 0)
    builder.add(corner, across, along, 0)


def room() -> Surfaces:
    """4 x 5 m and 2.6 m high, with three boxes."""
    builder = SurfaceBuilder()
    both_sides(builder, (0, 0, 0), (4, 0, 0), (0, 5, 0))
    both_sides(builder, (0, 0, 2.6), (4, 0, 0), (0, 5, 0))
    both_sides(builder, (0, 0, 0), (4, 0, 0), (0, 0, 2.6))
    both_sides(builder, (0, 5, 0), (4, 0, 0), (0, 0, 2.6))
    both_sides(builder, (0, 0, 0), (0, 5, 0), (0, 0, 2.6))
    both_sides(builder, (4, 0, 0), (0, 5, 0), (0, 0, 2.6))
    builder.add_box((0.9, 4.2), (0.8, 0.6, 0.75), 0.3, (0, 0, 0, 0), 0)
    builder.add_box((2.2, 4.6), (0.5, 0.4, 1.4), -0.2, (0, 0, 0, 0), 0)
    builder.add_box((3.3, 3.4), (0.6, 0.9, 0.45), 0.1, (0, 0, 0, 0), 0)
    return builder.build()


def corridor() -> Surfaces:
    """Floor and two walls, without an end in sight."""
    builder = SurfaceBuilder()
    both_sides(builder, (1, -50, 0), (2, 0, 0), (0, 100, 0))
    both_sides(builder, (1, -50, 0), (0, 100, 0), (0, 0, 2.6))
    both_sides(builder, (3, -50, 0), (0, 100, 0), (0, 0, 2.6))
    return builder.build()


def wall() -> Surfaces:
    builder = SurfaceBuilder()
    both_sides(builder, (-20, 4, -20), (40, 0, 0), (0, 0, 40))
    return builder.build()


def view_from(x: float, y: float, z: float, target: Sequence[float]) -> RigidTransform:
    position = np.array([x, y, z])
    ahead = np.array(target, np.float64) - position
    pitch = np.arctan2(ahead[2], np.hypot(ahead[0], ahead[1]))
    return looking_at(position, np.arctan2(ahead[1], ahead[0]), pitch, 0.0)


QUERY = view_from(2.0, 1.6, 1.5, (2.0, 4.5, 0.7))
REFERENCES = {
    "map/a.png": view_from(1.5, 1.3, 1.4, (2.2, 4.5, 0.8)),
    "map/b.png": view_from(2.6, 1.5, 1.6, (1.6, 4.5, 0.6)),
    "map/c.png": view_from(2.0, 0.9, 1.2, (2.3, 4.5, 0.9)),
    "map/d.png": view_from(1.2, 2.2, 1.5, (2.6, 4.4, 0.4)),
    "map/e.png": view_from(2.9, 2.1, 1.3, (1.2, 4.6, 0.5)),
}


def sensed(
    surfaces: Surfaces,
    image_from_world: RigidTransform,
    image_from_depth: RigidTransform,
    seed: int | None,
) -> DepthView:
    """Rendered depth with a Kinect's noise, single pixels without depth, and three large holes."""
    depth_from_world = image_from_depth.inverse() @ image_from_world
    exact = depth_map(visible_surfaces(surfaces, depth_from_world, sample_grid(DEPTH, 1)))
    if seed is None:
        return DepthView(DEPTH, exact, image_from_depth)
    rng = np.random.default_rng(seed)
    deviation = 0.0012 + 0.0019 * (exact - 0.4) ** 2
    depth = np.where(exact > 0, exact + deviation * rng.standard_normal(exact.shape), 0.0)
    depth[rng.random(depth.shape) < 0.05] = 0.0
    for _ in range(3):
        row, column = rng.integers(0, 150), rng.integers(0, 195)
        depth[row : row + 30, column : column + 45] = np.nan
    return DepthView(DEPTH, depth.astype(np.float32), image_from_depth)


@dataclass
class Scene:
    """Views by name; the query is ``query.png``."""

    views: dict[str, DepthView]
    poses: dict[str, RigidTransform]
    masks: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))

    def query_image(self, name: str) -> NDArray[np.uint8]:
        raise AssertionError("pixels are not needed")

    map_image = query_image

    def query_mask(self, name: str) -> NDArray[np.bool_] | None:
        return self.masks.get(name)

    map_mask = query_mask

    def query_depth(self, name: str) -> DepthView | None:
        return self.views.get(name)

    map_depth = query_depth

    def map_points(self, name: str) -> NDArray[np.float64]:
        return self.points

    def map_camera(self, name: str) -> Camera:
        return COLOUR

    def map_pose(self, name: str) -> RigidTransform:
        return self.poses[name]


def scene_of(
    surfaces: Surfaces,
    *,
    query_offset: RigidTransform = OFFSET,
    map_offset: RigidTransform = IDENTITY,
    seed: int | None = 0,
) -> Scene:
    views = {"query.png": sensed(surfaces, QUERY, query_offset, seed)}
    for number, (name, pose) in enumerate(REFERENCES.items(), 1):
        views[name] = sensed(surfaces, pose, map_offset, None if seed is None else seed + number)
    return Scene(views, dict(REFERENCES))


@pytest.fixture(scope="module")
def furnished() -> Scene:
    return scene_of(room())


def disturbed(seed: int, distance_m: float, angle_deg: float) -> RigidTransform:
    """The query's pose with its centre moved and its orientation turned, in random directions."""
    rng = np.random.default_rng(seed)
    axis, direction = rng.standard_normal((2, 3))
    turn = Rotation.from_rotvec(np.radians(angle_deg) * axis / np.linalg.norm(axis)).as_matrix()
    rotation = turn @ QUERY.rotation_matrix()
    center = QUERY.center() + distance_m * direction / np.linalg.norm(direction)
    return RigidTransform.from_matrix(rotation, -rotation @ center)


def errors(pose: RigidTransform, truth: RigidTransform = QUERY) -> tuple[float, float]:
    turn = Rotation.from_matrix(pose.rotation_matrix() @ truth.rotation_matrix().T)
    return (
        float(np.linalg.norm(pose.center() - truth.center())),
        float(np.degrees(turn.magnitude())),
    )


def refine(
    scene: Scene, start: RigidTransform, options: IcpOptions | None = None
) -> PoseRefinement:
    return Icp(options).refine("query.png", COLOUR, start, list(REFERENCES), scene)


@pytest.mark.parametrize("seed", range(4))
def test_noise_and_holes_leave_5_mm_and_a_fifth_of_a_degree(furnished: Scene, seed: int) -> None:
    start = disturbed(seed, 0.05, 3.0)
    assert errors(start) == pytest.approx((0.05, 3.0))
    found = refine(furnished, start)
    assert found.accepted, found.reason
    distance_m, angle_deg = errors(found.cam_from_world)
    assert distance_m < 0.005
    assert angle_deg < 0.2
    measures = found.measures
    assert measures["residual_after_m"] < measures["residual_before_m"]
    assert measures["overlap_after"] >= measures["overlap_before"]
    assert measures["moved_m"] == pytest.approx(0.05, abs=0.005)
    assert measures["moved_deg"] == pytest.approx(3.0, abs=0.2)
    assert found.covariance is not None and found.covariance.shape == (6, 6)


@pytest.mark.parametrize(("distance_m", "angle_deg"), [(1.0, 5.0), (0.1, 60.0), (2.0, 120.0)])
@pytest.mark.parametrize("seed", range(2))
def test_a_hopeless_start_stays(
    furnished: Scene, seed: int, distance_m: float, angle_deg: float
) -> None:
    start = disturbed(seed, distance_m, angle_deg)
    found = refine(furnished, start)
    assert not found.accepted
    assert found.reason
    assert found.cam_from_world == start
    assert found.covariance is None


@pytest.mark.parametrize("of_the_map", [False, True])
def test_the_offset_between_depth_and_colour_counts(of_the_map: bool) -> None:
    offsets = {"query_offset": IDENTITY, "map_offset": IDENTITY}
    offsets["map_offset" if of_the_map else "query_offset"] = OFFSET
    scene = scene_of(room(), **offsets)
    start = disturbed(1, 0.03, 1.0)
    found = refine(scene, start)
    assert found.accepted, found.reason
    assert errors(found.cam_from_world)[0] < 0.005
    assert errors(found.cam_from_world)[1] < 0.2
    # the same depth, as if both cameras were one
    for name, view in scene.views.items():
        scene.views[name] = replace(view, image_from_depth=IDENTITY)
    assert errors(refine(scene, start).cam_from_world)[0] > 0.02


@pytest.mark.parametrize("surfaces", [wall(), corridor()], ids=["wall", "corridor"])
@pytest.mark.parametrize("seed", [None, 0], ids=["exact", "noisy"])
def test_surfaces_that_slide_are_recognised(surfaces: Surfaces, seed: int | None) -> None:
    start = disturbed(2, 0.03, 1.0)
    found = refine(scene_of(surfaces, seed=seed), start)
    assert not found.accepted
    assert "do not determine" in found.reason
    assert found.cam_from_world == start
    # it is the condition that refuses it
    unbound = IcpOptions(max_condition=1e15)
    assert "do not determine" not in refine(scene_of(surfaces, seed=seed), start, unbound).reason


def test_furniture_determines_the_pose(furnished: Scene) -> None:
    assert refine(furnished, disturbed(0, 0.05, 3.0)).measures["condition"] < 30


def test_twice_the_same(furnished: Scene) -> None:
    start = disturbed(3, 0.05, 3.0)
    first, second = refine(furnished, start), refine(furnished, start)
    assert first.cam_from_world == second.cam_from_world
    assert first.measures == second.measures
    np.testing.assert_array_equal(first.covariance, second.covariance)


def test_a_world_far_from_its_origin() -> None:
    scene = scene_of(room())
    world = RigidTransform((1.0, 0.0, 0.0, 0.0), (-4.1e6, -1.2e6, -4.7e6))
    scene.poses = {name: pose @ world for name, pose in scene.poses.items()}
    found = refine(scene, disturbed(0, 0.05, 3.0) @ world)
    assert found.accepted, found.reason
    distance_m, angle_deg = errors(found.cam_from_world @ world.inverse())
    assert distance_m < 0.005
    assert angle_deg < 0.2


def test_bounds_of_the_movement(furnished: Scene) -> None:
    start = disturbed(0, 0.05, 3.0)
    assert "moved" in refine(furnished, start, IcpOptions(max_moved_m=0.04)).reason
    assert "turned" in refine(furnished, start, IcpOptions(max_moved_deg=2.5)).reason


def test_a_pose_that_is_right_does_not_get_worse(furnished: Scene) -> None:
    found = refine(furnished, QUERY)
    distance_m, angle_deg = errors(found.cam_from_world)
    assert distance_m < 0.003
    assert angle_deg < 0.1


def test_too_little_overlap_is_refused(furnished: Scene) -> None:
    found = refine(furnished, disturbed(0, 0.05, 3.0), IcpOptions(min_overlap=1.0))
    assert "of the query's points are on the map" in found.reason


def test_without_depth() -> None:
    scene = scene_of(room())
    start = disturbed(0, 0.05, 3.0)
    empty = replace(scene.views["query.png"], depth_m=np.zeros((180, 240), np.float32))
    assert "no depth" in refine(Scene({}, scene.poses), start).reason
    nothing_seen = refine(replace(scene, views=scene.views | {"query.png": empty}), start)
    assert "query's depth" in nothing_seen.reason
    nothing_there = Icp().refine("query.png", COLOUR, start, [], scene)
    assert "the map has 0 points" in nothing_there.reason


def test_masked_pixels_are_left_out() -> None:
    """A person before the query's camera that the map does not have."""
    scene = scene_of(room())
    view = scene.views["query.png"]
    depth = view.depth_m.copy()
    depth[30:, 68:172] = np.minimum(depth[30:, 68:172], 2.4)
    scene.views["query.png"] = replace(view, depth_m=depth)
    start = disturbed(4, 0.05, 2.0)
    unmasked = refine(scene, start)
    mask = np.ones((480, 640), bool)
    # the two cameras are 6 cm and 1.5 degrees apart
    mask[40:, 100:540] = False
    scene.masks["query.png"] = mask
    masked = refine(scene, start)
    assert masked.accepted, masked.reason
    assert errors(masked.cam_from_world)[0] < 0.01
    assert masked.measures["overlap_after"] > unmasked.measures["overlap_after"] + 0.05


def test_the_maps_points_serve_where_they_are_dense() -> None:
    scene = scene_of(room())
    exact = scene_of(room(), seed=None)
    points = []
    for name, pose in REFERENCES.items():
        rows, columns = np.indices((180, 240)).reshape(2, -1) + 0.5
        rays = np.column_stack([(columns - 120) / 219, (rows - 90) / 219, np.ones(len(rows))])
        depth = exact.views[name].depth_m.astype(np.float64).reshape(-1, 1)
        points.append(pose.inverse().apply(rays * depth))
    scene.views = {"query.png": scene.views["query.png"]}
    scene.points = np.concatenate(points)[::3]
    start = disturbed(5, 0.05, 3.0)
    found = refine(scene, start)
    assert found.accepted, found.reason
    assert errors(found.cam_from_world)[0] < 0.005
    assert errors(found.cam_from_world)[1] < 0.2
    # a hundred times fewer, as triangulation leaves them
    scene.points = np.random.default_rng(0).permutation(scene.points)[:1200]
    sparse = refine(scene, start)
    assert not sparse.accepted
    assert "too sparse" in sparse.reason


def test_arrays_alone() -> None:
    """Points of a corner, moved exactly: no plugin, no scene."""
    rng = np.random.default_rng(0)
    corner = rng.uniform(0.0, 1.5, (30000, 3))
    corner[np.arange(30000), np.arange(30000) % 3] = 0.0
    truth = view_from(2.5, 2.2, 1.9, (0.0, 0.0, 0.0))
    query = truth.apply(corner[rng.random(30000) < 0.5])
    turn = Rotation.from_rotvec(np.radians([1.0, -1.0, 0.5])).as_matrix()
    start = RigidTransform.from_matrix(turn, np.array([0.02, -0.02, 0.01])) @ truth
    found = refine_by_icp(query, corner, start)
    assert found.accepted, found.reason
    assert errors(found.cam_from_world, truth)[0] < 2e-3
    assert errors(found.cam_from_world, truth)[1] < 0.05


def test_it_is_a_plugin() -> None:
    options = IcpOptions(max_references=3)
    plugin = pickle.loads(pickle.dumps(Icp(options)))
    assert isinstance(plugin, PoseRefiner)
    assert plugin.name == "icp"
    assert plugin.options == options


@pytest.mark.parametrize(
    "wrong",
    [
        {"voxels_m": (0.05, 0.1), "max_distances_m": (0.3, 0.1)},
        {"voxels_m": (0.1, 0.05)},
        {"voxels_m": (), "max_distances_m": ()},
        {"max_distances_m": (0.3, 0.1, 0.0)},
        {"noise": (0.001, -0.01, 0.002)},
        {"min_overlap": 1.5},
        {"max_condition": 1.0},
    ],
)
def test_options_that_cannot_be_used(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        IcpOptions.model_validate(wrong)


def shifted(x: float, z: float = 0.0) -> RigidTransform:
    """A camera at (x, 0, z) that looks along z."""
    return RigidTransform((1.0, 0.0, 0.0, 0.0), (-x, 0.0, -z))


@dataclass
class WallScene:
    """Every image sees a wall at z = 2, and one with an x of its own can be told by it."""

    poses: dict[str, RigidTransform]
    points: NDArray[np.float64] | None = None

    def map_depth(self, name: str) -> DepthView | None:
        if self.points is not None:
            return None
        depth = 2.0 - self.poses[name].center()[2]
        return DepthView(WALL_CAMERA, np.full((48, 64), depth, np.float32), IDENTITY)

    def map_mask(self, name: str) -> None:
        return None

    def map_camera(self, name: str) -> Camera:
        return WALL_CAMERA

    def map_pose(self, name: str) -> RigidTransform:
        return self.poses[name]

    def map_points(self, name: str) -> NDArray[np.float64]:
        assert self.points is not None
        return self.points


def cloud_of(scene: Any, references: list[str]) -> NDArray[np.float64]:
    points = depth_cloud(WALL_QUERY)
    return map_cloud(WALL_QUERY, points, IDENTITY, references, scene, WALL_OPTIONS)


def test_those_that_overlap_most_one_of_each_view() -> None:
    scene = WallScene(
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
    behind = WallScene({"behind": shifted(0.0, z=-1.0)})
    behind.map_depth = lambda name: DepthView(  # type: ignore[method-assign]
        WALL_CAMERA, np.full((48, 64), 3.9, np.float32), IDENTITY
    )
    assert cloud_of(behind, ["behind"]).shape == (0, 3)


def test_points_where_no_reference_has_depth() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-5.0, 5.0, (5000, 3))
    scene = WallScene({"a": shifted(0.0), "b": shifted(1.0)}, points)
    found = cloud_of(scene, ["a", "b"])
    query = depth_cloud(WALL_QUERY)
    low, high = query.min(axis=0) - 0.3, query.max(axis=0) + 0.3
    inside = ((points >= low) & (points <= high)).all(axis=1)
    # each point once, although both images observe it
    assert len(found) == inside.sum() > 0
    assert cloud_of(scene, []).shape == (0, 3)
