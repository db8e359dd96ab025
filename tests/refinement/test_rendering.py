"""Refinement by rendering, and the consistency of a map, in the corner of a room."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest
from corner import CAMERA, depth_m, pose_at, render
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from poses import assert_accurate, displaced, pose_errors
from scenes import Scene

from megloc_kapture.geometry.warping import PosedImage
from megloc_kapture.io.tables import ConsistencyRow
from megloc_kapture.plugins import DepthView, PoseRefinement
from megloc_kapture.refinement.acceptance import CHI2_OF_CHANCE, RenderingOptions
from megloc_kapture.refinement.references import (
    DISPLACEMENT,
    MAX_TRIED,
    ReferenceImages,
    contradicts,
    references_elsewhere,
    spread_names,
)
from megloc_kapture.refinement.rendering import Rendering, RenderingRefinement
from megloc_kapture.stages.pose_refinement import MAX_TESTED, MIN_TESTED, judge_consistency
from megloc_kapture.values import Camera, RigidTransform

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


def view(cam_from_world: RigidTransform, camera: Camera = CAMERA) -> PosedImage:
    depth = DepthView(camera, depth_m(cam_from_world, camera), HERE)
    return PosedImage(render(cam_from_world, camera), camera, cam_from_world, depth)


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
    return Case(query, truth, tuple(map(view, near)))


def run(case: Case, start: RigidTransform) -> PoseRefinement:
    query = replace(case.query, cam_from_world=start)
    return RenderingRefinement(query, case.references, RenderingOptions()).refine()


def showing(case: Case, image: NDArray[np.uint8], **other: object) -> Case:
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


def test_a_wrong_search_spoils_no_good_start(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
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
    scene = scene_of(given)
    scene.images["query"] = case.query.image
    plugin = pickle.loads(pickle.dumps(Rendering(RenderingOptions(max_references=2))))
    assert plugin.name == "rendering"
    refine = partial(plugin.refine, "query", case.query.camera, start, scene=scene)
    assert refine(["flat"]).reason == "no reference image has depth" and not scene.asked
    refined = refine(["flat", "0", "1", "2"])
    assert scene.asked == ["0", "1", "query"]
    query = replace(case.query, cam_from_world=start)
    direct = RenderingRefinement(query, case.references[:2], RenderingOptions()).refine()
    assert refined.cam_from_world == direct.cam_from_world and refined.accepted


Map = Mapping[str, PosedImage]
SMALL = Camera("PINHOLE", 160, 120, (180.0, 181.8, 80.0, 60.0))
SLOW = pytest.mark.slow
QUICK = RenderingOptions(max_references=3)


def small_view(cam_from_world: RigidTransform) -> PosedImage:
    return view(cam_from_world, SMALL)


POSES = [
    pose_at((-1.5, 0.0, 0.0), -4, 3),
    pose_at((-0.9, 0.3, 0.6), -2, 4),
    pose_at((-0.2, -0.3, 0.1), 0, 6),
    pose_at((0.4, 0.2, 0.9), 3, 2),
    pose_at((1.0, -0.1, 0.2), 8, 5),
    pose_at((-0.6, -0.5, -0.8), -6, 8),
]


@pytest.fixture(scope="module")
def corner() -> Map:
    return {f"{k}.png": small_view(each) for k, each in enumerate(POSES)}


def scene_of(images: Map) -> Scene:
    return Scene(
        {name: each.cam_from_world for name, each in images.items()},
        {name: each.camera for name, each in images.items()},
        {name: each.depth for name, each in images.items() if each.depth.depth_m.any()},
        {name: each.image for name, each in images.items()},
    )


def verdict(images: Map) -> ConsistencyRow:
    rendering, scene = Rendering(QUICK), scene_of(images)
    poses = ReferenceImages(scene.poses)
    displacements = (rendering.hold_out(name, poses, scene) for name in spread_names(list(images)))
    return judge_consistency("", "rendering", displacements)


def changed(images: Map, change: Callable[[int, PosedImage], dict[str, Any]]) -> Map:
    """Replace fields of every image; ``change`` gets its number."""
    return {n: replace(each, **change(k, each)) for k, (n, each) in enumerate(images.items())}


def posed(images: Map, change: Callable[[int, RigidTransform], RigidTransform]) -> Map:
    return changed(images, lambda k, each: {"cam_from_world": change(k, each.cam_from_world)})


def with_depth(images: Map, change: Callable[[DepthView], dict[str, Any]]) -> Map:
    return changed(images, lambda _, each: {"depth": replace(each.depth, **change(each.depth))})


def test_an_exact_map_is_consistent(corner: Map) -> None:
    exact = verdict(corner)
    assert not exact.reason and exact.images == len(POSES)
    assert exact.moved_m < 0.005 and exact.turned_deg < 0.08


def test_wrong_poses_contradict_each_other(corner: Map) -> None:
    result = verdict(posed(corner, lambda k, each: displaced(each, k, 0.02, 0.5)))
    assert "contradicts itself" in result.reason
    assert result.moved_m > 0.01 and result.turned_deg > 0.25


@SLOW
@pytest.mark.parametrize(("scale", "off_deg"), [(0.1, 0.0), (12.0, 0.5)])
def test_neither_unit_nor_frame_matters(corner: Map, scale: float, off_deg: float) -> None:
    elsewhere = pose_at((30.0, -20.0, 5.0), 40, 20)

    def change(k: int, each: RigidTransform) -> RigidTransform:
        moved = displaced(each, k, 0.0, off_deg) @ elsewhere
        return RigidTransform.from_matrix(
            moved.rotation_matrix(), scale * np.array(moved.translation)
        )

    moved = posed(corner, change)
    other = with_depth(moved, lambda view: {"depth_m": np.float32(scale) * view.depth_m})
    assert (not verdict(other).reason) == (off_deg == 0.0)


@SLOW
def test_images_with_a_shared_displacement_do_not_confirm_each_other() -> None:
    # two scans of three views each, a centimetre apart
    centers = [(-0.6, 0.0, 0.0), (0.4, 0.1, 0.2)]
    scans = {
        f"{scan}-{k}.png": small_view(
            pose_at((x + 0.01 * k, y, z), (0.0, -5.0, 5.0)[k], (4.0, 3.0, 6.0)[k])
        )
        for scan, (x, y, z) in enumerate(centers)
        for k in range(3)
    }
    assert not verdict(scans).reason
    whole = displaced(HERE, 1, 0.02, 0.5)
    off = posed(scans, lambda k, each: each @ whole if k >= 3 else each)
    assert "6 of 6" in verdict(off).reason


def test_images_without_parallax_or_depth_are_not_judged(corner: Map) -> None:
    # of one position
    rotations = [each.rotation_matrix() for each in POSES]
    center = POSES[2].center()
    there = {
        f"{k}.png": small_view(RigidTransform.from_matrix(r, -r @ center))
        for k, r in enumerate(rotations)
    }
    result = verdict(there)
    assert result.images == 0 and "overlaps with images from other viewpoints" in result.reason
    # and without depth
    result = verdict(with_depth(corner, lambda view: {"depth_m": np.zeros_like(view.depth_m)}))
    assert (result.images, result.contradicting) == (0, 0) and "depth" in result.reason
    assert np.isnan([getattr(result, name) for name in DISPLACEMENT]).all()


def test_images_behind_a_wall_are_no_reference(corner: Map) -> None:
    # two rooms back to back: cameras behind the wall do not see it
    behind = {
        f"behind-{k}.png": small_view(
            RigidTransform.from_matrix(np.eye(3), -np.array([0.3 * k, 0.0, -0.5]))
        )
        for k in range(3)
    }
    # the same images and depths, 8 m farther on
    onwards = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -8.0))
    shifted = posed(behind, lambda _, each: onwards @ each)
    scene = scene_of({"0.png": corner["0.png"], **shifted})
    assert references_elsewhere(corner["0.png"], ReferenceImages(scene.poses), scene) == []


def known(squared_distance: float, moved_px: float = 0.5) -> dict[str, float]:
    values = 0.01, 0.1, moved_px, 0.002, 0.02, squared_distance
    return dict(zip(DISPLACEMENT, values, strict=True))


@given(st.lists(st.booleans(), min_size=MIN_TESTED, max_size=MAX_TESTED))
def test_most_of_the_images_decide(wrong: list[bool]) -> None:
    values = [CHI2_OF_CHANCE * (1.01 if each else 0.99) for each in wrong]
    result = judge_consistency("", "rendering", map(known, values))
    assert (result.images, result.contradicting) == (len(wrong), sum(wrong))
    assert (not result.reason) == (sum(wrong) <= len(wrong) / 2)
    assert result.squared_distance == pytest.approx(np.median(values))


def test_few_images_decide_nothing_and_many_are_not_used() -> None:
    few = judge_consistency("", "", [None, *[known(1.0)] * (MIN_TESTED - 1), None])
    assert "unknown" in few.reason and few.images == MIN_TESTED - 1
    assert not judge_consistency("", "", [None, *[known(1.0)] * MIN_TESTED]).reason
    asked = iter([known(1.0)] * 100)
    assert judge_consistency("", "", asked).images == MAX_TESTED
    assert len(list(asked)) == 100 - MAX_TESTED
    # displacements below the resolution of the alignment do not contradict
    assert contradicts(known(1e4, 0.06)) and not contradicts(known(1e4, 0.04))
    assert not contradicts(known(CHI2_OF_CHANCE, 100.0))
    assert Rendering().require_consistent_map
    assert not Rendering(RenderingOptions(require_consistent_map=False)).require_consistent_map


@given(st.integers(0, 3000))
def test_a_sample_is_bounded_and_spread(count: int) -> None:
    names = [f"{k:05d}" for k in range(count)]
    result = spread_names(names[::-1])
    assert len(result) == min(count, MAX_TRIED) == len(set(result))
    assert set(result) <= set(names)
    for first in (8, 32):
        if count >= first:
            ranks = sorted(int(name) for name in result[:first])
            gaps = np.diff([-1, *ranks, count])
            assert gaps.max() <= 4 * count / first + 1
