"""COLMAP's SIFT against COLMAP's own databases, and images whose keypoints are known."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.colmap_database import ColmapDatabase
from megloc_kapture.features.colmap_sift import ColmapSift, ColmapSiftOptions
from megloc_kapture.io.images import read_image_rgb, write_image
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import LOCAL_FEATURES
from megloc_kapture.values import LocalFeatures

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

Image = NDArray[np.uint8]


def blobs(centres: NDArray[np.float64], sigma_px: float, size: tuple[int, int]) -> Image:
    """Gaussian blobs on grey; centres (N, 2) in pixels, first pixel's centre at (0.5, 0.5)."""
    y, x = np.mgrid[: size[0], : size[1]] + 0.5
    grey = np.full(size, 60.0)
    for cx, cy in centres:
        grey += 120 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma_px**2))
    return np.repeat(np.round(grey).astype(np.uint8)[..., None], 3, axis=2)


def texture(size: tuple[int, int] = (220, 280), seed: int = 0) -> Image:
    noise = np.random.default_rng(seed).uniform(0, 255, (*size, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return ((smooth - smooth.min()) / np.ptp(smooth) * 255).astype(np.uint8)


def in_some_order(features: LocalFeatures) -> NDArray[np.float64]:
    """Rows x, y, descriptor, sorted."""
    rows = np.hstack([features.keypoints_px, features.descriptors]).astype(np.float64)
    return rows[np.lexsort(rows.T[::-1])]


def assert_same(a: LocalFeatures, b: LocalFeatures) -> None:
    np.testing.assert_array_equal(a.keypoints_px, b.keypoints_px)
    np.testing.assert_array_equal(a.scores, b.scores)
    np.testing.assert_array_equal(a.descriptors, b.descriptors)


# 1.6 and 2.5 px are found in the doubled octave, 3 in the image's own, 6 in the halved one
@pytest.mark.parametrize("sigma_px", [1.6, 2.5, 3.0, 6.0])
def test_keypoints_are_where_colmap_puts_them(sigma_px: float) -> None:
    x, y = np.meshgrid(np.arange(30, 240, 50), np.arange(30, 180, 50))
    grid = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    centres = grid + np.random.default_rng(1).uniform(-0.5, 0.5, grid.shape)
    found = ColmapSift().extract(blobs(centres, sigma_px, (200, 260))).keypoints_px
    distance = np.linalg.norm(found[:, None] - centres, axis=2)
    offset = found[distance.argmin(axis=0)] - centres
    assert np.abs(offset).max() < 0.15
    assert np.abs(offset.mean(axis=0)).max() < 0.05


@pytest.mark.parametrize("max_keypoints", [8192, 300])
def test_a_database_that_colmap_writes_has_the_same(tmp_path: Path, max_keypoints: int) -> None:
    write_image(tmp_path / "images" / "a.png", texture())
    write_image(tmp_path / "images" / "b.jpg", texture(seed=1))
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.sift.max_num_features = max_keypoints
    pycolmap.extract_features(
        tmp_path / "official.db",
        tmp_path / "images",
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )
    extractor = ColmapSift(ColmapSiftOptions(max_keypoints=max_keypoints))
    with ColmapDatabase(tmp_path / "official.db") as database:
        assert sorted(database.images) == ["a.png", "b.jpg"]
        for name in database.images:
            keypoints, descriptors = database.keypoints(name), database.descriptors(name)
            assert descriptors is not None and len(descriptors) > 200
            official = LocalFeatures(keypoints, np.zeros(len(keypoints), np.float32), descriptors)
            ours = extractor.extract(read_image_rgb(tmp_path / "images" / name))
            np.testing.assert_array_equal(in_some_order(ours), in_some_order(official))


def test_it_is_the_plugin_sift() -> None:
    plugin = load_plugin(LOCAL_FEATURES, "sift", {"max_keypoints": 10, "first_octave": 0})
    assert isinstance(plugin, ColmapSift)
    assert plugin.options == ColmapSiftOptions(max_keypoints=10, first_octave=0)


def test_arrays_are_of_the_declared_type() -> None:
    features = ColmapSift().extract(texture())
    assert features.descriptors.dtype == np.dtype(ColmapSift.descriptor_dtype)
    assert features.descriptors.shape == (len(features.scores), ColmapSift.descriptor_size)
    assert features.keypoints_px.dtype == features.scores.dtype == np.float32
    length = np.linalg.norm(features.descriptors.astype(np.float64), axis=1)
    np.testing.assert_allclose(length, 512, rtol=0.01)


def test_the_coarsest_come_first_and_are_kept() -> None:
    everything = ColmapSift().extract(texture())
    assert (np.diff(everything.scores) <= 0).all()
    some = ColmapSift(ColmapSiftOptions(max_keypoints=50)).extract(texture())
    # whole levels: somewhat more than asked for
    assert 50 <= len(some.scores) < 0.5 * len(everything.scores)
    assert some.scores.mean() > everything.scores.mean()


def test_octaves_and_threshold_reach_colmap() -> None:
    everything = ColmapSift().extract(texture())
    no_doubling = ColmapSift(ColmapSiftOptions(first_octave=0)).extract(texture())
    assert no_doubling.scores.min() > 1.5 > everything.scores.min()
    few = ColmapSift(ColmapSiftOptions(peak_threshold=0.03)).extract(texture())
    assert 0 < len(few.scores) < len(everything.scores)


def test_the_mask_is_applied_before_the_coarsest_are_selected() -> None:
    # large blobs on the left, small ones on the right
    image = blobs(np.array([[60.0, 50.0], [60.0, 130.0]]), 9.0, (180, 260))
    image[:, 130:] = blobs(np.array([[50.0, 50.0], [50.0, 130.0]]), 2.0, (180, 130))
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[:, 130:] = True
    extractor = ColmapSift(ColmapSiftOptions(max_keypoints=2))
    assert (extractor.extract(image).keypoints_px[:, 0] < 130).any()
    masked = extractor.extract(image, mask)
    assert len(masked.scores) == 2
    assert (masked.keypoints_px[:, 0] > 130).all()
    assert len(extractor.extract(image, np.zeros_like(mask)).scores) == 0


def test_a_mask_looks_at_the_pixel_the_keypoint_lies_in() -> None:
    image = blobs(np.array([[100.5, 80.5]]), 3.0, (160, 200))
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[80, 100] = True
    found = ColmapSift().extract(image, mask).keypoints_px
    assert len(found) >= 1
    np.testing.assert_allclose(found, np.full_like(found, [100.5, 80.5]), atol=0.5)


def test_a_mask_that_permits_everything_changes_nothing() -> None:
    image = texture()
    extractor = ColmapSift(ColmapSiftOptions(max_keypoints=100))
    assert_same(extractor.extract(image), extractor.extract(image, np.ones((220, 280), bool)))


def test_threads_do_not_disturb_each_other() -> None:
    images = [texture(seed=seed) for seed in range(4)]
    extractor = ColmapSift()
    one_by_one = [extractor.extract(image) for image in images]
    with ThreadPoolExecutor(4) as threads:
        for alone, together in zip(one_by_one, threads.map(extractor.extract, images), strict=True):
            assert_same(alone, together)


@pytest.mark.parametrize("shape", [(1, 1, 3), (2, 5, 3), (64, 48, 3)])
def test_an_image_without_texture_has_no_features(shape: tuple[int, int, int]) -> None:
    features = ColmapSift().extract(np.full(shape, 90, dtype=np.uint8))
    assert features.keypoints_px.shape == (0, 2) and features.keypoints_px.dtype == np.float32
    assert features.scores.shape == (0,)
    assert features.descriptors.shape == (0, 128) and features.descriptors.dtype == np.uint8
