"""Exact tracks: COLMAP's cameras project the points where the observations are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.sparse_points import SparsePoints
from megloc_kapture.datasets.synthetic.cameras import looking_at
from megloc_kapture.datasets.synthetic.looks import day_look
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions
from megloc_kapture.datasets.synthetic.render import depth_map, sample_grid, visible_surfaces
from megloc_kapture.datasets.synthetic.shots import Shot
from megloc_kapture.datasets.synthetic.tracks import exact_tracks
from megloc_kapture.datasets.synthetic.world import SyntheticWorld, build_world
from megloc_kapture.values import Camera, RigidTransform

Depths = dict[str, NDArray[np.float32]]


def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def colmap_px(shot: Shot, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where COLMAP projects world points, (N, 2)."""
    camera = pycolmap.Camera(
        model=shot.camera.model,
        width=shot.camera.width,
        height=shot.camera.height,
        params=list(shot.camera.params),
    )
    w, x, y, z = shot.cam_from_world.quat_wxyz
    pose = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([x, y, z, w])), np.array(shot.cam_from_world.translation)
    )
    return np.array([camera.img_from_cam(pose * point) for point in points])


@pytest.fixture(scope="module")
def world() -> SyntheticWorld:
    return build_world(
        SyntheticWorldOptions(
            num_places=2,
            stations_per_place=5,
            day_queries=2,
            night_queries=0,
            width=160,
            height=120,
        )
    )


@pytest.fixture(scope="module")
def shots(world: SyntheticWorld) -> list[Shot]:
    """Rig and telephone images of two places, PINHOLE and SIMPLE_RADIAL."""
    return list(world.shots())


@pytest.fixture(scope="module")
def depths(world: SyntheticWorld) -> Depths:
    surfaces = [place.surfaces_in_world() for place in world.places]
    found = {}
    for shot in world.shots():
        grid = sample_grid(shot.camera, 1)
        seen = visible_surfaces(surfaces[shot.place], shot.cam_from_world, grid)
        found[shot.name] = depth_map(seen)
    return found


@pytest.fixture(scope="module")
def points(shots: list[Shot], depths: Depths) -> SparsePoints:
    return exact_tracks(shots, depths, points_per_shot=60, rng=rng())


def test_colmap_projects_the_points_where_they_are_seen(
    shots: list[Shot], points: SparsePoints
) -> None:
    assert {shot.camera.model for shot in shots} == {"PINHOLE", "SIMPLE_RADIAL"}
    for index, shot in enumerate(shots):
        mine = points.image_ids == index
        assert mine.sum() > 20
        px = colmap_px(shot, points.xyz[points.point_ids[mine]])
        np.testing.assert_allclose(points.xy_px[mine], px, atol=1e-4)


def test_the_points_lie_on_what_the_images_see(
    shots: list[Shot], depths: Depths, points: SparsePoints
) -> None:
    for index, shot in enumerate(shots):
        mine = points.image_ids == index
        column, row = points.xy_px[mine].astype(int).T
        z = shot.cam_from_world.apply(points.xyz[points.point_ids[mine]])[:, 2]
        error = np.abs(depths[shot.name][row, column] - z)
        assert (error < 0.021 + 0.011 * z).all()
        assert np.median(error) < 0.02


def test_tracks_are_in_order_and_within_a_place(shots: list[Shot], points: SparsePoints) -> None:
    assert len(points) > 200
    counts = np.bincount(points.point_ids, minlength=len(points))
    assert counts.min() == 2
    assert counts.max() > 3
    keys = list(zip(points.point_ids.tolist(), points.image_ids.tolist(), strict=True))
    assert keys == sorted(set(keys))
    place = np.array([shot.place for shot in shots])[points.image_ids]
    first = np.searchsorted(points.point_ids, points.point_ids)
    assert (place == place[first]).all()
    for index in range(len(shots)):
        features = points.feature_ids[points.image_ids == index]
        assert features.tolist() == list(range(len(features)))


def test_the_same_seed_gives_the_same_points(
    shots: list[Shot], depths: Depths, points: SparsePoints
) -> None:
    again = exact_tracks(shots, depths, points_per_shot=60, rng=rng())
    assert np.array_equal(again.xyz, points.xyz)
    assert np.array_equal(again.xy_px, points.xy_px)


