"""Pose algebra on arrays compared with scipy and RigidTransform; alignments."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from poses import random_pose
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import median_abs_deviation

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.poses import (
    GeoPosition,
    align_poses,
    align_to_earth,
    camera_centers,
    compose,
    cross_matrix,
    deviation_by_median,
    earth_from_enu,
    geodetic,
    invert,
    movement,
    multiply_quats,
    normalize_quats,
    perturbed,
    rotate,
    rotation_angles_deg,
    rotation_matrices,
    stack_poses,
    unstack_poses,
)
from megloc_kapture.values import RigidTransform

seeds = st.integers(0, 2**32 - 1)


def random_poses(seed: int, count: int = 5) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return normalize_quats(rng.normal(size=(count, 4))), rng.normal(size=(count, 3)) * 10


@given(st.floats(-12, 2.2), seeds)
def test_small_and_large_angles_keep_their_digits(exponent: float, seed: int) -> None:
    angle_deg = 10.0**exponent
    base, _ = random_poses(seed, 1)
    half = np.deg2rad(angle_deg) / 2
    turned = multiply_quats(np.array([np.cos(half), np.sin(half), 0.0, 0.0]), base)
    # an arccos would have an error of 1e-6 degrees; lengths and signs do not matter
    for same in (base, -1.0005 * base):
        result = rotation_angles_deg(turned, same)[0]
        assert result == pytest.approx(angle_deg, rel=1e-12, abs=5e-14)


@given(seeds)
def test_matrices_and_rotation_agree_with_scipy(seed: int) -> None:
    quats, vectors = random_poses(seed)
    rotation = Rotation.from_quat(quats, scalar_first=True)
    np.testing.assert_allclose(rotation_matrices(1.5 * quats), rotation.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rotate(quats, vectors), rotation.apply(vectors), atol=1e-12)


@given(seeds)
def test_arrays_agree_with_the_value_type(seed: int) -> None:
    first = unstack_poses(*random_poses(seed))
    for array, same in zip(stack_poses(first), random_poses(seed), strict=True):
        np.testing.assert_array_equal(array, same)
    second = unstack_poses(*random_poses(seed + 1))
    expected = [a @ b for a, b in zip(first, second, strict=True)]
    quats, translations = compose(*stack_poses(first), *stack_poses(second))
    np.testing.assert_allclose(quats, stack_poses(expected)[0], atol=1e-14)
    np.testing.assert_allclose(translations, stack_poses(expected)[1], atol=1e-12)
    quats, translations = invert(*stack_poses(first))
    inverse = [pose.inverse() for pose in first]
    np.testing.assert_allclose(quats, stack_poses(inverse)[0], atol=1e-14)
    np.testing.assert_allclose(translations, stack_poses(inverse)[1], atol=1e-12)
    centers = camera_centers(*stack_poses(first))
    np.testing.assert_allclose(centers, [pose.center() for pose in first], atol=1e-12)


@given(st.lists(st.floats(-2, 2), min_size=6, max_size=6))
def test_a_perturbation_is_the_exponential_of_its_rotation(step: list[float]) -> None:
    pose = random_pose(np.random.default_rng(1))
    rotation = expm(cross_matrix(np.array(step[:3])))
    moved = perturbed(pose, np.array(step))
    expected = rotation @ pose.translation + step[3:]
    np.testing.assert_allclose(
        moved.rotation_matrix(), rotation @ pose.rotation_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(moved.translation, expected, atol=1e-12)


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 3), st.floats(0.0, 179.0), seeds)
def test_movement_is_of_the_centre_about_any_axis(step_m: Any, angle_deg: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation, axis, center = Rotation.random(random_state=rng), *rng.normal(size=(2, 3))
    turned = Rotation.from_rotvec(np.deg2rad(angle_deg) * axis / np.linalg.norm(axis)) * rotation
    old, new = (
        RigidTransform.from_matrix(r.as_matrix(), -r.as_matrix() @ c)
        for r, c in ((rotation, center), (turned, center + step_m))
    )
    moved_m, turned_deg = movement(old, new)
    assert moved_m == pytest.approx(np.linalg.norm(step_m), abs=1e-9)
    assert turned_deg == pytest.approx(angle_deg, abs=1e-6)


def test_the_deviation_about_zero_is_scipys() -> None:
    values = np.random.default_rng(3).normal(scale=0.2, size=2001)
    expected = median_abs_deviation(values, center=lambda *_, **__: 0.0, scale="normal")
    assert deviation_by_median(values) == pytest.approx(expected, rel=1e-12)


EARTH = earth_from_enu(48.1, 11.6, 520.0)
TURN = Rotation.from_rotvec([0.3, -1.2, 0.8]).as_matrix()


def on_earth(enu: NDArray[np.float64]) -> dict[str, GeoPosition]:
    return {f"{at}": geodetic(EARTH.apply(xyz[None])[0]) for at, xyz in enumerate(enu)}


def in_map(enu: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    return {f"{at}": xyz @ TURN / 7.5 + 3.0 for at, xyz in enumerate(enu)}


def walk(number: int, width_m: float = 12.0) -> NDArray[np.float64]:
    rng = np.random.default_rng(3)
    return rng.uniform((-40, -width_m, -2), (40, width_m, 2), (number, 3))


def test_scale_and_axes_of_exact_positions() -> None:
    enu = walk(8)
    result = align_to_earth(in_map(enu), on_earth(enu))
    assert abs(result.scale / 7.5 - 1) < 1e-6 and result.residual_m < 1e-3
    aligned = np.array([result.enu_from_map.apply(result.scale * p) for p in in_map(enu).values()])
    apart = aligned - enu
    np.testing.assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=1e-3)


def test_noise_and_two_positions_far_off() -> None:
    enu = walk(20)
    noisy = enu + np.random.default_rng(5).normal(0, 1.0, enu.shape)
    noisy[4] += 60
    noisy[9] -= (200, 0, 30)
    result = align_to_earth(in_map(enu), on_earth(noisy))
    assert abs(result.scale / 7.5 - 1) < 0.03
    assert 0.5 < result.residual_m < 3.0


@pytest.mark.parametrize(
    ("enu", "known", "reason"),
    [
        (walk(8), 2, "2 photographs of the map have a GPS position"),
        (walk(8) * (1, 0.01, 0.01), 8, r"spread over 0\.\d m across"),
        (walk(8) * 0.02, 8, "do not determine the scale"),
        (np.ones((4, 3)), 4, "at one place"),
    ],
)
def test_positions_that_do_not_determine_the_scale(enu: Any, known: int, reason: str) -> None:
    positions = dict(list(on_earth(enu).items())[:known])
    with pytest.raises(DataError, match=reason):
        align_to_earth(in_map(enu), positions)


@pytest.mark.parametrize("on_a_line", [False, True])
def test_an_alignment_ignores_wrong_poses(on_a_line: bool) -> None:
    """Half of the poses are right; centres on a line alone would not determine the roll."""
    scale, turn, offset = 0.2, Rotation.random(random_state=1), np.array([100.0, -50.0, 7.0])
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(40, 3)) * ([10.0, 0.0, 0.0] if on_a_line else 10.0)
    rotations = Rotation.random(40, random_state=2)
    target = scale * turn.apply(centers) + offset
    target[20:] = rng.normal(size=(20, 3))

    def poses(rotations: Rotation, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return rotations.as_quat()[:, [3, 0, 1, 2]], -rotations.apply(centers)

    result = align_poses(poses(rotations, centers), poses(rotations * turn.inv(), target))
    assert result.scale == pytest.approx(scale)
    np.testing.assert_allclose(
        result.target_from_source.matrix()[:3],
        np.column_stack([turn.as_matrix(), offset]),
        atol=1e-9,
    )
    assert result.agrees[:20].all() and result.agrees.sum() < 25 and not result.agreed_before.any()


def test_an_alignment_takes_three_poses() -> None:
    two = random_poses(0, 2)
    with pytest.raises(DataError, match="needs 3 or more"):
        align_poses(two, two)
