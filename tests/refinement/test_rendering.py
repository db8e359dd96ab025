"""Refinement by rendering in the corner of a room, whose poses and depths are exact."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import pytest
from corner import CAMERA, depth_m, pose_at, render
from numpy.typing import NDArray
from poses import displaced, pose_errors
from scenes import Scene

from megloc_kapture.geometry.warping import PosedImage
from megloc_kapture.plugins import DepthView, PoseRefinement
from megloc_kapture.refinement.acceptance import RenderingOptions
from megloc_kapture.refinement.rendering import Rendering, RenderingRefinement
from megloc_kapture.values import RigidTransform

HERE = RigidTransform.identity()


@dataclass(frozen=True, eq=False)
class Case:
    query: PosedImage
    truth: RigidTransform
    references: tuple[PosedImage, ...]


def at_night(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the image of a night camera: a fifth of the light, other colours, noise."""
    noise = np.random.default_rng(0).normal(0, 2, image.shape)
    return np.clip(0.2 * image * [1.1, 0.92, 0.75] + noise, 0, 255).astype(np.uint8)


def reference(pose: RigidTransform) -> PosedImage:
    return PosedImage(render(pose), CAMERA, pose, DepthView(CAMERA, depth_m(pose), HERE))


@pytest.fixture(scope="module")
def case() -> Case:
    truth = pose_at((0.1, 0.0, 0.0), 3, 2)
    near = (
        pose_at((-0.4, 0.1, 0.2), 0, 1),
        pose_at((0.5, -0.1, -0.1), 5, 3),
        pose_at((0.0, 0.3, 0.4), 4, -1),
        pose_at((-0.2, -0.2, -0.5), 2, 4),
    )
    query = PosedImage(at_night(render(truth)), CAMERA, truth)
    return Case(query, truth, tuple(map(reference, near)))


def run(case: Case, start: RigidTransform) -> PoseRefinement:
    query = replace(case.query, cam_from_world=start)
    return RenderingRefinement(query, case.references, RenderingOptions()).refine()


def assert_accurate(refined: PoseRefinement, truth: RigidTransform, m: float, deg: float) -> None:
    assert refined.accepted, refined.reason
    off_m, off_deg = pose_errors(refined.cam_from_world, truth)
    assert off_m < m and off_deg < deg


def showing(case: Case, image: NDArray[np.uint8], **other: object) -> Case:
    """Return the case with another image of the query."""
    return replace(case, query=replace(case.query, image=image, **other))


def occluded(image: NDArray[np.uint8], seed: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Cover 30 % of the image; return it and the mask of the rest."""
    height, width = image.shape[:2]
    free = np.ones((height, width), bool)
    free[int(0.2 * height) : int(0.9 * height), int(0.3 * width) : int(0.73 * width)] = False
    assert 0.29 < 1 - free.mean() < 0.31
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(size=image.shape), (0, 0), 3)
    cloth = np.clip(90 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)
    return np.where(free[..., None], image, cloth), free


def test_a_pose_is_refined_despite_gain_colour_and_noise_of_the_night(case: Case) -> None:
    start = displaced(case.truth, 0)
    refined = run(case, start)
    assert_accurate(refined, case.truth, 0.005, 0.1)
    assert refined.measures["cost_after"] < refined.measures["cost_before"]
    assert refined.measures["moved_m"] == pytest.approx(
        pose_errors(refined.cam_from_world, start)[0]
    )
    covariance = refined.covariance
    difference = case.truth @ refined.cam_from_world.inverse()
    vector = np.concatenate([2 * np.array(difference.quat_wxyz[1:]), difference.translation])
    # 22.5 is the 99.9 % quantile of six degrees of freedom; it is an estimate, so twice that
    assert vector @ np.linalg.solve(covariance, vector) < 45
    assert np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) < 0.02


def test_the_true_pose_is_kept(case: Case) -> None:
    image, _ = occluded(case.query.image, 0)
    for seen in (case, showing(case, image)):
        refined = run(seen, case.truth)
        assert not refined.accepted and refined.cam_from_world is case.truth
        # the new pose is near, but the improvement is not significant
        assert 0 < refined.measures["moved_m"] < 0.015
        assert refined.measures["cost_after"] < refined.measures["cost_before"]


def test_a_wrong_search_does_not_spoil_a_good_start(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    away = displaced(case.truth, 3, m=0.1, deg=3.0)
    monkeypatch.setattr(
        RenderingRefinement,
        "_align_from_search",
        lambda self, coarsest, start, sight: self._align(0, away, sight),
    )
    refined = run(case, displaced(case.truth, 4, m=0.01, deg=0.1))
    assert_accurate(refined, case.truth, 0.008, 0.08)


def test_a_masked_object_changes_nothing(case: Case) -> None:
    start = displaced(case.truth, 1)
    covered, free = occluded(case.query.image, 0)
    result, same = (run(showing(case, i, mask=free), start) for i in (covered, case.query.image))
    assert result.accepted and pose_errors(result.cam_from_world, case.truth)[0] < 0.01
    assert (result.cam_from_world, result.measures) == (same.cam_from_world, same.measures)


def test_a_pose_that_the_references_do_not_cover_is_kept(case: Case) -> None:
    away = RigidTransform((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0)) @ case.truth  # looks back
    single = replace(case, references=case.references[:1])
    refined = run(single, away)
    assert "cover 0% of the query" in refined.reason and refined.cam_from_world is away


def test_the_plugin_takes_the_first_references_that_have_depth(case: Case) -> None:
    start, given = displaced(case.truth, 0), {str(k): r for k, r in enumerate(case.references)}
    scene = Scene(
        {name: each.cam_from_world for name, each in given.items()},
        {name: each.camera for name, each in given.items()},
        {name: each.depth for name, each in given.items()},
        {name: each.image for name, each in given.items()} | {"query": case.query.image},
    )
    plugin = pickle.loads(pickle.dumps(Rendering(RenderingOptions(max_references=2))))
    assert plugin.name == "rendering"
    refine = partial(plugin.refine, "query", case.query.camera, start, scene=scene)
    assert refine(["flat"]).reason == "no reference image has depth" and not scene.asked
    refined = refine(["flat", "0", "1", "2"])
    assert scene.asked == ["0", "1", "query"]
    query = replace(case.query, cam_from_world=start)
    direct = RenderingRefinement(query, case.references[:2], RenderingOptions()).refine()
    assert refined.cam_from_world == direct.cam_from_world and refined.accepted
