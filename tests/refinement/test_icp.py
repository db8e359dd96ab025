"""ICP on rendered depth with exact poses: point clouds, surfaces and their fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import room
from corner import pose_at
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from poses import assert_accurate, displaced, error_vector, pose_errors, rigid
from pydantic import ValidationError
from scenes import Scene
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from megloc_kapture.plugins import DepthView, PoseRefinement
from megloc_kapture.refinement import icp
from megloc_kapture.refinement.icp import Icp, IcpOptions, map_cloud
from megloc_kapture.refinement.icp_surface import (
    NORMAL_NEIGHBOURS,
    DepthCloudOptions,
    Surface,
    SurfaceFit,
    condition_number,
    depth_cloud,
    downsample,
    fit_covariance,
    fit_to_surface,
    fit_weighted,
    surface_fit,
    surface_of,
)
from megloc_kapture.values import Camera, RigidTransform

IDENTITY = RigidTransform.identity()
SMALL_CAMERA = Camera("PINHOLE", 9, 7, (8.0, 9.0, 4.2, 3.6))
IMAGE_FROM_DEPTH = rigid([0.02, -0.05, 0.01], [0.03, -0.01, 0.02])


def corner(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points on three walls, and their normals."""
    points = rng.uniform(0.1, 2.0, (count, 3))
    walls = np.arange(count) % 3
    points[np.arange(count), walls] = 0.0
    return points, np.eye(3)[walls]


def corner_surface(seed: int, count: int = 20000) -> Surface:
    return surface_of(downsample(corner(np.random.default_rng(seed), count)[0], 0.05))


def fit_of(points: np.ndarray, normals: np.ndarray) -> SurfaceFit:
    return SurfaceFit(1.0, 1.0, 0.0, points, normals, np.zeros(len(points)))


def test_thinned_points_are_means_of_voxels() -> None:
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (5000, 3)) + [1e6, -2e6, 3e5]
    result = downsample(points, 0.25)
    local = points - points.mean(axis=0)
    _, voxel = np.unique(np.floor(local / 0.25), axis=0, return_inverse=True)
    counts = np.bincount(voxel.ravel())
    means = np.stack([np.bincount(voxel.ravel(), points[:, k]) / counts for k in range(3)], axis=1)
    assert len(result) == len(means)
    np.testing.assert_allclose(
        result[np.lexsort(result.round(4).T)], means[np.lexsort(means.round(4).T)], atol=1e-6
    )
    assert downsample(np.zeros((0, 3)), 0.1).shape == (0, 3)


def test_normals_are_the_least_varying_directions() -> None:
    surface = corner_surface(1)
    points = surface.points
    distances, rows = cKDTree(points).query(points, NORMAL_NEIGHBOURS)
    assert surface.spacing() == pytest.approx(np.median(distances[:, -1]))
    around = points[rows] - points[rows].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    clear = values[:, 0] < 0.1 * values[:, 1]
    along = np.abs((surface.normals * vectors[:, :, 0]).sum(axis=1))
    assert clear.mean() > 0.8
    np.testing.assert_allclose(along[clear], 1.0, atol=1e-6)


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_sliding_surfaces_have_an_infinite_condition() -> None:
    rng = np.random.default_rng(0)
    around = directions(rng, 500)
    plane = np.column_stack([rng.uniform(-1, 1, (500, 2)), np.full(500, 3.0)])
    cylinder = np.column_stack([around[:, :2] / np.hypot(*around[:, :2].T)[:, None], around[:, 2]])
    assert condition_number(fit_of(plane, np.tile([0.0, 0.0, 1.0], (500, 1)))) > 1e12
    assert condition_number(fit_of(around * 2.0 + 5.0, around)) > 1e12
    assert condition_number(fit_of(cylinder, cylinder * [1, 1, 0])) > 1e12
    assert condition_number(fit_of(plane[:5], directions(rng, 5))) == np.inf


def test_the_condition_of_a_cube() -> None:
    grid = (np.arange(40) + 0.5) / 20 - 1
    u, v = (each.ravel() for each in np.meshgrid(grid, grid))
    faces, normals = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = np.insert(np.column_stack([u, v]), axis, side, axis=1)
            faces.append(face)
            normals.append(np.tile(side * np.eye(3)[axis], (len(u), 1)))
    points, outward = np.concatenate(faces), np.concatenate(normals)
    scale = np.linalg.norm(points, axis=1).mean()
    # a rotation about x moves the faces +-y by z and +-z by y: 4 of 6 faces, mean square u^2 each
    turning, moving = 4 / 6 * np.mean(u**2) / scale**2, 2 / 6
    expected = max(turning, moving) / min(turning, moving)
    assert condition_number(fit_of(points, outward)) == pytest.approx(expected, rel=1e-9)
    # independent of position and size
    assert condition_number(fit_of(7.0 * points + 100.0, outward)) == pytest.approx(expected)


