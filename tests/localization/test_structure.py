"""The structure distance of images, and displacements of map points in them."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from corner import CAMERA, render
from numpy.typing import NDArray
from scenes import Scene
from scipy.ndimage import gaussian_filter

from megloc_kapture.localization.structure import StructureDistance, _displacements_px
from megloc_kapture.values import RigidTransform

Image = NDArray[np.uint8]
FULL = np.ones((60, 80), bool)


def picture(seed: int, low: int = 50, high: int = 200) -> Image:
    """Coloured blobs, uint8 (60, 80, 3)."""
    coarse = np.random.default_rng(seed).uniform(low, high, (12, 16, 3)).astype(np.float32)
    return cv2.resize(coarse, (80, 60), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


def by_scipy(a: Image, b: Image, valid: NDArray[np.bool_]) -> float:
    """Return the distance by scipy's Gaussian windows."""
    sigma = 0.02 * 80
    reach = (round(sigma * 8 + 1) | 1) // 2  # OpenCV's choice of a kernel for floats

    def blurred(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return gaussian_filter(values, sigma, mode="constant", radius=reach)

    share = np.maximum(blurred(valid * 1.0), 1e-300)  # 0 far from any valid pixel

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return blurred(values * valid) / share

    first, second = (cv2.cvtColor(each, cv2.COLOR_RGB2GRAY).astype(np.float64) for each in (a, b))
    covariance = mean(first * second) - mean(first) * mean(second)
    variances = [mean(grey**2) - mean(grey) ** 2 for grey in (first, second)]
    dissimilarity = 1 - (covariance + 9) / (np.sqrt(variances[0] * variances[1]) + 9)
    return float(dissimilarity[valid & (share >= 0.5)].mean())


def test_the_distance_is_the_mean_over_windows() -> None:
    valid = FULL.copy()
    valid[:25, 30:] = False
    valid[40:, 5] = False
    expected = by_scipy(picture(0), picture(1), valid)
    assert 0.3 < expected < 1.7
    result = StructureDistance().distance(picture(0), picture(1), valid)
    assert result == pytest.approx(expected, rel=1e-3)


def test_invalid_pixels_are_ignored() -> None:
    a, b, other = picture(0), picture(1), picture(5)
    valid = FULL.copy()
    valid[20:40, 20:60] = False
    changed = np.where(valid[..., None], b, other)
    assert StructureDistance().distance(a, changed, valid) == StructureDistance().distance(
        a, b, valid
    )
    same = np.where(valid[..., None], a, other)
    assert StructureDistance().distance(a, same, valid) == pytest.approx(0.0, abs=1e-4)
    assert StructureDistance().distance(a, same, FULL) > 0.05


def test_the_distance_without_valid_pixels_is_infinite() -> None:
    a, b = picture(0), picture(1)
    assert StructureDistance().distance(a, b, ~FULL) == np.inf
    single = ~FULL
    single[30, 40] = True
    assert StructureDistance().distance(a, b, single) == np.inf


DEPTH_M = 6.0  # of the wall that the cameras face


def scene_of(query: Image, **poses: RigidTransform) -> Scene:
    """Return a scene with a query "q" and rendered map images; the image "lost" has no pixels."""
    poses["lost"] = RigidTransform.identity()
    rendered = {name: render(pose) for name, pose in poses.items() if name != "lost"}
    return Scene(poses, dict.fromkeys(poses, CAMERA), images={"q": query, **rendered})


def moved(
    x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0, turn_deg: float = 0.0
) -> RigidTransform:
    half = math.radians(turn_deg) / 2
    return RigidTransform((math.cos(half), 0.0, 0.0, math.sin(half)), (x_m, y_m, z_m))


def on_plane(count: int = 200) -> NDArray[np.float64]:
    xy = np.random.default_rng(1).uniform(-1.5, 1.5, (count, 2))
    return np.column_stack([xy, np.full(count, DEPTH_M)])


@pytest.mark.parametrize(
    "true_pose", [moved(), moved(turn_deg=40), moved(z_m=1.2), moved(0.1, 0.1, -0.8, -75)]
)
def test_the_true_pose_displaces_no_points(true_pose: RigidTransform) -> None:
    # brighter, noisier and of less contrast, like another time of the day
    noise = np.random.default_rng(0).normal(0, 4, (300, 400, 1))
    query = np.uint8(np.clip(90 + 0.4 * render(true_pose).astype(float) + noise, 0, 255))
    scene = scene_of(query, a=moved(), b=moved(-0.2))
    points = on_plane()
    result = _displacements_px("q", CAMERA, true_pose, points, ["a", "b"] * 100, scene)
    assert len(result) > 150
    assert np.median(result) < 0.35


@pytest.mark.parametrize("shift_px", [(1.5, 0.0), (3.0, -4.0)])
def test_a_wrong_pose_displaces_points_by_its_error(shift_px: tuple[float, float]) -> None:
    metres = [px * DEPTH_M / 300 for px in shift_px]
    scene = scene_of(render(moved(*metres)), a=moved())
    result = _displacements_px("q", CAMERA, moved(), on_plane(), ["a"] * 200, scene)
    assert len(result) > 150
    assert np.median(result) == pytest.approx(math.hypot(*shift_px), abs=0.15)


def test_no_displacements_without_pixels_or_points() -> None:
    image = render(moved())

    def result(query: Image, points: NDArray[np.float64], shown_by: str = "a") -> Any:
        scene = scene_of(query, a=moved())
        return _displacements_px("q", CAMERA, moved(), points, [shown_by] * len(points), scene)

    assert np.median(result(image[::-1, ::-1].copy(), on_plane())) > 2
    flat = np.full_like(image, 90)
    for query, points, shown_by in (
        (image, np.zeros((0, 3)), "a"),
        (image, on_plane(3), "lost"),
        (flat, on_plane(), "a"),
        (image, -on_plane(), "a"),  # behind
    ):
        assert len(result(query, points, shown_by)) == 0
