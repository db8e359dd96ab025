"""Overlap of views against pycolmap's projection of every point."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import bearing_rays, project
from megloc_kapture.mapping import pairs as module
from megloc_kapture.mapping.pairs import exhaustive_pairs, frustum_overlap, views_can_overlap
from megloc_kapture.values import Camera, RigidTransform

CAMERAS = [
    Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.0, 240.0)),
    Camera("OPENCV", 640, 480, (500.0, 510.0, 320.0, 240.0, -0.1, 0.03, 0.002, -0.003)),
    Camera("OPENCV_FISHEYE", 640, 640, (300.0, 300.0, 320.0, 320.0, 0.01, 0.0, 0.0, 0.0)),
]


def share_seen(
    image: int,
    other: int,
    cameras: list[Camera],
    poses: list[RigidTransform],
    xyz: NDArray[np.float64],
    seen: list[set[int]],
) -> float:
    camera = cameras[other]
    pixels = project(camera, poses[other], xyz[sorted(seen[image])])
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
    return float(inside.mean())


@given(st.integers(0, 2**32 - 1), st.integers(1, 100))
def test_equal_to_projecting_every_point(seed: int, chunk: int) -> None:
    rng = np.random.default_rng(seed)
    count = 7
    cameras = [CAMERAS[k % 3] for k in range(count)]
    turns = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, (count, 3)))
    poses = [RigidTransform.from_matrix(turn.as_matrix(), rng.uniform(-2, 2, 3)) for turn in turns]
    xyz = rng.uniform((-6, -4, -2), (6, 4, 12), (80, 3))
    # repeated observations count once, and the last image has none
    points, images = rng.integers(0, 80, 150), rng.integers(0, count - 1, 150)
    seen = [set(points[images == image].tolist()) for image in range(count)]
    pairs = exhaustive_pairs(count)
    expected = []
    for a, b in pairs.tolist():
        shares = [
            share_seen(i, j, cameras, poses, xyz, seen) for i, j in ((a, b), (b, a)) if seen[i]
        ]
        expected.append(max(shares, default=np.nan))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_PAIRS_AT_ONCE", chunk)
        found = frustum_overlap(pairs, cameras, poses, xyz, points, images)
    np.testing.assert_array_equal(found, expected)


def test_a_near_view_lies_in_a_far_one() -> None:
    grid = np.stack(np.meshgrid(np.linspace(-9, 9, 40), np.linspace(-6, 6, 30)), -1).reshape(-1, 2)
    xyz = np.column_stack([grid, np.zeros(len(grid))])
    level = (1.0, 0.0, 0.0, 0.0)
    far, near = RigidTransform(level, (0.0, 0.0, 16.0)), RigidTransform(level, (0.0, 0.0, 4.0))
    away = RigidTransform((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, -4.0))
    poses, camera = [far, near, away], CAMERAS[0]
    points, images = [], []
    for image, pose in enumerate(poses):
        pixels = project(camera, pose, xyz)
        with np.errstate(invalid="ignore"):
            inside = (pixels > 0).all(axis=1) & (pixels < (640, 480)).all(axis=1)
        points.append(np.flatnonzero(inside))
        images.append(np.full(inside.sum(), image))
    found = frustum_overlap(
        exhaustive_pairs(3),
        [camera] * 3,
        poses,
        xyz,
        np.concatenate(points),
        np.concatenate(images),
    )
    assert found[0] == 1.0
    # the one that looks away sees nothing, and nothing that the others see
    assert len(points[2]) == 0
    assert found[1:].tolist() == [0.0, 0.0]


def test_where_the_distortion_turns_back_nothing_is_seen() -> None:
    """Barrel distortion brings what is far outside back into the image, by its formula."""
    strong = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.3))
    xyz = np.array([[0.0, 0.0, 5.0], [8.5, 0.0, 5.0]])
    level = RigidTransform.identity()
    pixels = project(strong, level, xyz)
    assert (pixels >= 0).all() and (pixels < (640, 480)).all()
    found = frustum_overlap(
        np.array([[0, 1]]), [strong] * 2, [level] * 2, xyz, np.array([0, 1]), np.array([0, 0])
    )
    assert found.tolist() == [0.5]


@given(st.integers(0, 2**32 - 1))
def test_views_with_a_place_in_the_middle_of_both_overlap(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = (CAMERAS[at] for at in rng.integers(0, len(CAMERAS), 2))
    poses = []
    for camera in (first, second):
        turn = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
        # the world's origin is in front, in the middle half
        px = rng.uniform(0.25, 0.75, (1, 2)) * (camera.width, camera.height)
        ray = bearing_rays(camera, px)[0] * 10.0 ** rng.uniform(-1, 2)
        poses.append(RigidTransform.from_matrix(turn, ray))
    assert views_can_overlap(first, poses[0], second, poses[1])
    assert views_can_overlap(second, poses[1], first, poses[0])


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
@pytest.mark.parametrize("apart_m", [0.0, 0.3, 40.0])
def test_views_back_to_back_do_not_overlap(camera: Camera, apart_m: float) -> None:
    here = RigidTransform.identity()
    turn = Rotation.from_euler("y", 180, degrees=True).as_matrix()
    # the other one stands behind, and looks away
    there = RigidTransform.from_matrix(turn, -turn @ [0.0, 0.0, -apart_m])
    assert not views_can_overlap(camera, here, camera, there)
    assert not views_can_overlap(camera, there, camera, here)


def test_views_that_turn_by_more_than_they_are_wide_do_not_overlap() -> None:
    camera = CAMERAS[0]
    wide_deg = 2 * np.degrees(np.arctan(320 / 500))
    for angle_deg, expected in ((wide_deg - 9.0, True), (wide_deg + 1.0, False)):
        turn = Rotation.from_euler("y", angle_deg, degrees=True).as_matrix()
        turned = RigidTransform.from_matrix(turn, np.zeros(3))
        assert views_can_overlap(camera, RigidTransform.identity(), camera, turned) == expected
