"""RootSIFT against images whose keypoints are known by construction, and against OpenCV itself."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.features.rootsift import RootSift, RootSiftOptions, root_sift
from megloc_kapture.values import LocalFeatures

Image = NDArray[np.uint8]


def blobs(
    centres: NDArray[np.float64],
    sigma_px: float,
    *,
    amplitude: NDArray[np.float64] | float = 120.0,
    size: tuple[int, int] = (200, 260),
) -> Image:
    """Gaussian blobs on grey; centres (N, 2) in pixels, first pixel's centre at (0.5, 0.5)."""
    height, width = size
    y, x = np.mgrid[:height, :width] + 0.5
    gray = np.full(size, 60.0)
    for (cx, cy), strength in zip(
        centres, np.broadcast_to(amplitude, len(centres)).tolist(), strict=True
    ):
        gray += strength * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma_px**2))
    return np.repeat(np.clip(np.round(gray), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def grid_of_centres(seed: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(30, 240, 50), np.arange(30, 180, 50))
    grid = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    return grid + rng.uniform(-0.5, 0.5, grid.shape)


def texture(size: tuple[int, int] = (220, 280), seed: int = 0) -> Image:
    noise = np.random.default_rng(seed).uniform(0, 255, (*size, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    smooth = (smooth - smooth.min()) / (smooth.max() - smooth.min()) * 255
    return smooth.astype(np.uint8)


def assert_same(a: LocalFeatures, b: LocalFeatures) -> None:
    np.testing.assert_array_equal(a.keypoints_px, b.keypoints_px)
    np.testing.assert_array_equal(a.scores, b.scores)
    np.testing.assert_array_equal(a.descriptors, b.descriptors)


# 1.6 to 2.5 px are found in the doubled octave, 3 in the image's own, 6 in the halved one
@pytest.mark.parametrize("sigma_px", [1.6, 2.0, 2.5, 3.0, 6.0])
def test_keypoints_are_where_colmap_puts_them(sigma_px: float) -> None:
    centres = grid_of_centres(seed=int(10 * sigma_px))
    found = RootSift().extract(blobs(centres, sigma_px)).keypoints_px
    distance = np.linalg.norm(found[:, None] - centres, axis=2)
    offset = found[distance.argmin(axis=0)] - centres
    assert np.abs(offset).max() < 0.1
    # a forgotten half pixel is ten times this, OpenCV's quarter pixel five times
    assert np.abs(offset.mean(axis=0)).max() < 0.05


def test_the_scale_of_the_blob_test_resolves_opencvs_quarter_pixel() -> None:
    centres = grid_of_centres(seed=1)
    gray = blobs(centres, 2.0)[:, :, 0]
    raw = cv2.SIFT.create(500, 3, 0.01, 10, 1.6, False).detect(gray, None)
    found = np.array([keypoint.pt for keypoint in raw]) + 0.5
    distance = np.linalg.norm(found[:, None] - centres, axis=2)
    offset = (found[distance.argmin(axis=0)] - centres).mean(axis=0)
    assert (np.abs(offset) > 0.2).all()


def test_a_shifted_image_has_shifted_keypoints() -> None:
    image = texture()
    dx, dy = 8, 16  # multiples of the coarsest octaves' step, as SIFT's own grid asks for
    small = RootSift(RootSiftOptions(max_keypoints=400))
    first = small.extract(image).keypoints_px
    shifted = np.roll(image, (dy, dx), axis=(0, 1))
    second = small.extract(shifted).keypoints_px
    inside = (first > 60).all(axis=1) & (first[:, 0] < 200) & (first[:, 1] < 140)
    expected = first[inside] + (dx, dy)
    nearest = np.linalg.norm(expected[:, None] - second, axis=2).min(axis=1)
    assert inside.sum() > 30
    assert np.median(nearest) < 1e-3
    assert (nearest < 0.05).mean() > 0.95


def test_descriptors_are_square_roots_of_l1_normalised_sift() -> None:
    image = texture()
    features = RootSift().extract(image)
    assert len(features.scores) > 100
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    sift = cv2.SIFT.create(5000, 3, 0.01, 10, 1.6, True)
    keypoints, raw = sift.detectAndCompute(gray, None)
    by_place: dict[tuple[float, float], list[NDArray[np.float64]]] = {}
    for keypoint, values in zip(keypoints, raw.astype(np.float64), strict=True):
        x, y = (np.float32(v) + np.float32(0.5) for v in keypoint.pt)
        by_place.setdefault((float(x), float(y)), []).append(np.sqrt(values / values.sum()))
    assert len(features.scores) == len(keypoints)
    for (x, y), descriptor in zip(
        features.keypoints_px.tolist(), features.descriptors, strict=True
    ):
        # several orientations stand at one place: each of ours is one of OpenCV's
        left = by_place[x, y]
        differences = [float(np.abs(descriptor - expected).max()) for expected in left]
        assert min(differences) < 1e-6
        left.pop(int(np.argmin(differences)))


def test_descriptors_have_unit_length_and_the_declared_type() -> None:
    features = RootSift().extract(texture())
    assert features.descriptors.dtype == np.dtype(RootSift.descriptor_dtype)
    assert features.descriptors.shape[1] == RootSift.descriptor_size
    assert features.keypoints_px.dtype == np.float32 and features.scores.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-6)


def test_a_zero_descriptor_stays_zero() -> None:
    np.testing.assert_array_equal(root_sift(np.zeros((2, 128), np.float32)), 0.0)


def test_the_strongest_come_first_and_the_weakest_are_left_out() -> None:
    image = texture()
    everything = RootSift(RootSiftOptions(max_keypoints=100_000)).extract(image)
    assert (np.diff(everything.scores) <= 0).all()
    some = RootSift(RootSiftOptions(max_keypoints=50)).extract(image)
    assert len(some.scores) == 50
    np.testing.assert_array_equal(some.scores, everything.scores[:50])


def test_the_mask_is_applied_before_the_strongest_are_selected() -> None:
    # four strong blobs on the left, four weak ones on the right
    x, y = np.meshgrid([40.0, 80.0, 180.0, 220.0], [60.0, 140.0])
    centres = np.stack([x.ravel(), y.ravel()], axis=1)
    image = blobs(centres, 3.0, amplitude=np.where(centres[:, 0] < 130, 150.0, 40.0))
    extractor = RootSift(RootSiftOptions(max_keypoints=4))
    assert (extractor.extract(image).keypoints_px[:, 0] < 130).all()
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[:, 130:] = True
    masked = extractor.extract(image, mask)
    assert len(masked.scores) == 4
    assert (masked.keypoints_px[:, 0] > 130).all()


def test_a_mask_looks_at_the_pixel_the_keypoint_lies_in() -> None:
    centre = np.array([[100.5, 80.5]])  # the centre of pixel (100, 80)
    image = blobs(centre, 3.0)
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[80, 100] = True
    found = RootSift().extract(image, mask).keypoints_px
    assert len(found) >= 1
    np.testing.assert_allclose(found, np.repeat(centre, len(found), axis=0), atol=0.5)
    assert len(RootSift().extract(image, ~mask).keypoints_px[:, 0]) < len(
        RootSift().extract(image).keypoints_px
    )


@pytest.mark.parametrize("max_keypoints", [3, 20, 5000])
@pytest.mark.parametrize("sigma_px", [2.0, 6.0])
def test_a_mask_that_permits_everything_changes_nothing(
    max_keypoints: int, sigma_px: float
) -> None:
    # with sigma 6 no keypoint of the doubled octave is left, which changes OpenCV's pyramid
    image = blobs(grid_of_centres(seed=3), sigma_px)
    extractor = RootSift(RootSiftOptions(max_keypoints=max_keypoints))
    assert_same(
        extractor.extract(image), extractor.extract(image, np.ones(image.shape[:2], dtype=bool))
    )


def test_two_runs_give_the_same() -> None:
    image = texture(seed=4)
    assert_same(RootSift().extract(image), RootSift().extract(image.copy()))


@pytest.mark.parametrize("shape", [(1, 1, 3), (2, 5, 3), (64, 48, 3)])
def test_an_image_without_texture_has_no_features(shape: tuple[int, int, int]) -> None:
    features = RootSift().extract(np.full(shape, 90, dtype=np.uint8))
    assert features.keypoints_px.shape == (0, 2) and features.keypoints_px.dtype == np.float32
    assert features.scores.shape == (0,)
    assert features.descriptors.shape == (0, 128) and features.descriptors.dtype == np.float32


def test_a_mask_that_permits_nothing() -> None:
    image = texture()
    assert len(RootSift().extract(image, np.zeros(image.shape[:2], dtype=bool)).scores) == 0


def test_colour_is_rgb_not_bgr() -> None:
    # red and blue of one luma in RGB's weights: no contrast to find in grey
    image = np.zeros((120, 120, 3), dtype=np.uint8)
    y, x = np.mgrid[:120, :120] + 0.5
    blob = np.exp(-((x - 60) ** 2 + (y - 60) ** 2) / (2 * 3.0**2))
    image[:, :, 0] = np.round(100 * blob)
    image[:, :, 2] = np.round(255 * (1 - blob * 100 * 0.299 / (0.114 * 255)))
    assert len(RootSift(RootSiftOptions(contrast_threshold=0.04)).extract(image).scores) == 0
    swapped = np.ascontiguousarray(image[:, :, ::-1])
    assert len(RootSift(RootSiftOptions(contrast_threshold=0.04)).extract(swapped).scores) > 0
