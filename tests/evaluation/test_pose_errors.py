"""Position and rotation errors: analytic cases and the missing poses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from megloc_kapture.evaluation.pose_errors import pose_errors
from megloc_kapture.values import RigidTransform


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(0, 100), st.floats(0, 179.9), st.integers(0, 2**32 - 1))
def test_known_displacement(
    displace: Callable[..., Any],
    upright: Callable[..., Any],
    error_m: float,
    angle_deg: float,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    truth = upright(rng.normal(size=3) * 10, rng.uniform(0, 6))
    direction = rng.normal(size=3)
    shift = error_m * direction / np.linalg.norm(direction)
    errors = pose_errors({"a": displace(truth, shift, angle_deg)}, {"a": truth})
    assert errors.position_m[0] == pytest.approx(error_m, abs=1e-11)
    assert errors.angle_deg[0] == pytest.approx(angle_deg, abs=1e-10)


def test_centres_are_compared_not_translations() -> None:
    # two cameras at one place, looking in opposite directions: t differs by 4 m, C by nothing
    there = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -2.0))
    turned = RigidTransform((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 2.0))
    errors = pose_errors({"a": turned}, {"a": there})
    assert errors.position_m[0] == pytest.approx(0.0, abs=1e-12)
    assert errors.angle_deg[0] == pytest.approx(180.0)


def test_the_sign_of_a_quaternion_is_nothing() -> None:
    pose = RigidTransform((0.5, 0.5, 0.5, -0.5), (1.0, 2.0, 3.0))
    negative = RigidTransform((-0.5, -0.5, -0.5, 0.5), (1.0, 2.0, 3.0))
    errors = pose_errors({"a": negative}, {"a": pose})
    assert errors.position_m[0] == 0.0
    assert errors.angle_deg[0] == 0.0


def test_a_missing_pose_is_infinitely_wrong() -> None:
    pose = RigidTransform.identity()
    errors = pose_errors({"b": pose, "foreign": pose}, {"c": pose, "b": pose, "a": pose})
    assert errors.names == ("a", "b", "c")
    assert errors.position_m.tolist() == [np.inf, 0.0, np.inf]
    assert errors.angle_deg.tolist() == [np.inf, 0.0, np.inf]
    assert errors.has_pose.tolist() == [False, True, False]


def test_asked_names_keep_their_order() -> None:
    pose = RigidTransform.identity()
    assert pose_errors({}, {"a": pose, "b": pose}, ["b", "a"]).names == ("b", "a")


def test_nothing_estimated_nothing_true() -> None:
    assert pose_errors({}, {}).position_m.shape == (0,)
