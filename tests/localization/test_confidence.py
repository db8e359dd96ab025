"""Confidence of poses: the values of its terms, and its probabilities."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom

from megloc_kapture.geometry.cameras import project
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions, rig_pose
from megloc_kapture.localization.confidence import (
    OF_ALL,
    TERMS,
    Calibration,
    MatchSources,
    calibration_for,
    calibrations,
    evidence_of,
    with_confidence,
)
from megloc_kapture.localization.map_index import PoseProblem, View
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform

CAMERA = Camera.pinhole(640, 480, 500.0)
POSE = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.1, -0.2, 0.3))
ERROR_PX = 12.0


def scene(
    right: int, wrong: int, *, noise_px: float = 0.5, seed: int = 0
) -> tuple[PoseProblem, Pose, MatchSources]:
    """Return a pose from right and wrong matches with a map image at the origin."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (right + wrong, 3))
    pixels = project(CAMERA, POSE, points) + rng.normal(0, noise_px, (right + wrong, 2))
    pixels[right:] = rng.uniform((0, 0), (640, 480), (wrong, 2))
    view = View(CAMERA, RigidTransform.identity(), pixels, points)
    pose = rig_pose([view], AbsolutePoseOptions(max_error_px=ERROR_PX, min_inliers=4))
    assert isinstance(pose, Pose)
    count = right + wrong
    sources = MatchSources(
        support=np.ones(count, np.int64),
        centers=np.zeros((count, 3)),
        images=np.zeros(count, np.int64),
        num_keypoints=2 * count,
        noise=np.tile([noise_px / 500, noise_px], (count, 1)),
        seen=[points],
    )
    return PoseProblem.of([view]), pose, sources


def terms(right: int, wrong: int, **settings: float) -> dict[str, float]:
    problem, pose, sources = scene(right, wrong, **settings)  # type: ignore[arg-type]
    return evidence_of(problem, pose, sources, ERROR_PX)


def test_terms_have_known_values() -> None:
    result = terms(200, 0, noise_px=1.0)
    assert set(result) == set(TERMS)
    # the median length of a normal vector of deviation 1 in two dimensions
    assert result["residual"] == pytest.approx(math.log(1.177 / ERROR_PX), abs=0.15)
    assert result["misfit"] == 0.0
    assert result["agreement"] == pytest.approx(math.log(200.0))
    # every point of the map is visible and matched
    assert result["matched_share"] == pytest.approx(0.0, abs=0.02)
    # the map image is 0.37 away, the points 6
    assert 0.03 < result["viewing_angle"] * 90 < 6
    assert result["distance_ratio"] < 0.2
    assert result["support"] == pytest.approx(math.log(2.0))


def test_surprise_against_the_binomial_distribution() -> None:
    result = [terms(count, 200 - count)["surprise"] for count in (10, 20, 40, 80)]
    assert result == sorted(result) and result[0] < result[-1]
    problem, pose, sources = scene(40, 160, noise_px=2.0)
    surprise = 10 ** evidence_of(problem, pose, sources, ERROR_PX)["surprise"] - 1
    share = np.pi * ERROR_PX**2 / (640 * 480)
    # at least as surprising as 37 of 197 at the largest radius, less the number of tests
    alone = -binom.logsf(36, 197, share) / math.log(10)
    tests = math.log10(197) + math.log10(math.comb(40, 3)) + 3
    assert surprise > alone - tests
    # less surprising than 40 of 197 at the smallest radius
    least = np.pi * 0.5**2 / (640 * 480)
    assert surprise < -binom.logsf(39, 197, least) / math.log(10)


def test_the_number_of_views_does_not_matter() -> None:
    """Two cameras of a rig count like a single camera with the matches of both."""
    problem, pose, sources = scene(60, 30)
    (view,) = problem.views
    halves = [
        View(CAMERA, RigidTransform.identity(), view.points_px[at], view.points_world[at])
        for at in (slice(0, 45), slice(45, 90))
    ]
    split = PoseProblem.of(halves)
    two = replace(sources, seen=[one.points_world for one in halves])
    one, other = (evidence_of(p, pose, s, ERROR_PX) for p, s in ((problem, sources), (split, two)))
    assert other == pytest.approx(one, rel=0.02)


def test_a_pose_of_random_matches_is_rejected() -> None:
    problem, pose, sources = scene(100, 60)
    result = with_confidence(problem, pose, sources, ERROR_PX, 0.5)
    assert isinstance(result, Pose) and result.confidence is not None and result.confidence > 0.9
    assert result.evidence == evidence_of(problem, pose, sources, ERROR_PX)
    problem, pose, sources = scene(4, 600, noise_px=0.1)
    refused = with_confidence(problem, pose, sources, ERROR_PX, 0.5)
    assert isinstance(refused, Failure) and refused.num_inliers == pose.num_inliers
    assert refused.reason.startswith("the pose's confidence is 0")
    assert refused.confidence is not None and refused.confidence < 0.5
    assert isinstance(with_confidence(problem, pose, sources, ERROR_PX, 0.0), Pose)


def test_a_focal_length_that_does_not_fit_lowers_the_confidence() -> None:
    problem, pose, sources = scene(100, 60)
    alone = with_confidence(problem, pose, sources, ERROR_PX, 0.6)
    near, far = ("remark", 0.03), ("remark", 0.06)
    kept = with_confidence(problem, pose, sources, ERROR_PX, 0.6, near)
    assert isinstance(kept, Pose) and kept.remarks == ("remark",)
    assert kept.confidence == alone.confidence
    refused = with_confidence(problem, pose, sources, ERROR_PX, 0.6, far)
    assert isinstance(refused, Failure) and refused.remarks == ("remark",)
    assert refused.confidence == pytest.approx((alone.confidence or 0) / 4)
    assert refused.reason.endswith("matches agree, and remark")


