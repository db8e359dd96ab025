"""Overlap of views against pycolmap's projection of every point."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import project
from megloc_kapture.mapping import frustum_overlap as module
from megloc_kapture.mapping.frustum_overlap import frustum_overlap
from megloc_kapture.mapping.pairs import exhaustive_pairs
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
        patch.setattr(module, "_CHUNK", chunk)
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