def test_the_fit_is_that_of_the_nearest_planes() -> None:
    rng, surface = np.random.default_rng(1), corner_surface(1)
    points = rng.uniform(-0.2, 1.0, (400, 3))
    turn = Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix()
    surface_from_points = RigidTransform.from_matrix(turn, np.array([0.05, 0.0, -0.05]))
    fit = surface_fit(surface, points, surface_from_points, near_m=0.1, far_m=0.3)
    moved = points @ turn.T + [0.05, 0.0, -0.05]
    distances, rows = cKDTree(surface.points).query(moved)
    residuals = ((moved - surface.points[rows]) * surface.normals[rows]).sum(axis=1)
    assert fit.overlap == np.mean(distances <= 0.1)
    assert fit.reach == np.mean(distances <= 0.3)
    assert 0.0 < fit.overlap < fit.reach < 1.0
    assert fit.residual_m == pytest.approx(np.median(np.abs(residuals[distances <= 0.3])))
    np.testing.assert_allclose(fit.residuals_m, residuals[distances <= 0.1])
    np.testing.assert_allclose(fit.points, points[distances <= 0.1])
    normals = surface.normals[rows[distances <= 0.1]]
    np.testing.assert_allclose(fit.normals @ turn.T, normals, atol=1e-12)
    # no overlap and no transform where nothing is near
    far = RigidTransform((1.0, 0.0, 0.0, 0.0), (50.0, 0.0, 0.0))
    fit = surface_fit(surface, np.zeros((30, 3)), far, near_m=0.1, far_m=0.3)
    assert (fit.overlap, fit.reach, fit.residual_m) == (0.0, 0.0, np.inf)
    assert fit_weighted(surface, points, np.ones(400), far, 0.1) is None
    assert fit_to_surface(surface, points, far, 0.1) is None


def test_the_covariance_is_that_of_many_trials() -> None:
    """The camera is two metres away from the corner."""
    rng, surface = np.random.default_rng(2), corner_surface(2)
    truth = rigid([0.4, -0.3, 0.2], [0.3, -0.4, 2.0])
    errors, predicted = [], []
    for _ in range(60):
        world, normals = corner(rng, 600)
        seen = truth.apply(world + 0.01 * rng.standard_normal((600, 1)) * normals)
        result = fit_weighted(surface, seen, np.ones(600), truth.inverse(), 0.2)
        delta = result.inverse() @ truth.inverse()
        errors.append(error_vector(delta.inverse(), IDENTITY))
        fit = surface_fit(surface, seen, result, near_m=0.2, far_m=0.3)
        predicted.append(fit_covariance(fit))
    measured = np.cov(np.array(errors).T)
    # along the axes of the mean prediction, with the accuracy of 60 trials
    values, vectors = np.linalg.eigh(np.mean(predicted, axis=0))
    ratio = np.diag(vectors.T @ measured @ vectors) / values
    assert (ratio > 0.5).all() and (ratio < 2.0).all()


@pytest.fixture(scope="module")
def surface() -> Surface:
    return corner_surface(0)


def moved_and_turned(result: RigidTransform | None) -> tuple[float, float]:
    turn = Rotation.from_matrix(result.rotation_matrix()).magnitude()
    # of the points' middle
    middle = np.ones((1, 3))
    return float(np.linalg.norm(result.apply(middle) - middle)), float(np.degrees(turn))


def test_outliers_have_little_weight(surface: Surface) -> None:
    rng = np.random.default_rng(1)
    points = corner(rng, 3000)[0] + 0.002 * rng.standard_normal((3000, 3))
    # a fifth of the floor is covered by 5 cm
    covered = (np.arange(3000) % 3 == 2) & (points[:, 0] < 0.5)
    points[covered, 2] += 0.05
    result = fit_weighted(surface, points, np.ones(3000), IDENTITY, 0.1)
    squares = fit_to_surface(surface, points, IDENTITY, 0.1)
    assert moved_and_turned(result)[0] < 0.001
    assert moved_and_turned(result)[1] < 0.05
    assert moved_and_turned(squares)[0] > 3 * moved_and_turned(result)[0]


def test_points_are_weighted_by_their_noise(surface: Surface) -> None:
    """Half of the points are ten times as noisy, and 1 cm off."""
    rng = np.random.default_rng(2)
    noise = np.where(rng.random(3000) < 0.5, 0.02, 0.002)
    points = corner(rng, 3000)[0] + noise[:, None] * rng.standard_normal((3000, 3))
    points[noise > 0.01] += 0.01
    result = fit_weighted(surface, points, noise, IDENTITY, 0.2)
    unweighted = moved_and_turned(fit_weighted(surface, points, np.ones(3000), IDENTITY, 0.2))[0]
    assert moved_and_turned(result)[0] < 0.001
    assert unweighted > 2 * moved_and_turned(result)[0]
    # its scale does not matter
    scaled = fit_weighted(surface, points, 64.0 * noise, IDENTITY, 0.2)
    np.testing.assert_allclose(result.translation, scaled.translation, atol=1e-12)


