"""Pairs of images compared with loops over all pairs."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from poses import rigid
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.mapping import pairs as module
from megloc_kapture.mapping.pairs import (
    PairsByCovisibilityOptions,
    PairsByPosesOptions,
    PairsBySequenceOptions,
    exhaustive_pairs,
    pairs_by_covisibility,
    pairs_by_poses,
    pairs_by_sequence,
    unique_pairs,
    views_can_overlap,
)
from megloc_kapture.values import Camera, RigidTransform


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_exhaustive_pairs(count: int) -> None:
    result = exhaustive_pairs(count)
    assert result.dtype == np.int64 and result.shape[1] == 2
    assert [tuple(pair) for pair in result.tolist()] == list(combinations(range(count), 2))


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), max_size=30))
def test_unique_pairs(given_pairs: list[tuple[int, int]]) -> None:
    result = unique_pairs(np.array(given_pairs, dtype=np.int64).reshape(-1, 2))
    expected = sorted({(min(p), max(p)) for p in given_pairs if p[0] != p[1]})
    assert result.dtype == np.int64 and result.shape == (len(expected), 2)
    assert [tuple(p) for p in result.tolist()] == expected


def camera_at(center: NDArray[np.float64], rotation: Rotation) -> RigidTransform:
    return RigidTransform.from_matrix(rotation.as_matrix(), -rotation.apply(center))


def random_cameras(count: int, seed: int, turn: float = 3.0) -> list[RigidTransform]:
    rng = np.random.default_rng(seed)
    return [
        camera_at(10 * rng.normal(size=3), Rotation.from_rotvec(turn * rng.uniform(-1, 1, 3)))
        for _ in range(count)
    ]


def by_all_distances(
    cameras: list[RigidTransform], options: PairsByPosesOptions
) -> list[list[int]]:
    centers = np.array([camera.center() for camera in cameras]).reshape(-1, 3)
    # the optical axis in the world is the last row of the rotation
    axes = np.array([camera.rotation_matrix()[2] for camera in cameras]).reshape(-1, 3)
    angles = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    distances = np.where(angles <= options.max_angle_deg, cdist(centers, centers), np.inf)
    np.fill_diagonal(distances, np.inf)
    result = set()
    for i, row in enumerate(distances):
        for j in np.argsort(row, kind="stable")[: options.num_neighbours].tolist():
            if row[j] < np.inf:
                result.add((min(i, j), max(i, j)))
    return [list(pair) for pair in sorted(result)]


@given(
    st.integers(0, 60),
    st.integers(0, 2**32 - 1),
    st.integers(1, 8),
    st.sampled_from([15.0, 60.0, 180.0]),
)
def test_pairs_by_poses_equal_a_loop_over_all_pairs(
    count: int, seed: int, num_neighbours: int, max_angle_deg: float
) -> None:
    cameras = random_cameras(count, seed)
    options = PairsByPosesOptions(num_neighbours=num_neighbours, max_angle_deg=max_angle_deg)
    result = pairs_by_poses(cameras, options)
    assert result.dtype == np.int64 and result.shape[1] == 2
    assert result.tolist() == by_all_distances(cameras, options)


def test_an_angle_of_180_degrees_is_no_bound() -> None:
    # opposite directions at the same position: rounding makes some cosines less than -1
    pairs = PairsByPosesOptions(num_neighbours=1, max_angle_deg=180.0)
    cosines = []
    for rotation in Rotation.random(100, random_state=0):
        back = Rotation.from_euler("y", 180, degrees=True) * rotation
        cameras = [camera_at(np.ones(3), each) for each in (rotation, back)]
        first, second = (camera.rotation_matrix()[2] for camera in cameras)
        cosines.append(float(first @ second))
        assert pairs_by_poses(cameras, pairs).tolist() == [[0, 1]]
    assert min(cosines) < -1.0


def by_sets(
    num_images: int, observations: Sequence[tuple[int, int]], top_k: int, min_shared: int
) -> list[list[int]]:
    """``observations`` are points and images."""
    seen: list[set[int]] = [set() for _ in range(num_images)]
    for point, image in observations:
        seen[image].add(point)
    result = set()
    for image in range(num_images):
        shared = [(-len(seen[image] & seen[other]), other) for other in range(num_images)]
        shared.remove((-len(seen[image]), image))
        for count, other in sorted(shared)[:top_k]:
            if -count >= min_shared:
                result.add((min(image, other), max(image, other)))
    return [list(pair) for pair in sorted(result)]


@given(
    st.integers(1, 12),
    st.lists(st.tuples(st.integers(0, 15), st.integers(0, 11)), max_size=80),
    st.integers(1, 5),
    st.integers(1, 4),
    st.integers(1, 20),
)
# images 0 and 1 share one point, images 1 and 2 two
@example(3, [(0, 0), (0, 1), (1, 1), (1, 2), (2, 1), (2, 2)], 3, 2, 20)
def test_pairs_by_covisibility_equal_the_sets(
    num_images: int,
    observations: list[tuple[int, int]],
    top_k: int,
    min_shared_points: int,
    chunk: int,
) -> None:
    """Including unordered and repeated observations, images without any, and ties."""
    observations = [(point, image) for point, image in observations if image < num_images]
    arrays = np.array(observations, dtype=np.int64).reshape(-1, 2)
    options = PairsByCovisibilityOptions(top_k=top_k)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_IMAGES_AT_ONCE", chunk)
        patch.setattr(module, "_MIN_SHARED_POINTS", min_shared_points)
        result = pairs_by_covisibility(num_images, arrays[:, 0], arrays[:, 1], options)
    assert result.dtype == np.int64 and result.shape[1] == 2
    assert result.tolist() == by_sets(num_images, observations, top_k, min_shared_points)


def by_loops(
    cameras: list[str], timestamps: list[int], options: PairsBySequenceOptions
) -> list[list[int]]:
    result = set()
    for camera in set(cameras):
        of_camera = [image for image in range(len(cameras)) if cameras[image] == camera]
        of_camera.sort(key=lambda image: timestamps[image])
        for place, image in enumerate(of_camera):
            for step in range(1, options.window + 1):
                if options.loop or place + step < len(of_camera):
                    other = of_camera[(place + step) % len(of_camera)]
                    result.add((min(image, other), max(image, other)))
    return [list(pair) for pair in sorted(result) if pair[0] != pair[1]]


@given(
    st.lists(
        st.tuples(st.sampled_from(["a", "b", "c"]), st.integers(-(2**62), 2**62)),
        max_size=30,
        unique=True,
    ),
    st.integers(1, 8),
    st.booleans(),
)
@example([(camera, time) for time in range(4) for camera in "ab"], 1, True)
@example([("a", time) for time in range(8)], 2, True)
def test_pairs_by_sequence_equal_a_loop(records: Any, window: int, loop: bool) -> None:
    cameras, timestamps = [camera for camera, _ in records], [time for _, time in records]
    options = PairsBySequenceOptions(window=window, loop=loop)
    result = pairs_by_sequence(cameras, timestamps, options)
    assert result.shape[1] == 2
    assert result.tolist() == by_loops(cameras, timestamps, options)


CAMERAS = [
    Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.0, 240.0)),
    Camera("OPENCV", 640, 480, (500.0, 510.0, 320.0, 240.0, -0.1, 0.03, 0.002, -0.003)),
    Camera("OPENCV_FISHEYE", 640, 640, (300.0, 300.0, 320.0, 320.0, 0.01, 0.0, 0.0, 0.0)),
]


@given(st.integers(0, 2**32 - 1))
def test_views_with_a_common_point_can_overlap(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = (CAMERAS[at] for at in rng.integers(0, len(CAMERAS), 2))
    poses = []
    for camera in (first, second):
        turn = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
        # the world's origin is in the middle half of the image
        px = rng.uniform(0.25, 0.75, (1, 2)) * (camera.width, camera.height)
        ray = bearing_rays(camera, px)[0] * 10.0 ** rng.uniform(-1, 2)
        poses.append(RigidTransform.from_matrix(turn, ray))
    assert views_can_overlap(first, poses[0], second, poses[1])
    assert views_can_overlap(second, poses[1], first, poses[0])


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
@pytest.mark.parametrize("apart_m", [0.0, 40.0])
def test_opposite_views_do_not_overlap(camera: Camera, apart_m: float) -> None:
    here = RigidTransform.identity()
    # the other camera is behind, and looks away
    there = rigid([0.0, np.pi, 0.0], [0.0, 0.0, -apart_m])
    assert not views_can_overlap(camera, here, camera, there)
    assert not views_can_overlap(camera, there, camera, here)


def test_views_rotated_by_more_than_their_width_do_not_overlap() -> None:
    camera = CAMERAS[0]
    wide_deg = 2 * np.degrees(np.arctan(320 / 500))
    for angle_deg, expected in ((wide_deg - 9.0, True), (wide_deg + 1.0, False)):
        turned = rigid([0.0, np.deg2rad(angle_deg), 0.0], np.zeros(3))
        assert views_can_overlap(camera, RigidTransform.identity(), camera, turned) == expected
