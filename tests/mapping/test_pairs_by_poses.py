"""Pairs by poses against all pairs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from megloc_kapture.mapping import pairs_by_poses as pairs
from megloc_kapture.mapping.pairs_by_poses import PairsByPosesOptions, pairs_by_poses
from megloc_kapture.values import RigidTransform


def camera_at(center: NDArray[np.float64], rotation: Rotation) -> RigidTransform:
    """``cam_from_world`` of a camera at a place, with ``cam_from_world``'s rotation."""
    x, y, z, w = rotation.as_quat()
    tx, ty, tz = (-rotation.apply(center)).tolist()
    return RigidTransform((float(w), float(x), float(y), float(z)), (tx, ty, tz))


def random_cameras(count: int, seed: int, turn: float = 3.0) -> list[RigidTransform]:
    rng = np.random.default_rng(seed)
    return [
        camera_at(10 * rng.normal(size=3), Rotation.from_rotvec(turn * rng.uniform(-1, 1, 3)))
        for _ in range(count)
    ]


def by_loops(cameras: list[RigidTransform], options: PairsByPosesOptions) -> list[list[int]]:
    centers = [camera.center() for camera in cameras]
    # the optical axis in the world: where the camera frame's z axis points
    axes = [
        camera.inverse().apply(np.array([[0.0, 0, 1]]))[0] - camera.center() for camera in cameras
    ]
    found = set()
    for i in range(len(cameras)):
        candidates = []
        for j in range(len(cameras)):
            distance = float(np.linalg.norm(centers[i] - centers[j]))
            angle = np.degrees(np.arccos(np.clip(axes[i] @ axes[j], -1, 1)))
            near = options.max_distance is None or distance <= options.max_distance
            if i != j and near and angle <= options.max_angle_deg:
                candidates.append((distance, j))
        for _, j in sorted(candidates)[: options.num_neighbours]:
            found.add((min(i, j), max(i, j)))
    return [list(pair) for pair in sorted(found)]


@given(
    st.integers(2, 60),
    st.integers(0, 2**32 - 1),
    st.integers(1, 8),
    st.sampled_from([None, 5.0, 20.0]),
    st.sampled_from([15.0, 60.0, 180.0]),
    st.integers(1, 100),
)
@settings(deadline=None)
def test_equal_to_all_pairs(
    count: int,
    seed: int,
    num_neighbours: int,
    max_distance: float | None,
    max_angle_deg: float,
    block: int,
) -> None:
    cameras = random_cameras(count, seed)
    options = PairsByPosesOptions(
        num_neighbours=num_neighbours, max_distance=max_distance, max_angle_deg=max_angle_deg
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pairs, "_BLOCK_ELEMENTS", block)
        found = pairs_by_poses(cameras, options)
    assert found.dtype == np.int64
    assert found.tolist() == by_loops(cameras, options)


def test_neighbours_that_look_away_are_passed_over() -> None:
    # at every place one camera looks ahead and twenty look back; partners are far down the list
    ahead, back = Rotation.identity(), Rotation.from_rotvec([0, np.pi, 0])
    cameras = []
    for place in range(6):
        for k in range(21):
            cameras.append(
                camera_at(np.array([100.0 * place, 0.01 * k, 0]), ahead if k == 0 else back)
            )
    found = pairs_by_poses(cameras, PairsByPosesOptions(num_neighbours=1))
    looking_ahead = [p for p in found.tolist() if p[0] % 21 == 0]
    assert all(b % 21 == 0 for _, b in looking_ahead)
    assert {i for p in looking_ahead for i in p} == {21 * k for k in range(6)}


def test_many_cameras_at_one_place() -> None:
    cameras = [camera_at(np.zeros(3), Rotation.identity())] * 120
    found = pairs_by_poses(cameras, PairsByPosesOptions(num_neighbours=3))
    assert (found[:, 0] < found[:, 1]).all()
    partners = np.bincount(found.ravel(), minlength=120)
    assert partners.min() >= 3
    assert len(found) <= 120 * 3


def test_a_distance_of_exactly_the_maximum_is_near() -> None:
    cameras = [camera_at(np.array([10.0 * k, 0, 0]), Rotation.identity()) for k in range(4)]
    found = pairs_by_poses(cameras, PairsByPosesOptions(max_distance=10.0))
    assert found.tolist() == [[0, 1], [1, 2], [2, 3]]


def test_the_angle_is_between_optical_axes_only() -> None:
    # turned about the optical axis by 180 degrees: looks the same way
    rolled = Rotation.from_rotvec([0, 0, np.pi])
    sideways = Rotation.from_rotvec([0, np.radians(61), 0])
    cameras = [
        camera_at(np.array([float(k), 0, 0]), rotation)
        for k, rotation in enumerate([Rotation.identity(), rolled, sideways])
    ]
    assert pairs_by_poses(cameras).tolist() == [[0, 1]]
    wider = PairsByPosesOptions(max_angle_deg=61.5)
    assert pairs_by_poses(cameras, wider).tolist() == [[0, 1], [0, 2], [1, 2]]


def test_two_runs_give_the_same() -> None:
    # a grid has ties in distance everywhere
    cameras = [
        camera_at(np.array([float(x), float(y), 0]), Rotation.identity())
        for x in range(12)
        for y in range(12)
    ]
    options = PairsByPosesOptions(num_neighbours=5)
    np.testing.assert_array_equal(
        pairs_by_poses(cameras, options), pairs_by_poses(list(cameras), options)
    )


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_images_have_no_pairs(count: int) -> None:
    assert pairs_by_poses(random_cameras(count, 0)).shape == (0, 2)


def test_an_image_searches_so_far_and_no_further(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody looks the same way: to go through all of them would be their number squared."""
    axes = Rotation.from_rotvec(np.linspace([0, 0, 0], [0, np.pi, 0], 400))
    cameras = [camera_at(np.array([float(k), 0, 0]), axes[k]) for k in range(400)]
    searched = []

    class Tree(cKDTree):
        def query(self, x: Any, k: int, **more: Any) -> Any:
            searched.append(len(x) * k)
            return super().query(x, k, **more)

    monkeypatch.setattr(pairs, "cKDTree", Tree)
    monkeypatch.setattr(pairs, "_MAX_SEARCHED", 50)
    options = PairsByPosesOptions(num_neighbours=5, max_angle_deg=0.4)
    assert len(pairs_by_poses(cameras, options)) == 0
    assert sum(searched) <= 400 * 3 * 51
    # one looks like another that is the 50th nearest, and one like the 51st
    cameras[50] = camera_at(np.array([50.0, 0, 0]), axes[0])
    cameras[399 - 51] = camera_at(np.array([399.0 - 51, 0, 0]), axes[399])
    assert pairs_by_poses(cameras, options).tolist() == [[0, 50]]
