"""Reduction of large images before extraction, and masks of keypoints."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

import cv2
import numpy as np
from images import Image
from numpy.typing import NDArray

from megloc_kapture.features.image_bound import (
    BoundedOptions,
    bounded_size,
    extract_bounded,
    on_mask,
)
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.plugins import LOCAL_FEATURES
from megloc_kapture.values import LocalFeatures


def discs(width: int, height: int) -> tuple[Image, NDArray[np.float64]]:
    """Discs on a grid, and their centres (the first pixel's centre is (0.5, 0.5))."""
    image = np.full((height, width, 3), 60, np.uint8)
    step = width // 8
    rows, columns = range(step, height - step // 2, step), range(step, width - step // 2, step)
    centres = [(x, y) for y in rows for x in columns]
    for k, (x, y) in enumerate(centres):
        cv2.circle(image, (x, y), step // 6, (200 + k % 50,) * 3, -1, cv2.LINE_AA)
    return image, np.array(centres) + 0.5


def test_images_are_reduced_only_above_the_bound() -> None:
    for size in ((2048, 2048), (3264, 2448)):
        assert bounded_size(*size, 8.0) == size
    assert bounded_size(12000, 9000, 8.0) == (3265, 2449)
    assert bounded_size(100_000_000, 1, 8.0) == (28284271, 1)


def test_keypoints_of_a_reduced_image_keep_their_place() -> None:
    image, centres = discs(401, 303)
    whole = RootSift().extract(image)
    half, same = (RootSift(RootSiftOptions(max_megapixels=most)) for most in (0.0306, 0.5))
    result = extract_bounded(half, [(image, None)])[0]
    assert len(result.keypoints_px) > len(centres)
    for features in (whole, result):
        near = np.linalg.norm(centres[:, None] - features.keypoints_px[None, :, :2], axis=2)
        assert near.min(axis=1).max() < 1.0
    unchanged = extract_bounded(same, [(image, None)])[0]
    np.testing.assert_array_equal(unchanged.keypoints_px, whole.keypoints_px)
    np.testing.assert_array_equal(unchanged.descriptors, whole.descriptors)
    # the mask is reduced with the image
    mask = np.ones(image.shape[:2], bool)
    mask[:, :201] = False
    result = extract_bounded(half, [(image, mask)])[0]
    assert len(result.keypoints_px) > 10 and result.num_masked > 10
    assert result.keypoints_px[:, 0].min() >= 201


def test_images_of_plugins_without_the_option_are_bounded_too() -> None:
    class Plain:
        def extract(self, image: Any, mask: Any = None) -> LocalFeatures:
            assert image.shape[0] * image.shape[1] <= 8e6
            corner = np.array([[image.shape[1], image.shape[0], 7.0]], np.float32)
            return LocalFeatures(corner, np.zeros(1, np.float32), np.zeros((1, 4), np.float32))

    result = extract_bounded(Plain(), [(np.zeros((2400, 4800, 3), np.uint8), None)])[0]
    np.testing.assert_allclose(result.keypoints_px, [[4800, 2400, 7]], rtol=1e-6)


def test_all_our_extractors_have_the_option() -> None:
    plugins = entry_points(group=LOCAL_FEATURES)
    ours = [plugin for plugin in plugins if "megloc_kapture." in plugin.value]
    assert len(ours) > 5
    for extractor in ours:
        assert issubclass(extractor.load().Options, BoundedOptions), extractor.name


def test_a_mask_is_read_at_the_pixel_of_a_keypoint() -> None:
    # (2, 1) is the corner of the pixel in column 2, row 1; the far edge belongs to the last pixel
    xy_px = np.array([[1.99, 0.99], [2.0, 1.0], [4.0, 3.0]], np.float32)
    for row, pixel in enumerate([(0, 1), (1, 2), (2, 3)]):
        mask = np.zeros((3, 4), bool)
        mask[pixel] = True
        assert on_mask(mask, xy_px).tolist() == [row == k for k in range(3)]