def test_displaced_surroundings_excuse_keypoint_errors() -> None:
    problem, pose, sources = scene(200, 0, noise_px=3.0)
    exact = replace(sources, noise=np.tile([0.3 / 500, 0.3], (200, 1)))

    def misfit(displaced_px: float, count: int) -> float:
        asked = replace(exact, displacements_rad=lambda _: np.full(count, displaced_px / 500))
        return evidence_of(problem, pose, asked, ERROR_PX)["misfit"]

    assert evidence_of(problem, pose, sources, ERROR_PX)["misfit"] == 0.0
    by_keypoints = evidence_of(problem, pose, exact, ERROR_PX)["misfit"]
    # a map that is ten times better than the query
    expected = math.log(1.177 * 10 / 2.9) * math.log(10)
    assert by_keypoints == pytest.approx(expected, rel=0.1)
    assert misfit(0.5, 100) == 0.0
    assert misfit(2.0, 100) == pytest.approx(math.log(2.0 / 0.3 / 2.9) * math.log(10))
    # the misfit by keypoints is the upper limit, and few displacements have no effect
    assert misfit(6.0, 100) == misfit(0.5, 20) == by_keypoints

    def never(_: Pose) -> NDArray[np.float64]:
        raise AssertionError("asked although there is no misfit")

    evidence_of(problem, pose, replace(sources, displacements_rad=never), ERROR_PX)


def test_uncertain_points_excuse_errors() -> None:
    """Points of little parallax have depth errors that only other viewpoints show."""
    rng = np.random.default_rng(0)
    problem, pose, sources = scene(400, 0, noise_px=0.3)
    (view,) = problem.views
    # along the world's x axis, at a right angle to the viewing direction
    deviation = 0.1
    moved = view.points_world + rng.normal(0, deviation, (400, 1)) * np.array([1.0, 0.0, 0.0])
    known = np.tile([(deviation / 0.3) ** 2, 0.0, 0.0, 0.0, 0.0, 0.0], (400, 1))
    exact = replace(view, points_world=moved)
    uncertain = replace(exact, point_covariances=known)
    without, within = (
        evidence_of(PoseProblem.of([each]), pose, sources, 50.0)["misfit"]
        for each in (exact, uncertain)
    )
    assert without > 3.0 and within == 0.0
    # a pose that is off by more than that is still contradicted
    off = replace(pose, cam_from_world=RigidTransform((1.0, 0.0, 0.0, 0.0), (0.1, -0.1, 0.3)))
    assert evidence_of(PoseProblem.of([uncertain]), off, sources, 50.0)["misfit"] > 1.0


def test_the_misfit_allows_for_the_resolution_of_the_images() -> None:
    problem, pose, sources = scene(200, 0, noise_px=0.5)
    # the map's images are four times as large: their keypoints have a quarter of the angle
    of_large = replace(sources, noise=np.tile([0.5 / 2000, 0.5], (200, 1)))
    assert evidence_of(problem, pose, of_large, ERROR_PX)["misfit"] == 0.0
    of_better = replace(sources, noise=np.tile([0.1 / 500, 0.1], (200, 1)))
    # never better than a third of a pixel
    assert evidence_of(problem, pose, of_better, ERROR_PX)["misfit"] == 0.0
    problem, pose, sources = scene(200, 0, noise_px=2.0)
    of_better = replace(sources, noise=np.tile([0.5 / 2000, 0.5], (200, 1)))
    assert evidence_of(problem, pose, of_better, ERROR_PX)["misfit"] > 0.5


def test_probabilities_follow_the_weighted_sum() -> None:
    model = Calibration("", -1.0, {"residual": 2.0, "misfit": -0.5})
    evidence = dict.fromkeys(TERMS, 1.0)
    assert model.probability(evidence) == pytest.approx(1 / (1 + math.exp(-0.5)))
    assert 0.0 <= model.probability(evidence | {"misfit": 1e6}) < 1e-9
    assert model.probability(evidence | {"residual": 1e6}) == 1.0


def test_the_calibrations_of_the_package() -> None:
    known = calibrations()
    for model in known.values():
        assert model.origin and set(model.weights) <= set(TERMS)
    of_all, of_aliked = known[OF_ALL], known["aliked"]
    assert calibration_for(["rootsift"]) is of_all and calibration_for([]) is of_all
    assert calibration_for(["aliked-n16", "aliked-n16_pyramid"]) is of_aliked
    assert calibration_for(["aliked-n16", "xfeat"]) is of_all


def test_a_map_of_few_points_is_not_trusted() -> None:
    """All 25 visible points may be wrong together; 100 points count."""
    problem, pose, sources = scene(25, 0, noise_px=0.1)
    refused = with_confidence(problem, pose, sources, ERROR_PX, 0.6)
    assert isinstance(refused, Failure) and "too few points" in refused.reason
    assert refused.confidence is not None and 0.3 < refused.confidence < 0.6
    more = np.concatenate([sources.seen[0]] * 4)
    trusted = with_confidence(problem, pose, replace(sources, seen=[more]), ERROR_PX, 0.6)
    assert isinstance(trusted, Pose) and trusted.evidence.keys() == set(TERMS)


def test_unknown_noise_and_points_do_not_count() -> None:
    problem, pose, sources = scene(50, 10)
    unknown = replace(sources, noise=np.full((60, 2), np.nan), seen=[np.zeros((0, 3))])
    result = evidence_of(problem, pose, unknown, ERROR_PX)
    assert result["misfit"] == 0.0 and result["matched_share"] == 0.0
