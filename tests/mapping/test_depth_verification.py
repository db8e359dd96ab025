"""Depth verification against planes and steps whose depth maps are exact."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from megloc_kapture.mapping.depth_verification import (
    DepthVerificationOptions,
    contradicted_by_depth,
    depth_noise,
)
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
BESIDE = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.05, 0.0, 0.0))
SAME = RigidTransform.identity()
EXACT = DepthVerificationOptions(
    max_sigmas=3.0, noise=(0.01, 0.0, 0.0), keypoint_noise_px=0.0, window_px=0
)


def tilted_plane() -> tuple[np.ndarray, np.ndarray]:
    """A depth map of the plane z = 2 + 0.3 x, and a normal form n . X = 2 of it."""
    x = (np.arange(64) + 0.5 - 32.0) / 60.0
    depth = np.broadcast_to(2.0 / (1.0 - 0.3 * x), (48, 64)).astype(np.float32)
    return depth, np.array([-0.3, 0.0, 1.0])


@given(
    seed=st.integers(0, 2**32 - 1),
    off=st.floats(-0.2, 0.2).filter(lambda off: abs(abs(off) - 0.03) > 0.02),
)
def test_points_off_the_plane_by_more_than_the_noise_contradict(seed: int, off: float) -> None:
    depth, normal = tilted_plane()
    rng = np.random.default_rng(seed)
    rays = np.column_stack([rng.uniform(-0.4, 0.4, 50), rng.uniform(-0.3, 0.3, 50), np.ones(50)])
    on_plane = rays * (2.0 / (rays @ normal))[:, None]
    # within a pixel the plane's depth changes by less than 0.02
    in_depth = on_plane * ((on_plane[:, 2] + off) / on_plane[:, 2])[:, None]
    points = BESIDE.apply(in_depth)
    contradicted, checked = contradicted_by_depth(points, depth, CAMERA, BESIDE, EXACT)
    assert checked.all()
    assert contradicted.all() if abs(off) > 0.03 else not contradicted.any()


def test_the_offset_between_the_cameras_counts() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:, 32:] = 1.0
    # in the depth camera the point is left of the step, where the surface is 2 away
    point = np.array([[0.02, 0.0, 2.0]])
    assert contradicted_by_depth(point, depth, CAMERA, SAME, EXACT)[0].all()
    assert not contradicted_by_depth(point, depth, CAMERA, BESIDE, EXACT)[0].any()


def test_near_an_edge_either_surface_may_be_meant() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:, 32:] = 1.0
    options = EXACT.model_copy(update={"window_px": 2})
    # pixel columns 28 to 35: one metre away is right from column 30 on
    columns = np.arange(28, 36) + 0.5
    near = np.column_stack([(columns - 32.0) / 60.0, np.zeros(8), np.ones(8)])
    found, checked = contradicted_by_depth(near, depth, CAMERA, SAME, options)
    assert checked.all()
    assert found.tolist() == [True, True] + [False] * 6
    found, _ = contradicted_by_depth(near * 2.0, depth, CAMERA, SAME, options)
    assert found.tolist() == [False] * 6 + [True, True]
    # and behind both there is nothing
    assert contradicted_by_depth(near * 2.5, depth, CAMERA, SAME, options)[0].all()


@pytest.mark.parametrize("missing", [0.0, -1.0, np.nan, np.inf])
def test_missing_depth_says_nothing(missing: float) -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    depth[20:28, 28:36] = missing
    wrong = np.array([[0.0, 0.0, 5.0]])
    options = EXACT.model_copy(update={"window_px": 1})
    for point in (wrong, wrong + [0.3, 0.0, 0.0]):  # in the hole, and one pixel beside it
        contradicted, checked = contradicted_by_depth(point, depth, CAMERA, SAME, options)
        assert not contradicted.any()
        assert not checked.any()
    far_from_it = wrong + [1.0, 0.0, 0.0]
    assert contradicted_by_depth(far_from_it, depth, CAMERA, SAME, options)[0].all()


def test_points_outside_and_behind_are_not_judged() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    points = np.array([[0.0, 0.0, -2.0], [10.0, 0.0, 2.0], [0.0, -10.0, 2.0], [0.0, 0.0, 0.0]])
    contradicted, checked = contradicted_by_depth(points, depth, CAMERA, SAME, EXACT)
    assert not contradicted.any()
    assert not checked.any()


def test_an_uncertain_point_may_be_farther_off() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    points = np.repeat([[0.0, 0.0, 2.5]], 4, axis=0)
    options = EXACT.model_copy(update={"keypoint_noise_px": 2.0})
    # 0.5 off: 3 sigmas of hypot(0.01, 2 * deviation)
    least = np.sqrt((0.5 / 3) ** 2 - 0.01**2) / 2.0
    deviations = np.array([0.0, np.nan, 0.999 * least, 1.001 * least])
    contradicted, _ = contradicted_by_depth(
        points, depth, CAMERA, SAME, options, deviations=deviations
    )
    assert contradicted.tolist() == [True, True, True, False]


def test_default_noise_is_that_of_the_source() -> None:
    z = np.linspace(0.4, 5.0, 20)
    published = 0.0012 + 0.0019 * (z - 0.4) ** 2
    np.testing.assert_allclose(depth_noise(z, DepthVerificationOptions().noise), published)


@pytest.mark.parametrize("noise", [(0.0, 0.0, 0.1), (0.001, -0.01, 0.001), (0.01, -0.1, 0.0)])
def test_noise_that_is_not_positive_is_refused(noise: tuple[float, float, float]) -> None:
    with pytest.raises(ValidationError, match="not positive at every depth"):
        DepthVerificationOptions(noise=noise)
