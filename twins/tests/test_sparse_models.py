"""Sparse models of the twins: exact tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from megloc_twins.frames import Frame, day_lighting
from megloc_twins.portable import looking_at
from megloc_twins.rasterization import depth_map, sample_grid, visible_surfaces
from megloc_twins.sparse_models import exact_tracks
from megloc_twins.synthetic_kapture import SyntheticWorld
from numpy.typing import NDArray

from megloc_kapture.io.colmap import px_from_cam
from megloc_kapture.io.colmap_model import SparsePoints
from megloc_kapture.values import Camera, RigidTransform

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


Depths = dict[str, NDArray[np.float32]]


def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def colmap_px(frame: Frame, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where COLMAP projects world points, (N, 2)."""
    w, x, y, z = frame.cam_from_world.quat_wxyz
    pose = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([x, y, z, w])), np.array(frame.cam_from_world.translation)
    )
    return px_from_cam(frame.camera, np.array([pose * point for point in points]))


@pytest.fixture(scope="module")
def frames(world: SyntheticWorld) -> list[Frame]:
    """Rig and telephone images of two places, PINHOLE and SIMPLE_RADIAL."""
    return list(world.frames())


@pytest.fixture(scope="module")
def depths(world: SyntheticWorld) -> Depths:
    result = {}
    for frame in world.frames():
        place, grid = world.places[frame.place], sample_grid(frame.camera, 1)
        seen = visible_surfaces(place.surfaces, place.cam_from_place(frame), grid)
        result[frame.name] = depth_map(seen)
    return result


@pytest.fixture(scope="module")
def points(frames: list[Frame], depths: Depths) -> SparsePoints:
    return exact_tracks(frames, depths, rng(), points_per_frame=40)


def test_colmap_projects_the_points_where_they_are_seen(
    frames: list[Frame], depths: Depths, points: SparsePoints
) -> None:
    assert {frame.camera.model for frame in frames} == {"PINHOLE", "SIMPLE_RADIAL"}
    for index, frame in enumerate(frames):
        mine = points.image_ids == index
        assert mine.sum() > 10
        xyz = points.xyz[points.point_ids[mine]]
        np.testing.assert_allclose(points.xy_px[mine], colmap_px(frame, xyz), atol=1e-4)
        # on the visible surface
        column, row = points.xy_px[mine].astype(int).T
        z = frame.cam_from_world.apply(xyz)[:, 2]
        error = np.abs(depths[frame.name][row, column] - z)
        assert (error < 0.021 + 0.011 * z).all() and np.median(error) < 0.02
    # poses may be in another frame
    other_from_world = RigidTransform.from_matrix(np.diag([1.0, -1.0, -1.0]), np.array([9, 8, 7]))
    back = other_from_world.inverse()
    moved = [replace(frame, cam_from_world=frame.cam_from_world @ back) for frame in frames]
    there = exact_tracks(moved, depths, rng(), points_per_frame=40)
    np.testing.assert_allclose(there.xyz, other_from_world.apply(points.xyz), atol=1e-9)


def test_tracks_are_in_order_and_within_a_place(frames: list[Frame], points: SparsePoints) -> None:
    assert len(points) > 100
    counts = np.bincount(points.point_ids, minlength=len(points))
    assert counts.min() == 2 and counts.max() > 3
    keys = list(zip(points.point_ids.tolist(), points.image_ids.tolist(), strict=True))
    assert keys == sorted(set(keys))
    place = np.array([frame.place for frame in frames])[points.image_ids]
    first = np.searchsorted(points.point_ids, points.point_ids)
    assert (place == place[first]).all()
    for index in range(len(frames)):
        features = points.feature_ids[points.image_ids == index]
        assert features.tolist() == list(range(len(features)))


def frame(name: str, x: float, *, camera: Camera, yaw_deg: float = 90.0) -> Frame:
    """A camera at (x, 0, 0) that looks along +y unless turned."""
    lighting = day_lighting(rng(), (0.0, 1.0), overcast=0.0)
    pose = looking_at(np.array([x, 0.0, 0.0]), np.radians(yaw_deg), 0.0, 0.0)
    return Frame(name, "day", 0, 0, name, camera, pose, lighting, 0)


PINHOLE = Camera("PINHOLE", 40, 30, (40.0, 40.0, 20.0, 15.0))
WALL_M = 10.0


def wall() -> NDArray[np.float32]:
    return np.full((30, 40), WALL_M, np.float32)


def test_what_stands_in_front_hides_the_wall() -> None:
    pair = [frame("a", 0.0, camera=PINHOLE), frame("b", 0.0, camera=PINHOLE)]
    hidden = wall()
    hidden[:, :20] = 5.0  # in b, something covers the left half
    points = exact_tracks(pair, {"a": wall(), "b": hidden}, rng(), points_per_frame=1200)
    # nothing at 5 m is seen by a, nothing on the left of the wall by b
    assert (points.xy_px[:, 0] > 20).all()
    np.testing.assert_allclose(points.xyz[:, 1], WALL_M, atol=1e-9)
    # all of the visible half from both, but for the border
    assert len(points) == 2 * 18 * 26


def test_nothing_is_seen_without_depth_behind_beside_or_in_another_place() -> None:
    a, b = frame("a", 0.0, camera=PINHOLE), frame("b", 0.0, camera=PINHOLE)
    behind = frame("b", 0.0, camera=PINHOLE, yaw_deg=-90.0)
    beside = frame("b", 50.0, camera=PINHOLE)
    nothing, both = {"a": 0 * wall(), "b": 0 * wall()}, {"a": wall(), "b": wall()}
    pairs = (([a, b], nothing), ([a, behind], both), ([a, beside], both))
    for frames, depths in (*pairs, ([a, replace(b, place=1)], both), ([], {})):
        assert len(exact_tracks(frames, depths, rng(), points_per_frame=50)) == 0


def test_strong_distortion_folds_nothing_back_into_the_image() -> None:
    # r (1 - 0.25 r^2) turns back at r = 1.15: rays from far outside land inside the image again
    camera = Camera("SIMPLE_RADIAL", 40, 30, (40.0, 20.0, 15.0, -0.25))
    pair = [frame("a", 0.0, camera=camera), frame("b", 19.5, camera=camera)]
    both = {"a": wall(), "b": wall()}
    x_px = 20.0 + 40.0 * -1.95 * (1 - 0.25 * 1.95**2)
    assert 2 < x_px < 38  # the middle of a's image, as b's formula has it
    assert len(exact_tracks(pair, both, rng(), points_per_frame=1200)) == 0
