"""The plugins lpips and structure: distances of images, and displacements of map points."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from corner import CAMERA, render
from images import Image, texture
from numpy.typing import NDArray
from poses import rigid
from scenes import Scene
from scipy.ndimage import gaussian_filter

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.localization.lpips import LpipsDistance, LpipsOptions
from megloc_kapture.localization.structure import StructureDistance, _displacements_px
from megloc_kapture.nets.lpips import Lpips
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import IMAGE_DISTANCES
from megloc_kapture.values import RigidTransform


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Random weights of SqueezeNet's layout, as a trunk's file and one of heads."""
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    state = {key: value.abs() * 0.3 for key, value in Lpips("squeeze").state_dict().items()}
    trunk = {key: value for key, value in state.items() if key.startswith("features.")}
    torch.save(trunk, folder / "trunk.pth")
    torch.save({key: state[key] for key in state.keys() - trunk.keys()}, folder / "heads.pth")
    return folder / "trunk.pth", folder / "heads.pth"


def distance(files: tuple[Path, Path], **options: object) -> Any:
    trunk, heads = map(str, files)
    given = {"net": "squeeze", "trunk": trunk, "heads": heads, "device": "cpu", **options}
    return load_plugin(IMAGE_DISTANCES, "lpips", given)


def pictures(count: int = 2, height: int = 80) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (count, height, 96, 3), dtype=np.uint8)


PICTURED = np.ones((80, 96), bool)


def test_the_distance_equals_the_networks(files: tuple[Path, Path]) -> None:
    plugin = distance(files)
    assert isinstance(plugin, LpipsDistance)
    assert sorted(plugin.weights()) == ["heads.pth", "trunk.pth"]
    a, b = pictures()
    valid = PICTURED.copy()
    valid[:, :30] = False
    net = Lpips("squeeze")
    net.load_state_dict({k: v for f in files for k, v in torch.load(f, weights_only=True).items()})
    tensors = [torch.from_numpy(x.transpose(2, 0, 1)[None] / 255.0).float() for x in (a, b)]
    with torch.inference_mode():
        expected = float(net(*tensors, torch.from_numpy(valid)[None, None].float())[0])
    assert expected > 0
    assert plugin.distance(a, b, valid) == pytest.approx(expected, rel=1e-5)
    assert plugin.distance(a, a, valid) == 0.0
    half = distance(files, half_precision=True).distance(a, b, PICTURED)
    assert half == pytest.approx(plugin.distance(a, b, PICTURED), rel=0.1)


def test_missing_and_mismatched_weights_are_named(files: tuple[Path, Path]) -> None:
    with pytest.raises(MissingWeightsError, match="lpips-trunk-vgg"):
        LpipsDistance(LpipsOptions.model_validate({"net": "vgg"}))
    with pytest.raises(DataError, match=r"features\.0\.weight"):
        distance(files, net="alex").distance(*pictures(), PICTURED)


FULL = np.ones((60, 80), bool)
FIRST, SECOND, OTHER = (texture(60, 80, seed, 3.0) for seed in range(3))


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


def structure_distance(a: Image, b: Image, valid: NDArray[np.bool_] = FULL) -> float:
    return StructureDistance().distance(a, b, valid)


def test_the_distance_is_the_mean_over_windows() -> None:
    valid = FULL.copy()
    valid[:25, 30:] = False
    valid[40:, 5] = False
    expected = by_scipy(FIRST, SECOND, valid)
    assert 0.3 < expected < 1.7
    assert structure_distance(FIRST, SECOND, valid) == pytest.approx(expected, rel=1e-3)


def test_invalid_pixels_are_ignored() -> None:
    valid = FULL.copy()
    valid[20:40, 20:60] = False
    changed, same = (np.where(valid[..., None], image, OTHER) for image in (SECOND, FIRST))
    expected = structure_distance(FIRST, SECOND, valid)
    assert structure_distance(FIRST, changed, valid) == expected
    assert structure_distance(FIRST, same, valid) == pytest.approx(0.0, abs=1e-4)
    assert structure_distance(FIRST, same) > 0.05


def test_the_distance_without_valid_pixels_is_infinite(files: tuple[Path, Path]) -> None:
    assert distance(files).distance(*pictures(), ~PICTURED) == np.inf
    assert distance(files).distance(*pictures(height=40), PICTURED[:40]) == np.inf
    single = ~FULL
    single[30, 40] = True
    for valid in (~FULL, single):
        assert structure_distance(FIRST, SECOND, valid) == np.inf


DEPTH_M = 6.0  # of the wall that the cameras face


def scene_of(query: Image, **poses: RigidTransform) -> Scene:
    """Return a scene with a query "q" and rendered map images; the image "lost" has no pixels."""
    poses["lost"] = RigidTransform.identity()
    rendered = {name: render(pose) for name, pose in poses.items() if name != "lost"}
    return Scene(poses, dict.fromkeys(poses, CAMERA), images={"q": query, **rendered})


def moved(
    x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0, turn_deg: float = 0.0
) -> RigidTransform:
    return rigid([0.0, 0.0, math.radians(turn_deg)], [x_m, y_m, z_m])


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
