"""References, and the consistency of a map by its held-out images in a corner of a room."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from corner import pose_at, wall_texture
from hypothesis import given
from hypothesis import strategies as st
from poses import displaced

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.plugins import DepthView
from megloc_kapture.refinement.acceptance import CHI2_OF_CHANCE, RenderingOptions
from megloc_kapture.refinement.references import (
    MAX_TESTED,
    MAX_TRIED,
    MIN_TESTED,
    Consistency,
    Displacement,
    HoldsOut,
    ReferenceImages,
    RenderingReference,
    judge_consistency,
    pyramid_of,
    references_elsewhere,
    spread_names,
)
from megloc_kapture.refinement.rendering import Rendering
from megloc_kapture.values import Camera, RigidTransform

SMALL_CAMERA = Camera("PINHOLE", 80, 60, (70.0, 70.0, 40.0, 30.0))
HERE = RigidTransform.identity()
Map = Mapping[str, RenderingReference]
Verdict = Callable[[Map], Consistency]

CAMERA = Camera("PINHOLE", 160, 120, (130.0, 131.3, 80.0, 60.0))
PX_PER_M = 60
SLOW = pytest.mark.slow
QUICK = RenderingOptions(max_references=3)
# origin, unit vectors of the texture's columns and rows, metres along them
WALLS = (
    ((-4.0, -3.0, 4.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), 6, 6),
    ((2.0, -3.0, 4.0), (0.6, 0.0, -0.8), (0.0, 1.0, 0.0), 5, 6),
    ((-4.0, 1.5, 4.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0), 9, 5),
)


def reference(seed: int) -> RenderingReference:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (60, 80, 3), np.uint8)
    depth_m = rng.uniform(2.0, 2.001, (60, 80)).astype(np.float32)
    return RenderingReference(image, SMALL_CAMERA, HERE, DepthView(SMALL_CAMERA, depth_m, HERE))


def test_an_image_must_fit_its_camera() -> None:
    image = reference(0)
    with pytest.raises(DataError, match="does not fit a camera"):
        pyramid_of(replace(image, image=image.image[:50]), RenderingOptions())


def view(cam_from_world: RigidTransform, camera: Camera) -> RenderingReference:
    """Render the nearest wall of every ray."""
    h, w = camera.height, camera.width
    px = np.stack(np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5), axis=-1).reshape(-1, 2)
    rays = bearing_rays(camera, px)
    rays /= rays[:, 2:]
    directions = rays @ cam_from_world.rotation_matrix()
    depth, image = np.full(h * w, np.inf), np.full((h * w, 3), 128, np.uint8)
    for seed, (corner, u, v, width, height) in enumerate(WALLS):
        origin, across, down = (np.array(each) for each in (corner, u, v))
        normal = np.cross(across, down)
        far = ((origin - cam_from_world.center()) @ normal) / (directions @ normal)
        on = cam_from_world.center() + far[:, None] * directions - origin
        # OpenCV's pixel centres are at integers
        x, y = ((on @ axis * PX_PER_M - 0.5).astype(np.float32) for axis in (across, down))
        painted = wall_texture(width * PX_PER_M, height * PX_PER_M, seed)
        inside = (x >= 0) & (x < painted.shape[1]) & (y >= 0) & (y < painted.shape[0])
        nearest = inside & (far > 0) & (far < depth)
        seen = cv2.remap(painted, x.reshape(h, w), y.reshape(h, w), cv2.INTER_LINEAR)
        depth = np.where(nearest, far, depth)
        image[nearest] = seen.reshape(-1, 3)[nearest]
    depth_m = np.where(np.isfinite(depth), depth, 0.0).reshape(h, w).astype(np.float32)
    shape = (h, w, 3)
    return RenderingReference(
        image.reshape(shape), camera, cam_from_world, DepthView(camera, depth_m, HERE)
    )


POSES = [
    pose_at((-1.5, 0.0, 0.0), -4, 3),
    pose_at((-0.9, 0.3, 0.6), -2, 4),
    pose_at((-0.2, -0.3, 0.1), 0, 6),
    pose_at((0.4, 0.2, 0.9), 3, 2),
    pose_at((1.0, -0.1, 0.2), 8, 5),
    pose_at((-0.6, -0.5, -0.8), -6, 8),
]


def drawn(camera: Camera) -> Map:
    return {f"{k}.png": view(each, camera) for k, each in enumerate(POSES)}


@pytest.fixture(scope="module")
def corner() -> Map:
    return drawn(CAMERA)


def scene_of(images: Map, new_scene: Callable[..., Any]) -> Any:
    """Return a map of images in memory."""
    return new_scene(
        {name: each.cam_from_world for name, each in images.items()},
        {name: each.camera for name, each in images.items()},
        {name: each.depth for name, each in images.items() if each.depth.depth_m.any()},
        {name: each.image for name, each in images.items()},
    )


@pytest.fixture(scope="module")
def verdict(new_scene: Callable[..., Any]) -> Verdict:
    """Return a function that judges a map by its images."""

    def judge(images: Map) -> Consistency:
        rendering, scene = Rendering(QUICK), scene_of(images, new_scene)
        assert isinstance(rendering, HoldsOut)
        poses = ReferenceImages(scene.poses)
        return judge_consistency(
            rendering.hold_out(name, poses, scene) for name in spread_names(list(images))
        )

    return judge


@pytest.fixture(scope="module")
def exact(corner: Map, verdict: Verdict) -> Consistency:
    return verdict(corner)


def changed(images: Map, change: Callable[[int, RenderingReference], dict[str, Any]]) -> Map:
    """Replace fields of every image; ``change`` gets its number."""
    return {n: replace(each, **change(k, each)) for k, (n, each) in enumerate(images.items())}


def posed(images: Map, change: Callable[[int, RigidTransform], RigidTransform]) -> Map:
    return changed(images, lambda k, each: {"cam_from_world": change(k, each.cam_from_world)})


def with_depth(images: Map, change: Callable[[DepthView], dict[str, Any]]) -> Map:
    """Replace fields of every image's depth."""
    return changed(images, lambda _, each: {"depth": replace(each.depth, **change(each.depth))})


