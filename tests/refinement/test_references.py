"""References, and the consistency of a map by its held-out images in a corner of a room."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from corner import depth_m, pose_at, render
from hypothesis import given
from hypothesis import strategies as st
from poses import displaced
from scenes import Scene

from megloc_kapture.geometry.warping import PosedImage
from megloc_kapture.io.tables import ConsistencyRow
from megloc_kapture.plugins import DepthView
from megloc_kapture.refinement.acceptance import CHI2_OF_CHANCE, RenderingOptions
from megloc_kapture.refinement.references import (
    DISPLACEMENT,
    MAX_TRIED,
    ReferenceImages,
    contradicts,
    references_elsewhere,
    spread_names,
)
from megloc_kapture.refinement.rendering import Rendering
from megloc_kapture.stages.pose_refinement import MAX_TESTED, MIN_TESTED, judge_consistency
from megloc_kapture.values import Camera, RigidTransform

HERE = RigidTransform.identity()
Map = Mapping[str, PosedImage]

CAMERA = Camera("PINHOLE", 160, 120, (180.0, 181.8, 80.0, 60.0))
SLOW = pytest.mark.slow
QUICK = RenderingOptions(max_references=3)


def view(cam_from_world: RigidTransform) -> PosedImage:
    depth = DepthView(CAMERA, depth_m(cam_from_world, CAMERA), HERE)
    return PosedImage(render(cam_from_world, CAMERA), CAMERA, cam_from_world, depth)


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
    return {f"{k}.png": view(each) for k, each in enumerate(POSES)}


def scene_of(images: Map) -> Scene:
    """Return a map of images in memory."""
    return Scene(
        {name: each.cam_from_world for name, each in images.items()},
        {name: each.camera for name, each in images.items()},
        {name: each.depth for name, each in images.items() if each.depth.depth_m.any()},
        {name: each.image for name, each in images.items()},
    )


def verdict(images: Map) -> ConsistencyRow:
    """Judge a map by its images."""
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
    """Replace fields of every image's depth."""
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
        f"{scan}-{k}.png": view(
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
        f"{k}.png": view(RigidTransform.from_matrix(r, -r @ center))
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
        f"behind-{k}.png": view(
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
