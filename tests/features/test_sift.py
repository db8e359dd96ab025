"""RootSIFT and COLMAP's SIFT: keypoints known by construction, OpenCV's, COLMAP's databases."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from images import blobs, texture
from numpy.typing import NDArray

from megloc_kapture.datasets.reference_map import ColmapDatabase
from megloc_kapture.features.rootsift import (
    ColmapSift,
    ColmapSiftOptions,
    RootSift,
    RootSiftOptions,
    root_sift,
)
from megloc_kapture.io.images import read_image_rgb, write_image
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import LOCAL_FEATURES
from megloc_kapture.values import LocalFeatures

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


def grid_of_centres(seed: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(30, 240, 50), np.arange(30, 180, 50))
    grid = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    return grid + rng.uniform(-0.5, 0.5, grid.shape)


def in_some_order(features: LocalFeatures) -> NDArray[np.float64]:
    """Sorted rows of x, y, descriptor."""
    rows = np.hstack([features.keypoints_px, features.descriptors]).astype(np.float64)
    return rows[np.lexsort(rows.T[::-1])]


# doubled and halved octave
@pytest.mark.parametrize("sigma_px", [1.6, 6.0])
@pytest.mark.parametrize(("kind", "most_px"), [(RootSift, 0.1), (ColmapSift, 0.15)])
def test_keypoints_are_at_the_centres_of_blobs(kind: Any, most_px: float, sigma_px: float) -> None:
    centres = grid_of_centres(seed=int(10 * sigma_px))
    result = kind().extract(blobs(centres, sigma_px)).keypoints_px
    distance = np.linalg.norm(result[:, None] - centres, axis=2)
    offset = result[distance.argmin(axis=0)] - centres
    assert np.abs(offset).max() < most_px
    # a missing half pixel would be ten times this, OpenCV's quarter pixel five times
    assert np.abs(offset.mean(axis=0)).max() < 0.05


def test_descriptors_are_square_roots_of_l1_normalised_sift() -> None:
    image = texture(110, 140)
    features = RootSift().extract(image)
    assert len(features.scores) > 40
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    sift = cv2.SIFT.create(5000, 3, 0.01, 10, 1.6, True)
    keypoints, raw = sift.detectAndCompute(gray, None)
    xy = np.array([keypoint.pt for keypoint in keypoints], np.float32) + np.float32(0.5)
    roots = np.sqrt(raw / raw.sum(axis=1, keepdims=True, dtype=np.float64))
    scores = np.zeros(len(xy), np.float32)
    expected = in_some_order(LocalFeatures(xy, scores, roots))
    np.testing.assert_allclose(in_some_order(features), expected, atol=1e-6)
    np.testing.assert_array_equal(root_sift(np.zeros((2, 128), np.float32)), 0.0)


def test_features_equal_those_of_a_database_by_colmap(tmp_path: Path) -> None:
    write_image(tmp_path / "images" / "a.png", texture(110, 140))
    write_image(tmp_path / "images" / "b.jpg", texture(110, 140, seed=1))
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.sift.max_num_features = 300
    pycolmap.extract_features(
        tmp_path / "official.db",
        tmp_path / "images",
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )
    extractor = ColmapSift(ColmapSiftOptions(max_keypoints=300))
    with ColmapDatabase(tmp_path / "official.db") as database:
        assert sorted(database.images) == ["a.png", "b.jpg"]
        for name in database.images:
            keypoints, descriptors = database.keypoints(name), database.descriptors(name)
            assert descriptors is not None and len(descriptors) > 50
            official = LocalFeatures(keypoints, np.zeros(len(keypoints), np.float32), descriptors)
            ours = extractor.extract(read_image_rgb(tmp_path / "images" / name))
            np.testing.assert_array_equal(in_some_order(ours), in_some_order(official))


def test_the_options_of_sift_reach_colmap() -> None:
    plugin = load_plugin(LOCAL_FEATURES, "sift", {"max_keypoints": 10, "first_octave": 0})
    assert isinstance(plugin, ColmapSift)
    assert plugin.options == ColmapSiftOptions(max_keypoints=10, first_octave=0)
    image = texture(110, 140)
    everything = ColmapSift().extract(image)

    def extracted(**options: Any) -> NDArray[np.float32]:
        return ColmapSift(ColmapSiftOptions(**options)).extract(image).scores

    assert extracted(first_octave=0).min() > 1.5 > everything.scores.min()
    assert 0 < len(extracted(peak_threshold=0.03)) < len(everything.scores)
    # the coarsest are kept, whole levels: somewhat more than asked for
    some = extracted(max_keypoints=20)
    assert 20 <= len(some) < 0.5 * len(everything.scores)
    assert some.mean() > everything.scores.mean()


def test_threads_give_the_features_of_a_single_thread() -> None:
    images = [texture(60, 80, seed) for seed in range(4)]
    extractor = ColmapSift()
    expected = [extractor.extract(image) for image in images]
    with ThreadPoolExecutor(4) as threads:
        for alone, other in zip(expected, threads.map(extractor.extract, images), strict=True):
            np.testing.assert_array_equal(in_some_order(alone), in_some_order(other))


def test_colour_is_rgb_not_bgr() -> None:
    # a red blob and its blue surroundings have the same luma
    image = np.zeros((120, 120, 3), dtype=np.uint8)
    y, x = np.mgrid[:120, :120] + 0.5
    blob = np.exp(-((x - 60) ** 2 + (y - 60) ** 2) / (2 * 3.0**2))
    image[:, :, 0] = np.round(100 * blob)
    image[:, :, 2] = np.round(255 * (1 - blob * 100 * 0.299 / (0.114 * 255)))
    extractor = RootSift(RootSiftOptions(contrast_threshold=0.04))
    assert len(extractor.extract(image).scores) == 0
    assert len(extractor.extract(np.ascontiguousarray(image[:, :, ::-1])).scores) > 0
