"""Displacements of the scene in a query, against views of a textured plane of known poses."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import project
from megloc_kapture.localization.alignment import displacements_px
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera.pinhole(320, 240, 300.0)
DEPTH_M = 4.0


def texture() -> NDArray[np.uint8]:
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(1200, 1200)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 4)
    return np.uint8(np.clip(128 + 40 * smooth / smooth.std(), 0, 255))


PLANE = texture()


def view(pose: RigidTransform, camera: Camera = CAMERA) -> NDArray[np.uint8]:
    """What a camera sees of the plane at z = 4 m, of which a pixel is 1 / 75 m."""
    corners = np.float32([[0, 0], [1200, 0], [1200, 1200], [0, 1200]])
    world = np.column_stack([(corners - 600) / 75, np.full(4, DEPTH_M)])
    px = project(camera, pose, world.astype(np.float64)).astype(np.float32)
    homography = cv2.getPerspectiveTransform(corners - 0.5, px - 0.5)
    seen = cv2.warpPerspective(PLANE, homography, (camera.width, camera.height))
    return np.repeat(seen[..., None], 3, axis=2)


class Scene:
    """A query and map images, as arrays."""

    def __init__(self, query: NDArray[np.uint8], poses: dict[str, RigidTransform]) -> None:
        self.query, self.poses = query, poses

    def query_image(self, name: str) -> NDArray[np.uint8]:
        return self.query

    def map_image(self, name: str) -> NDArray[np.uint8]:
        if name not in self.poses:
            raise DataError(f"no pixels of {name}")
        return view(self.poses[name])

    def map_camera(self, name: str) -> Camera:
        return CAMERA

    def map_pose(self, name: str) -> RigidTransform:
        return self.poses.get(name, RigidTransform.identity())


def moved(
    x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0, turn_deg: float = 0.0
) -> RigidTransform:
    half = math.radians(turn_deg) / 2
    return RigidTransform((math.cos(half), 0.0, 0.0, math.sin(half)), (x_m, y_m, z_m))


def on_plane(count: int = 200) -> NDArray[np.float64]:
    xy = np.random.default_rng(1).uniform(-1.0, 1.0, (count, 2))
    return np.column_stack([xy, np.full(count, DEPTH_M)])


@pytest.mark.parametrize(
    "true_pose",
    [moved(), moved(0.2, -0.1), moved(turn_deg=40), moved(z_m=1.2), moved(0.1, 0.1, -0.8, -75)],
)
def test_nothing_is_displaced_at_the_true_pose(true_pose: RigidTransform) -> None:
    # brighter, of less contrast and noisy: as at another time of the day
    noise = np.random.default_rng(0).normal(0, 4, (240, 320, 1))
    query = np.uint8(np.clip(90 + 0.4 * view(true_pose).astype(float) + noise, 0, 255))
    scene = Scene(query, {"a": moved(), "b": moved(-0.2)})
    points = on_plane()
    found = displacements_px("q", CAMERA, true_pose, points, ["a", "b"] * 100, scene)
    assert len(found) > 150
    assert np.median(found) < 0.35


@pytest.mark.parametrize("shift_px", [(1.5, 0.0), (0.0, -2.25), (3.0, 4.0)])
def test_a_pose_that_is_off_is_told_by_as_many_pixels(shift_px: tuple[float, float]) -> None:
    metres = [one * DEPTH_M / 300 for one in shift_px]
    scene = Scene(view(moved(*metres)), {"a": moved()})
    found = displacements_px("q", CAMERA, moved(), on_plane(), ["a"] * 200, scene)
    assert len(found) > 150
    assert np.median(found) == pytest.approx(math.hypot(*shift_px), abs=0.15)


def test_another_scene_is_not_found() -> None:
    query = view(moved())[::-1, ::-1].copy()
    found = displacements_px(
        "q", CAMERA, moved(), on_plane(), ["a"] * 200, Scene(query, {"a": moved()})
    )
    assert np.median(found) > 2


def test_nothing_is_said_without_pixels_or_points() -> None:
    scene = Scene(view(moved()), {"a": moved()})
    assert len(displacements_px("q", CAMERA, moved(), np.zeros((0, 3)), [], scene)) == 0
    assert len(displacements_px("q", CAMERA, moved(), on_plane(3), ["lost"] * 3, scene)) == 0
    flat = Scene(np.full((240, 320, 3), 90, np.uint8), {"a": moved()})
    assert len(displacements_px("q", CAMERA, moved(), on_plane(), ["a"] * 200, flat)) == 0
    behind = -on_plane()
    assert len(displacements_px("q", CAMERA, moved(), behind, ["a"] * 200, scene)) == 0
