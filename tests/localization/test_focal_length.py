"""A focal length that does not fit is noticed; one that does is not."""

from __future__ import annotations

import re

import numpy as np
import pytest

from megloc_kapture.geometry.cameras import project
from megloc_kapture.localization.absolute_pose import rig_pose
from megloc_kapture.localization.estimation import PoseProblem, View
from megloc_kapture.localization.focal_length import focal_remark
from megloc_kapture.values import Camera, Pose, RigidTransform

ALONE = RigidTransform.identity()


def remark(
    factor: float,
    *,
    outliers: int = 100,
    noise_px: float = 1.0,
    seed: int = 0,
) -> str | None:
    """Of a facade with 4 m of relief, 10 m away, by a camera that is said to be that longer."""
    rng = np.random.default_rng(seed)
    true = Camera.pinhole(1600, 1200, 1400.0)
    pose = RigidTransform((0.98, 0.05, 0.18, 0.02), (0.3, -0.2, 0.5))
    length = np.linalg.norm(pose.quat_wxyz)
    pose = RigidTransform(tuple((np.array(pose.quat_wxyz) / length).tolist()), pose.translation)
    points = rng.uniform((-5, -4, 8.0), (5, 4, 12.0), (400, 3))
    pixels = project(true, pose, points) + rng.normal(0, noise_px, (400, 2))
    pixels[:outliers] = rng.uniform((0, 0), (1600, 1200), (outliers, 2))
    camera = Camera.pinhole(1600, 1200, 1400.0 * factor)
    view = View(camera, ALONE, pixels, points)
    found = rig_pose([view])
    assert isinstance(found, Pose)
    return focal_remark(PoseProblem.of([view]), found)


@pytest.mark.parametrize("factor", [0.7, 0.8, 0.95, 1.05, 1.2, 1.3])
@pytest.mark.parametrize("seed", range(3))
def test_a_wrong_focal_length_is_estimated(factor: float, seed: int) -> None:
    said = remark(factor, seed=seed)
    assert said is not None
    numbers = re.fullmatch(
        r"the focal length of (\d+) px does not fit: (\d+) \+- (\d+) px would", said
    )
    assert numbers is not None
    assert int(numbers[1]) == round(1400 * factor)
    assert int(numbers[2]) == pytest.approx(1400, rel=0.015)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("noise_px", [0.3, 3.0])
def test_a_right_one_is_left_alone(seed: int, noise_px: float) -> None:
    assert remark(1.0, seed=seed, noise_px=noise_px) is None
    assert remark(1.01, seed=seed, noise_px=noise_px) is None


def test_nothing_is_said_of_a_wall_seen_straight_on() -> None:
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-4, 4, (200, 2)), np.full(200, 10.0)]
    pixels = project(Camera.pinhole(1600, 1200, 1400.0), ALONE, points)
    pixels = pixels + rng.normal(0, 1, (200, 2))
    view = View(Camera.pinhole(1600, 1200, 1700.0), ALONE, pixels, points)
    pose = Pose(RigidTransform(ALONE.quat_wxyz, (0.0, 0.0, 2.14)), 200, 200, np.ones(200, bool))
    assert focal_remark(PoseProblem.of([view]), pose) is None


def test_few_inliers_and_rigs_say_nothing() -> None:
    view = View(Camera.pinhole(64, 48, 50), ALONE, np.zeros((5, 2)), np.ones((5, 3)))
    pose = Pose(ALONE, 5, 5, np.ones(5, bool))
    assert focal_remark(PoseProblem.of([view]), pose) is None
    assert focal_remark(PoseProblem.of([view, view]), pose) is None