def test_an_exact_map_is_consistent(exact: Consistency) -> None:
    assert exact.consistent and exact.images == len(POSES)
    assert exact.median.moved_m < 0.005 and exact.median.turned_deg < 0.08


def test_wrong_poses_contradict_each_other(corner: Map, verdict: Verdict) -> None:
    result = verdict(posed(corner, lambda k, each: displaced(each, k, 0.02, 0.5)))
    assert "contradicts itself" in result.reason
    assert result.median.moved_m > 0.01 and result.median.turned_deg > 0.25


def test_shifted_depth_contradicts_other_views(corner: Map, verdict: Verdict) -> None:
    shifted = with_depth(corner, lambda view: {"depth_m": np.roll(view.depth_m, 7, axis=1)})
    assert "contradicts itself" in verdict(shifted).reason


@SLOW
@pytest.mark.parametrize(("scale", "off_deg"), [(0.1, 0.0), (12.0, 0.5)])
def test_neither_unit_nor_frame_matters(
    corner: Map, verdict: Verdict, scale: float, off_deg: float
) -> None:
    elsewhere = pose_at((30.0, -20.0, 5.0), 40, 20)

    def change(k: int, each: RigidTransform) -> RigidTransform:
        moved = displaced(each, k, 0.0, off_deg) @ elsewhere
        return RigidTransform.from_matrix(
            moved.rotation_matrix(), scale * np.array(moved.translation)
        )

    moved = posed(corner, change)
    other = with_depth(moved, lambda view: {"depth_m": np.float32(scale) * view.depth_m})
    assert verdict(other).consistent == (off_deg == 0.0)


@SLOW
def test_images_with_a_shared_displacement_do_not_confirm_each_other(verdict: Verdict) -> None:
    # two scans of three views each, a centimetre apart
    centers = [(-0.6, 0.0, 0.0), (0.4, 0.1, 0.2)]
    scans = {
        f"{scan}-{k}.png": view(
            pose_at((x + 0.01 * k, y, z), (0.0, -5.0, 5.0)[k], (4.0, 3.0, 6.0)[k]), CAMERA
        )
        for scan, (x, y, z) in enumerate(centers)
        for k in range(3)
    }
    assert verdict(scans).consistent
    whole = displaced(HERE, 1, 0.02, 0.5)
    off = posed(scans, lambda k, each: each @ whole if k >= 3 else each)
    assert "6 of 6" in verdict(off).reason


def test_images_without_parallax_or_depth_are_not_judged(corner: Map, verdict: Verdict) -> None:
    # of one position
    rotations = [each.rotation_matrix() for each in POSES]
    center = POSES[2].center()
    there = {
        f"{k}.png": view(RigidTransform.from_matrix(r, -r @ center), CAMERA)
        for k, r in enumerate(rotations)
    }
    result = verdict(there)
    assert result.images == 0 and "overlaps with images from other viewpoints" in result.reason
    # and without depth
    result = verdict(with_depth(corner, lambda view: {"depth_m": np.zeros_like(view.depth_m)}))
    assert result == Consistency(0, 0, None, result.reason) and "depth" in result.reason


def test_images_behind_a_wall_are_no_reference(corner: Map, new_scene: Callable[..., Any]) -> None:
    # two rooms back to back: cameras behind the wall do not see it
    behind = {
        f"behind-{k}.png": view(
            RigidTransform.from_matrix(np.eye(3), -np.array([0.3 * k, 0.0, -0.5])), CAMERA
        )
        for k in range(3)
    }
    # the same images and depths, 6 m farther on
    onwards = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -6.0))
    shifted = posed(behind, lambda _, each: onwards @ each)
    scene = scene_of({"0.png": corner["0.png"], **shifted}, new_scene)
    assert references_elsewhere(corner["0.png"], ReferenceImages(scene.poses), scene) == []


def known(squared_distance: float, moved_px: float = 0.5) -> Displacement:
    return Displacement(0.01, 0.1, moved_px, 0.002, 0.02, squared_distance)


@given(st.lists(st.booleans(), min_size=MIN_TESTED, max_size=MAX_TESTED))
def test_most_of_the_images_decide(wrong: list[bool]) -> None:
    values = [CHI2_OF_CHANCE * (1.01 if each else 0.99) for each in wrong]
    result = judge_consistency(map(known, values))
    assert (result.images, result.contradicting) == (len(wrong), sum(wrong))
    assert result.consistent == (sum(wrong) <= len(wrong) / 2)
    assert result.median.squared_distance == pytest.approx(np.median(values))


def test_few_images_decide_nothing_and_many_are_not_used() -> None:
    few = judge_consistency([None, *[known(1.0)] * (MIN_TESTED - 1), None])
    assert "unknown" in few.reason and few.images == MIN_TESTED - 1
    assert judge_consistency([None, *[known(1.0)] * MIN_TESTED]).consistent
    asked = iter([known(1.0)] * 100)
    assert judge_consistency(asked).images == MAX_TESTED
    assert len(list(asked)) == 100 - MAX_TESTED
    # displacements below the resolution of the alignment do not contradict
    assert known(1e4, 0.06).contradicts and not known(1e4, 0.04).contradicts
    assert not known(CHI2_OF_CHANCE, 100.0).contradicts
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
