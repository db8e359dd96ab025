"""Given poses compared with matches: wrong conventions, random poses, and noise."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import bearing_rays, project
from megloc_kapture.matching.pose_check import PairEvidence, count_fitting, pose_contradiction
from megloc_kapture.matching.verification import ray_slopes
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera.pinhole(640, 480, 500.0)
Matrix = NDArray[np.float64]


def poses_around(number: int) -> list[Matrix]:
    """Return ``cam_from_world`` of cameras on an arc around points, in a rotated world."""
    result = []
    for at in range(number):
        angle = 0.9 * at / number - 0.4
        rotation = Rotation.from_euler("yxz", [-angle, 0.1 * (at % 3), 0.05 * (at % 2)]).as_matrix()
        center = 8 * np.array([np.sin(angle), 0.1 * (-1) ** at, -np.cos(angle)])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
        world = np.eye(4)
        world[:3, :3], world[:3, 3] = Rotation.from_rotvec([0.3, 0.9, -0.5]).as_matrix(), (5, -9, 3)
        result.append(pose @ world)
    return result


def evidence(right: list[Matrix], given: list[RigidTransform]) -> list[PairEvidence]:
    """Return the evidence of all pairs; matches have noise of 0.7 px."""
    rng = np.random.default_rng(0)
    points = np.linalg.inv(right[0]) @ np.append(rng.uniform(-1.5, 1.5, (80, 3)) + (0, 0, 8),
                                                 np.ones((80, 1)), axis=1).T  # fmt: skip
    seen = []
    for pose in right:
        px = project(CAMERA, transform(pose), points[:3].T) + rng.normal(0, 0.7, (80, 2))
        rays = bearing_rays(CAMERA, px)
        seen.append((rays, ray_slopes(CAMERA, px, rays)))
    return [
        PairEvidence(
            f"{a}.jpg", f"{b}.jpg", 80, count_fitting(*seen[a], *seen[b], (given[a], given[b]), 640)
        )
        for a, b in itertools.combinations(range(len(right)), 2)
    ]


def transform(matrix: Matrix) -> RigidTransform:
    return RigidTransform.from_matrix(matrix[:3, :3], matrix[:3, 3])


def turned(pose: Matrix) -> RigidTransform:
    (w, x, y, z), t = transform(pose).quat_wxyz, transform(pose).translation
    return RigidTransform((x, y, z, w), t)


def inverse(pose: Matrix) -> Matrix:
    return np.asarray(np.linalg.inv(pose), np.float64)


OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
GIVEN: dict[str, Callable[[Matrix], RigidTransform]] = {
    "poses inverted (camera-to-world": lambda pose: transform(inverse(pose)),
    "read with OpenGL's axes (y up, z back)": lambda pose: transform(OPENGL @ pose),
    "inverted and with OpenGL's axes": lambda pose: transform(inverse(OPENGL @ pose)),
    "translations read as camera centres": lambda pose: RigidTransform(
        transform(pose).quat_wxyz, tuple(inverse(pose)[:3, 3].tolist())
    ),
    "quaternions read as x, y, z, w": turned,
}


@pytest.mark.parametrize("name", GIVEN)
def test_each_convention_is_named(name: str) -> None:
    right = poses_around(9)
    given = [*by_chance(right[:2]), *(GIVEN[name](pose) for pose in right[2:])]
    contradiction = pose_contradiction(evidence(right, given))
    assert contradiction is not None and contradiction[1]
    named = [other for other in GIVEN if other in contradiction[0]]
    assert named == [name], contradiction


def by_chance(right: list[Matrix]) -> list[RigidTransform]:
    rotations = Rotation.random(len(right), random_state=1).as_matrix()
    return [
        transform(np.block([[rotation, pose[:3, 3:]], [np.zeros(3), 1]]))
        for rotation, pose in zip(rotations, right, strict=True)
    ]


@pytest.mark.parametrize("wrong", [0, 4, 5, 9])
def test_poses_wrong_by_chance_are_counted(wrong: int) -> None:
    """Up to half of the images cause a warning, more are an error."""
    right = poses_around(9)
    given = [*by_chance(right[:wrong]), *map(transform, right[wrong:])]
    contradiction = pose_contradiction(evidence(right, given))
    if wrong == 0:
        assert contradiction is None
        return
    assert contradiction is not None
    message, most = contradiction
    assert most == (wrong > 4) and ".jpg" in message
    if wrong <= 5:
        assert message.startswith(f"the given poses of {wrong} of 9 compared images")


def test_noise_is_no_contradiction() -> None:
    """The noise is 3 cm and 0.3 degrees, 8 m from the points."""
    right, rng = poses_around(9), np.random.default_rng(0)
    given = []
    for pose in right:
        off = np.eye(4)
        off[:3, :3] = Rotation.from_rotvec(np.deg2rad(0.3) * rng.normal(size=3) / 1.7).as_matrix()
        off[:3, 3] = 0.03 * rng.normal(size=3) / 1.7
        given.append(transform(off @ pose))
    assert pose_contradiction(evidence(right, given)) is None
    assert pose_contradiction([]) is None


def test_repeated_structure_is_no_contradiction() -> None:
    """Images of two similar ends of a facade match with a wrong two-view model."""
    right = poses_around(9)
    pairs = evidence(right, list(map(transform, right)))
    alike = [
        replace(pair, fitting=(0, *pair.fitting[1:]))
        if {pair.image, pair.other} in ({"0.jpg", "7.jpg"}, {"0.jpg", "8.jpg"}, {"1.jpg", "8.jpg"})
        else pair
        for pair in pairs
    ]
    assert alike != pairs and pose_contradiction(alike) is None


@pytest.mark.parametrize(("num", "contradicts"), [((30, 30), False), ((42, 42), False),
                                                  ((60, 60), True)])  # fmt: skip
def test_pairs_that_may_only_look_alike_weigh_little(
    num: tuple[int, int], contradicts: bool
) -> None:
    """Pairs usually have 80 matches; the last image has 90 that fit in one pair, ``num`` do not."""
    right = poses_around(4)
    pairs = evidence(right, list(map(transform, right)))
    none = (0,) * len(pairs[0].fitting)
    pairs.append(PairEvidence("3.jpg", "last.jpg", 90, (90, *none[1:])))
    for at, matches in enumerate(num):
        pairs.append(PairEvidence(f"{at}.jpg", "last.jpg", matches, none))
    contradiction = pose_contradiction(pairs)
    assert (contradiction is not None) == contradicts
    assert contradiction is None or "1 of 5 compared images" in contradiction[0]


def test_an_image_of_weak_pairs_alone_is_not_judged() -> None:
    right = poses_around(4)
    pairs = evidence(right, list(map(transform, right)))
    none = (0,) * len(pairs[0].fitting)
    pairs += [PairEvidence(f"{at}.jpg", "last.jpg", 30, none) for at in range(3)]
    assert pose_contradiction(pairs) is None


def test_two_images_are_too_few_to_refuse_a_map() -> None:
    """Unless a wrong convention explains the contradiction."""
    right = poses_around(2)
    for given, most in ((by_chance(right), None), ([*map(transform, map(inverse, right))], True)):
        contradiction = pose_contradiction(evidence(right, given))
        assert (contradiction and contradiction[1]) == most
