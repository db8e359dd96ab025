"""Given poses compared with matches: wrong conventions, random poses, and noise."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from poses import WRONG_CONVENTIONS, rigid
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import bearing_rays, project
from megloc_kapture.geometry.poses import perturbed
from megloc_kapture.matching.pose_check import PairEvidence, count_fitting, pose_contradiction
from megloc_kapture.matching.verification import ray_slopes
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera.pinhole(640, 480, 500.0)


def poses_around(number: int) -> list[RigidTransform]:
    """Return ``cam_from_world`` of cameras on an arc around points, in a rotated world."""
    result, world = [], rigid([0.3, 0.9, -0.5], [5, -9, 3])
    for at in range(number):
        angle = 0.9 * at / number - 0.4
        rotation = Rotation.from_euler("yxz", [-angle, 0.1 * (at % 3), 0.05 * (at % 2)]).as_matrix()
        center = 8 * np.array([np.sin(angle), 0.1 * (-1) ** at, -np.cos(angle)])
        result.append(RigidTransform.from_matrix(rotation, -rotation @ center) @ world)
    return result


def evidence(right: list[RigidTransform], given: list[RigidTransform]) -> list[PairEvidence]:
    """Return the evidence of all pairs; matches have noise of 0.7 px."""
    rng = np.random.default_rng(0)
    points = right[0].inverse().apply(rng.uniform(-1.5, 1.5, (80, 3)) + (0, 0, 8))
    seen = []
    for pose in right:
        px = project(CAMERA, pose, points) + rng.normal(0, 0.7, (80, 2))
        rays = bearing_rays(CAMERA, px)
        seen.append((rays, ray_slopes(CAMERA, px, rays)))
    return [
        PairEvidence(
            f"{a}.jpg", f"{b}.jpg", 80, count_fitting(*seen[a], *seen[b], (given[a], given[b]), 640)
        )
        for a, b in itertools.combinations(range(len(right)), 2)
    ]


def by_chance(right: list[RigidTransform]) -> list[RigidTransform]:
    rotations = Rotation.random(len(right), random_state=1).as_matrix()
    return [
        RigidTransform.from_matrix(rotation, np.array(pose.translation))
        for rotation, pose in zip(rotations, right, strict=True)
    ]


@pytest.mark.parametrize("name", WRONG_CONVENTIONS)
def test_each_convention_is_named(name: str) -> None:
    right = poses_around(9)
    given = [*by_chance(right[:2]), *map(WRONG_CONVENTIONS[name], right[2:])]
    contradiction = pose_contradiction(evidence(right, given))
    assert contradiction is not None and contradiction[1]
    assert [other for other in WRONG_CONVENTIONS if other in contradiction[0]] == [name]


@pytest.mark.parametrize("wrong", [0, 4, 5, 9])
def test_poses_wrong_by_chance_are_counted(wrong: int) -> None:
    """Up to half of the images cause a warning, more are an error."""
    right = poses_around(9)
    given = [*by_chance(right[:wrong]), *right[wrong:]]
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
    deviation = np.repeat([np.deg2rad(0.3), 0.03], 3) / 1.7
    given = [perturbed(pose, deviation * rng.normal(size=6)) for pose in right]
    assert pose_contradiction(evidence(right, given)) is None
    assert pose_contradiction([]) is None


def test_repeated_structure_is_no_contradiction() -> None:
    """Images of two similar ends of a facade match with a wrong two-view model."""
    right = poses_around(9)
    pairs = evidence(right, right)
    alike = [
        replace(pair, fitting=(0, *pair.fitting[1:]))
        if {pair.image, pair.other} in ({"0.jpg", "7.jpg"}, {"0.jpg", "8.jpg"}, {"1.jpg", "8.jpg"})
        else pair
        for pair in pairs
    ]
    assert alike != pairs and pose_contradiction(alike) is None


@pytest.mark.parametrize(("num", "contradicts"), [((30, 30), False), ((42, 42), False),
                                                  ((60, 60), True)])  # fmt: skip
def test_pairs_that_may_look_alike_weigh_little(num: tuple[int, int], contradicts: bool) -> None:
    """Pairs usually have 80 matches; the last image has 90 that fit in one pair, ``num`` do not."""
    right = poses_around(4)
    pairs = evidence(right, right)
    none = (0,) * len(pairs[0].fitting)
    pairs.append(PairEvidence("3.jpg", "last.jpg", 90, (90, *none[1:])))
    for at, matches in enumerate(num):
        pairs.append(PairEvidence(f"{at}.jpg", "last.jpg", matches, none))
    contradiction = pose_contradiction(pairs)
    assert (contradiction is not None) == contradicts
    assert contradiction is None or "1 of 5 compared images" in contradiction[0]


def test_two_images_are_too_few_to_refuse_a_map() -> None:
    """Unless a wrong convention explains the contradiction."""
    right = poses_around(2)
    for given, most in ((by_chance(right), None), ([pose.inverse() for pose in right], True)):
        contradiction = pose_contradiction(evidence(right, given))
        assert (contradiction and contradiction[1]) == most
