"""Poses for tests: random ones, disturbed ones, and how far two are apart."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.values import Failure, Pose, PoseRefinement, RigidTransform

OPENGL = RigidTransform((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
# words of the message about a wrong convention, and a pose in that convention
WRONG_CONVENTIONS: dict[str, Callable[[RigidTransform], RigidTransform]] = {
    "poses inverted (camera-to-world": RigidTransform.inverse,
    "poses read with OpenGL's axes": lambda pose: OPENGL @ pose,
    "poses inverted and with OpenGL's axes": lambda pose: (OPENGL @ pose).inverse(),
    "translations read as camera centres": lambda pose: RigidTransform(
        pose.quat_wxyz, tuple(pose.center().tolist())
    ),
    "quaternions read as x, y, z, w": lambda pose: RigidTransform(
        (*pose.quat_wxyz[1:], pose.quat_wxyz[0]), pose.translation
    ),
}


def random_pose(rng: np.random.Generator) -> RigidTransform:
    return RigidTransform.from_matrix(Rotation.random(rng=rng).as_matrix(), 5 * rng.normal(size=3))


def rigid(rotation_vector: ArrayLike, translation: ArrayLike) -> RigidTransform:
    rotation = Rotation.from_rotvec(rotation_vector).as_matrix()
    return RigidTransform.from_matrix(rotation, np.array(translation))


def displaced(pose: RigidTransform, seed: int, m: float = 0.1, deg: float = 2.0) -> RigidTransform:
    """The camera moved and rotated by this much, each in a random direction."""
    rng = np.random.default_rng(seed)
    axis, shift = rng.normal(size=3), rng.normal(size=3)
    turn = Rotation.from_rotvec(np.radians(deg) * axis / np.linalg.norm(axis)).as_matrix()
    rotation = turn @ pose.rotation_matrix()
    center = pose.center() + m * shift / np.linalg.norm(shift)
    return RigidTransform.from_matrix(rotation, -rotation @ center)


def pose_errors(pose: RigidTransform, truth: RigidTransform) -> tuple[float, float]:
    """Distance of the centres in metres, and the angle in degrees."""
    turn = Rotation.from_matrix(pose.rotation_matrix() @ truth.rotation_matrix().T)
    distance_m = np.linalg.norm(pose.center() - truth.center())
    return float(distance_m), float(np.degrees(turn.magnitude()))


def assert_accurate(
    result: PoseRefinement, truth: RigidTransform, max_m: float, max_deg: float
) -> None:
    assert result.accepted, result.reason
    off_m, off_deg = pose_errors(result.cam_from_world, truth)
    assert off_m < max_m and off_deg < max_deg


def error_vector(pose: RigidTransform, truth: RigidTransform) -> NDArray[np.float64]:
    """Return (6,): rotation vector and translation of the step from the pose to the truth."""
    step = truth @ pose.inverse()
    vector = Rotation.from_matrix(step.rotation_matrix()).as_rotvec()
    return np.concatenate([vector, step.translation])


def located(result: Pose | Failure) -> Pose:
    assert isinstance(result, Pose), result
    return result