def pixel_by_pixel(depth: np.ndarray, options: DepthCloudOptions, step_px: int) -> np.ndarray:
    fx, fy, cx, cy = SMALL_CAMERA.params
    points = []
    for row in range(step_px // 2, SMALL_CAMERA.height, step_px):
        for column in range(step_px // 2, SMALL_CAMERA.width, step_px):
            z = float(depth[row, column])
            if not 0 < z <= options.max_depth_m:
                continue
            around = [
                float(depth[r, c])
                for r in range(max(row - 1, 0), min(row + 2, SMALL_CAMERA.height))
                for c in range(max(column - 1, 0), min(column + 2, SMALL_CAMERA.width))
                if depth[r, c] > 0
            ]
            if any(max(z, other) / min(z, other) > 1.05 for other in around):
                continue
            points.append([(column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z, z])
    return IMAGE_FROM_DEPTH.apply(np.array(points).reshape(-1, 3))


@given(
    seed=st.integers(0, 10**6),
    step_px=st.integers(1, 3),
    max_depth_m=st.sampled_from([1.5, 4.0]),
    spread=st.sampled_from([0.01, 0.03, 0.3]),
)
def test_clouds_equal_a_loop(seed: int, step_px: int, max_depth_m: float, spread: float) -> None:
    rng = np.random.default_rng(seed)
    depth = rng.choice([1.0, 1.48, 3.9]) * rng.uniform(1 - spread, 1 + spread, (7, 9))
    holes = rng.random((7, 9)) < 0.2
    depth[holes] = rng.choice([0.0, -1.0, np.nan], int(holes.sum()))
    depth = depth.astype(np.float32)
    options = DepthCloudOptions(max_depth_m=max_depth_m)
    points = depth_cloud(DepthView(SMALL_CAMERA, depth, IMAGE_FROM_DEPTH), options, step_px=step_px)
    assert points.dtype == np.float64
    np.testing.assert_allclose(points, pixel_by_pixel(depth, options, step_px), atol=1e-9)


def test_the_mask_of_the_image_applies_to_depth() -> None:
    """The colour camera is next to the depth sensor."""
    image_camera = Camera("PINHOLE", 18, 14, (16.0, 16.0, 9.0, 7.0))
    offset = RigidTransform((1.0, 0.0, 0.0, 0.0), (-0.5, 0.0, 0.0))
    view = DepthView(SMALL_CAMERA, np.full((7, 9), 2.0, np.float32), offset)
    mask = np.zeros((14, 18), bool)
    mask[:, 6:] = True
    everything = depth_cloud(view)
    left = depth_cloud(view, image_camera=image_camera, image_mask=mask)
    u = everything[:, 0] / everything[:, 2] * 16.0 + 9.0
    v = everything[:, 1] / everything[:, 2] * 16.0 + 7.0
    outside = (u < 0) | (u >= 18) | (v < 0) | (v >= 14)
    np.testing.assert_array_equal(left, everything[outside | (u >= 6)])
    assert 0 < len(left) < len(everything)


COLOUR = Camera("PINHOLE", 640, 480, (525.0, 525.0, 320.0, 240.0))
DEPTH = Camera("PINHOLE", 240, 180, (219.0, 219.0, 120.0, 90.0))
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


def sensed(pose: RigidTransform, image_from_depth: RigidTransform, seed: int) -> DepthView:
    """Render depth with a Kinect's noise, single pixels without depth, and three large holes."""
    exact = room.render(image_from_depth.inverse() @ pose, camera=DEPTH).depth_m
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


def test_a_pose_is_refined_despite_noise_and_holes(furnished: Scene) -> None:
    start = displaced(QUERY, 1, 0.05, 3.0)
    assert pose_errors(start, QUERY) == pytest.approx((0.05, 3.0))
    plugin = Icp()
    assert plugin.name == "icp"
    result = refine(furnished, start)
    assert_accurate(result, QUERY, 0.005, 0.2)
    measures = result.measures
    assert measures["residual_after_m"] < measures["residual_before_m"]
    assert measures["overlap_after"] >= measures["overlap_before"]
    assert measures["moved_m"] == pytest.approx(0.05, abs=0.005)
    assert measures["moved_deg"] == pytest.approx(3.0, abs=0.2)
    assert measures["condition"] < 30  # furniture determines the pose
    assert result.covariance is not None and result.covariance.shape == (6, 6)


def test_the_offset_between_depth_and_colour_counts(furnished: Scene) -> None:
    start = displaced(QUERY, 1, 0.03, 1.0)
    result = refine(scene_of(query_offset=IDENTITY, map_offset=OFFSET), start)
    assert_accurate(result, QUERY, 0.005, 0.2)
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
    near = replace(result, cam_from_world=result.cam_from_world @ world.inverse())
    assert_accurate(near, QUERY, 0.005, 0.2)


def test_movement_and_overlap_have_limits(
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
