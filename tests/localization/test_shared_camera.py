"""One camera of several photographs, against rendered truth in numbers: exact points and pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import px_from_cam
from megloc_kapture.localization.estimation import AbsolutePoseOptions
from megloc_kapture.localization.shared_camera import shared_camera, solve_with_shared_camera
from megloc_kapture.values import Camera, Pose, RigidTransform

TRUE = Camera("SIMPLE_RADIAL", 1536, 1024, (1380.0, 768.0, 512.0, 0.0))
OPTIONS = AbsolutePoseOptions()


def photograph(seed: int, focal: float, deviation: float) -> tuple[Pose, RigidTransform]:
    """A pose with an estimate of the camera of its own, and the true pose."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-6, -4, 9), (6, 4, 12), (300, 3))
    turn = Rotation.from_rotvec(rng.uniform(-0.05, 0.05, 3)).as_matrix()
    true = RigidTransform.from_matrix(turn, rng.uniform(-0.5, 0.5, 3))
    px = px_from_cam(TRUE, true.apply(points)) + rng.normal(0, 1.0, (300, 2))
    camera = replace(TRUE, params=(focal, 768.0, 512.0, 0.0), focal_deviation=deviation)
    # nearer or farther by as much as the focal length is off
    off = np.array(true.translation) + (0, 0, 10.5 * (focal / 1380 - 1))
    pose = RigidTransform.from_matrix(turn, off)
    return Pose(
        pose, 300, 300, camera=camera, inlier_points_px=px, inlier_points_world=points
    ), true


def test_poses_come_nearer_to_the_truth() -> None:
    estimates = ((1310.0, 0.05), (1372.0, 0.006), (1385.0, 0.006), (1420.0, 0.03), (1384.0, 0.005))
    alone = [photograph(seed, *estimate) for seed, estimate in enumerate(estimates)]
    solved = solve_with_shared_camera([pose for pose, _ in alone], OPTIONS)
    before, after = (
        [float(np.linalg.norm(p.cam_from_world.center() - true.center())) for p, true in pairs]
        for pairs in (alone, list(zip(solved, (true for _, true in alone), strict=True)))
    )
    assert max(after) < 0.3 * max(before) and np.median(after) <= np.median(before)
    for pose in solved:
        assert pose.camera is not None and abs(pose.camera.params[0] / 1380 - 1) < 0.008
        assert pose.remarks[-1].startswith("focal length estimated of 5 photographs")


def test_another_zoom_keeps_its_own() -> None:
    poses = [photograph(seed, focal, 0.005)[0] for seed, focal in enumerate((1378, 1383, 1900))]
    solved = solve_with_shared_camera(poses, OPTIONS)
    assert solved[2] is poses[2]
    assert solved[0].camera != poses[0].camera


@pytest.mark.parametrize("number", [0, 1])
def test_one_has_nothing_to_share(number: int) -> None:
    poses = [photograph(seed, 1350.0, 0.01)[0] for seed in range(number)]
    assert solve_with_shared_camera(poses, OPTIONS) == poses


def test_the_certain_estimates_count() -> None:
    cameras = [
        replace(TRUE, params=(f, 768.0, 512.0, 0.0), focal_deviation=d)
        for f, d in ((1200.0, 0.1), (1380.0, 0.004), (1381.0, 0.004), (1600.0, 0.1))
    ]
    assert shared_camera(cameras).params[0] in (1380.0, 1381.0)
    assert shared_camera(cameras) == shared_camera(cameras[::-1])
