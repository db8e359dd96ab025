"""Refinement by rendering on the synthetic world, whose poses and depths are exact."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest
from megloc_twins.frames import Frame, Lighting
from megloc_twins.options import SyntheticWorldOptions
from megloc_twins.render import PlaceRenderer, RenderedFrame
from megloc_twins.synthetic_kapture import SyntheticWorld, build_world
from megloc_twins.viewpoints import overlap
from numpy.typing import NDArray
from poses import displaced, pose_errors

from megloc_kapture.errors import DataError
from megloc_kapture.plugins import DepthView, PoseRefinement, PoseRefiner
from megloc_kapture.refinement.acceptance import RenderingOptions
from megloc_kapture.refinement.references import RenderingQuery, RenderingReference
from megloc_kapture.refinement.rendering import (
    Rendering,
    _Refining,
    refine_by_rendering,
)
from megloc_kapture.values import RigidTransform

OPTIONS = SyntheticWorldOptions(
    num_places=1, day_queries=1, night_queries=1, width=400, height=300, supersampling=1
)
HERE = RigidTransform.identity()


@dataclass(frozen=True, eq=False)
class Case:
    query: RenderingQuery
    truth: RigidTransform
    references: tuple[RenderingReference, ...]


@pytest.fixture(scope="module")
def world() -> SyntheticWorld:
    return build_world(OPTIONS)


@pytest.fixture(scope="module")
def painter(world: SyntheticWorld) -> PlaceRenderer:
    return PlaceRenderer(world.places[0], seed=OPTIONS.seed, supersampling=OPTIONS.supersampling)


def darkened(look: Lighting) -> Lighting:
    """Return the lighting of a night camera: a fifth of the light, other colours, noise."""
    red, green, blue = look.white_balance
    return replace(
        look,
        exposure=0.2 * look.exposure,
        white_balance=(1.1 * red, 0.92 * green, 0.75 * blue),
        shot_noise=2.2e-3,
        read_noise=0.006,
        blur_px=0.9,
        vignetting=0.3,
    )


def neighbours(world: SyntheticWorld, query: Frame, count: int) -> list[Frame]:
    views = world.coarse_views()
    shares = {shot.name: overlap(views[query.name], views[shot.name]) for shot in world.mapping}
    return sorted(world.mapping, key=lambda shot: -shares[shot.name])[:count]


def reference(shot: Frame, view: RenderedFrame) -> RenderingReference:
    depth = DepthView(shot.camera, view.depth_m, HERE)
    return RenderingReference(view.image, shot.camera, shot.cam_from_world, depth, view.mask)


@pytest.fixture(scope="module")
def shots(world: SyntheticWorld) -> tuple[Frame, list[Frame]]:
    query = next(shot for shot in world.queries if shot.condition == "day")
    return query, neighbours(world, query, 4)


@pytest.fixture(scope="module")
def case(painter: PlaceRenderer, shots: tuple[Frame, list[Frame]]) -> Case:
    query, near = shots
    image = painter.render(replace(query, lighting=darkened(query.lighting))).image
    references = [reference(shot, painter.render(shot, depth=True)) for shot in near]
    return Case(RenderingQuery(image, query.camera), query.cam_from_world, tuple(references))


def run(case: Case, start: RigidTransform, **options: object) -> PoseRefinement:
    chosen = RenderingOptions.model_validate(options)
    return refine_by_rendering(case.query, case.references, start, chosen)


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
    again = run(case, start)
    assert (again.cam_from_world, again.measures) == (refined.cam_from_world, refined.measures)


def test_a_pose_is_refined_under_lamps(world: SyntheticWorld, painter: PlaceRenderer) -> None:
    query = next(shot for shot in world.queries if shot.condition == "night")
    near = [reference(s, painter.render(s, depth=True)) for s in neighbours(world, query, 4)]
    night = RenderingQuery(painter.render(query).image, query.camera)
    truth = query.cam_from_world
    refined = refine_by_rendering(night, near, displaced(truth, 3, m=0.05, deg=1.0))
    assert_accurate(refined, truth, 0.05, 0.25)


def test_the_true_pose_is_kept(case: Case) -> None:
    image, _ = occluded(case.query.image, 0)
    for seen in (case, showing(case, image)):
        refined = run(seen, case.truth)
        assert not refined.accepted and refined.cam_from_world is case.truth
        # the new pose is near, but the improvement is not significant
        assert 0 < refined.measures["moved_m"] < 0.015
        assert refined.measures["cost_after"] < refined.measures["cost_before"]


def test_a_good_start_behind_a_moving_object_never_becomes_worse(case: Case) -> None:
    start = displaced(case.truth, 0, m=0.01, deg=0.1)
    image, _ = occluded(case.query.image, 0)
    hidden = showing(case, image)
    refined = run(hidden, start)
    # it may be kept; without that rule it improves
    free = run(hidden, start, min_significance=0.0)
    assert refined.cam_from_world in (start, free.cam_from_world)
    assert_accurate(free, case.truth, 0.02, 0.2)


def test_a_wrong_search_does_not_spoil_a_good_start(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    away = displaced(case.truth, 3, m=0.1, deg=3.0)
    monkeypatch.setattr(
        _Refining,
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


def test_masked_pixels_of_references_change_nothing(case: Case) -> None:
    start, result = displaced(case.truth, 2), []
    for seed in (0, 1):
        references = []
        for each in case.references:
            image, free = occluded(each.image, seed)
            references.append(replace(each, image=image, mask=free & each.mask))
        result.append(run(replace(case, references=tuple(references)), start))
    assert result[0].accepted
    assert result[0].cam_from_world == result[1].cam_from_world


def test_a_start_far_off_is_kept(case: Case) -> None:
    start = displaced(case.truth, 0, m=1.5, deg=25.0)
    refined = run(case, start, min_overlap=0.0)
    assert not refined.accepted and refined.reason
    assert refined.cam_from_world is start and refined.covariance is None


def test_poses_beyond_a_bound_are_rejected(case: Case) -> None:
    case = replace(case, references=case.references[:2])
    start = displaced(case.truth, 0)
    for options, reason in (
        ({"max_translation_m": 0.05}, "would move"),
        ({"max_rotation_deg": 1.0}, "would turn"),
        ({"min_correlation": 0.99}, "correlation"),
        ({"min_significance": 20.0}, "standard errors"),
        ({"min_overlap": 1.0}, "cover"),
    ):
        refined = run(case, start, **options)
        assert reason in refined.reason and refined.cam_from_world is start
    refined = run(case, start, min_correlation=0.99, accept_always=True)
    assert refined.accepted and refined.cam_from_world != start
    away = RigidTransform((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0)) @ case.truth  # looks back
    assert "cover" in run(case, away).reason


def test_the_plugin_takes_the_first_references_that_have_depth(
    case: Case, new_scene: Callable[..., Any]
) -> None:
    start, given = displaced(case.truth, 0), {str(k): r for k, r in enumerate(case.references)}
    scene = new_scene(
        {name: each.cam_from_world for name, each in given.items()},
        {name: each.camera for name, each in given.items()},
        {name: each.depth for name, each in given.items()},
        {name: each.image for name, each in given.items()} | {"query": case.query.image},
        {name: each.mask for name, each in given.items()},
    )
    plugin = pickle.loads(pickle.dumps(Rendering(RenderingOptions(max_references=2))))
    assert isinstance(plugin, PoseRefiner) and plugin.name == "rendering"
    refine = partial(plugin.refine, "query", case.query.camera, start, scene=scene)
    assert refine(["flat"]).reason == "no reference image has depth" and not scene.asked
    refined = refine(["flat", "0", "1", "2"])
    assert scene.asked == ["0", "1"]
    direct = refine_by_rendering(case.query, case.references[:2], start)
    assert refined.cam_from_world == direct.cam_from_world and refined.accepted
    with pytest.raises(DataError, match="does not fit a camera"):
        run(showing(case, case.query.image[:100]), start)