def shot(name: str, x: float, *, camera: Camera, yaw_deg: float = 90.0) -> Shot:
    """A camera at (x, 0, 0) that looks along +y unless turned."""
    look = day_look(rng(), azimuth=0.0, elevation=1.0, overcast=0.0, noise_seed=0)
    pose = looking_at(np.array([x, 0.0, 0.0]), np.radians(yaw_deg), 0.0, 0.0)
    return Shot(name, "mapping", "day", 0, 0, name, camera, pose, look, (), False)


PINHOLE = Camera("PINHOLE", 40, 30, (40.0, 40.0, 20.0, 15.0))
WALL_M = 10.0


def wall() -> NDArray[np.float32]:
    return np.full((30, 40), WALL_M, np.float32)


def test_what_stands_in_front_hides_the_wall() -> None:
    pair = [shot("a", 0.0, camera=PINHOLE), shot("b", 0.0, camera=PINHOLE)]
    hidden = wall()
    hidden[:, :20] = 5.0  # in b, something covers the left half
    points = exact_tracks(pair, {"a": wall(), "b": hidden}, points_per_shot=1200, rng=rng())
    # nothing at 5 m is seen by a, nothing on the left of the wall by b
    assert (points.xy_px[:, 0] > 20).all()
    np.testing.assert_allclose(points.xyz[:, 1], WALL_M, atol=1e-9)
    # all of the visible half from both, but for the border
    assert len(points) == 2 * 18 * 26


def test_nothing_is_seen_without_depth_behind_or_out_of_the_image() -> None:
    nothing = {"a": np.zeros((30, 40), np.float32), "b": np.zeros((30, 40), np.float32)}
    pair = [shot("a", 0.0, camera=PINHOLE), shot("b", 0.0, camera=PINHOLE)]
    assert len(exact_tracks(pair, nothing, points_per_shot=50, rng=rng())) == 0
    behind = [shot("a", 0.0, camera=PINHOLE), shot("b", 0.0, camera=PINHOLE, yaw_deg=-90.0)]
    both = {"a": wall(), "b": wall()}
    assert len(exact_tracks(behind, both, points_per_shot=50, rng=rng())) == 0
    beside = [shot("a", 0.0, camera=PINHOLE), shot("b", 50.0, camera=PINHOLE)]
    assert len(exact_tracks(beside, both, points_per_shot=50, rng=rng())) == 0
    assert len(exact_tracks([], {}, points_per_shot=50, rng=rng())) == 0


def test_other_places_are_not_looked_at() -> None:
    pair = [shot("a", 0.0, camera=PINHOLE), replace(shot("b", 0.0, camera=PINHOLE), place=1)]
    both = {"a": wall(), "b": wall()}
    assert len(exact_tracks(pair, both, points_per_shot=50, rng=rng())) == 0


def test_strong_distortion_folds_nothing_back_into_the_image() -> None:
    # r (1 - 0.25 r^2) turns back at r = 1.15: rays from far outside land inside the image again
    camera = Camera("SIMPLE_RADIAL", 40, 30, (40.0, 20.0, 15.0, -0.25))
    pair = [shot("a", 0.0, camera=camera), shot("b", 19.5, camera=camera)]
    both = {"a": wall(), "b": wall()}
    x_px = 20.0 + 40.0 * -1.95 * (1 - 0.25 * 1.95**2)
    assert 2 < x_px < 38  # the middle of a's image, as b's formula has it
    assert len(exact_tracks(pair, both, points_per_shot=1200, rng=rng())) == 0


def test_poses_may_stand_in_another_frame(shots: list[Shot], depths: Depths) -> None:
    other_from_world = RigidTransform.from_matrix(np.diag([1.0, -1.0, -1.0]), np.array([9, 8, 7]))
    moved = [
        replace(shot, cam_from_world=shot.cam_from_world @ other_from_world.inverse())
        for shot in shots
    ]
    there = exact_tracks(moved, depths, points_per_shot=20, rng=rng())
    here = exact_tracks(shots, depths, points_per_shot=20, rng=rng())
    np.testing.assert_allclose(there.xyz, other_from_world.apply(here.xyz), atol=1e-9)
