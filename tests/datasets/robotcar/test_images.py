"""The rig estimated from the poses of a model with noise and outliers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.robotcar import ImageKey
from megloc_kapture.datasets.robotcar.images import middle_transform, rig_of_model
from megloc_kapture.values import RigidTransform


def transform(rotvec: np.ndarray, translation: np.ndarray) -> RigidTransform:
    return RigidTransform.from_matrix(Rotation.from_rotvec(rotvec).as_matrix(), translation)


RIG = {
    "rear": RigidTransform.identity(),
    "left": transform(np.array([0.1, 1.6, -0.05]), np.array([0.4, -0.1, 0.9])),
    "right": transform(np.array([-0.1, -1.5, 0.1]), np.array([-0.5, 0.0, 1.0])),
}


def poses(moments: int, *, noise: float, wrong: int = 0) -> dict[ImageKey, RigidTransform]:
    rng = np.random.default_rng(0)
    result = {}
    for moment in range(moments):
        rear_from_world = transform(rng.normal(size=3), rng.normal(size=3) * 100)
        for camera, sensor_from_rear in RIG.items():
            off = transform(noise * rng.normal(size=3), noise * rng.normal(size=3))
            if moment < wrong and camera == "left":
                off = transform(rng.normal(size=3), 5 * rng.normal(size=3))
            key = ImageKey("overcast-reference", camera, str(moment))
            result[key] = off @ sensor_from_rear @ rear_from_world
    return result


def apart(a: RigidTransform, b: RigidTransform) -> tuple[float, float]:
    between = a @ b.inverse()
    angle = Rotation.from_matrix(between.rotation_matrix()).magnitude()
    return float(angle), float(np.linalg.norm(between.translation))


@pytest.mark.parametrize(
    ("moments", "noise", "wrong", "error"), [(12, 0.0, 0, 1e-9), (100, 0.01, 15, 0.006)]
)
def test_the_rig_is_the_mean_without_outliers(
    moments: int, noise: float, wrong: int, error: float
) -> None:
    rig = rig_of_model(poses(moments, noise=noise, wrong=wrong))
    assert set(rig) == set(RIG)
    assert max(max(apart(rig[camera], RIG[camera])) for camera in RIG) < error


def test_too_few_moments_give_no_rig() -> None:
    assert rig_of_model(poses(9, noise=0.0)) == {}
    assert rig_of_model({}) == {}


def test_the_sign_of_a_quaternion_does_not_matter() -> None:
    left = RIG["left"]
    w, x, y, z = left.quat_wxyz
    other = RigidTransform((-w, -x, -y, -z), left.translation)
    assert max(apart(middle_transform([left, other, left, other]), left)) < 1e-12
