"""A bound on the size of the images that local features are extracted from.

Memory grows with the pixels: RootSIFT and ALIKED take about 0.25 GB for a megapixel. A larger
image is reduced first, and its keypoints are scaled back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.values import LocalFeatures, Options

Frame = tuple[NDArray[np.uint8], NDArray[np.bool_] | None]
"""An image, RGB (H, W, 3), and its mask (H, W), True = use, or None."""
DEFAULT_MEGAPIXELS = 8.0


class BoundedOptions(Options):
    """An option that all our extractors of local features have."""

    max_megapixels: float = Field(
        default=DEFAULT_MEGAPIXELS,
        gt=0,
        allow_inf_nan=False,
        description="a larger image is reduced to this before its features are extracted, and its "
        "keypoints are scaled back; memory grows with it",
    )


def bounded_size(width: int, height: int, max_megapixels: float) -> tuple[int, int]:
    """The size of an image that is reduced to at most that; itself where it is no larger."""
    if width * height <= max_megapixels * 1e6:
        return width, height
    scale = math.sqrt(max_megapixels * 1e6 / (width * height))
    return max(1, int(width * scale)), max(1, int(height * scale))


def bounded_image(
    image: NDArray[np.uint8], max_megapixels: float = DEFAULT_MEGAPIXELS
) -> NDArray[np.uint8]:
    """The image (H, W, 3), reduced where it is larger; the same array where it is not."""
    height, width = image.shape[:2]
    size = bounded_size(width, height, max_megapixels)
    if size == (width, height):
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def max_megapixels_of(extractor: object) -> float:
    """The bound among an extractor's options; the default for one that has no such option."""
    options: Any = getattr(extractor, "options", None)
    return float(getattr(options, "max_megapixels", DEFAULT_MEGAPIXELS))


def extract_bounded(extractor: Any, frames: Sequence[Frame]) -> list[LocalFeatures]:
    """Extract from images of one size, reduced where they are larger than the extractor's bound.

    x and y of the keypoints are those in the images as given; other columns, as a scale, are those
    of the reduced ones. A pixel of a reduced mask is used where all that it covers is. The
    extractor is a plugin of local features that has ``extract_many`` where images are several.
    """
    bound = max_megapixels_of(extractor)
    small = [_reduced(*frame, bound) for frame in frames]
    several = len(frames) > 1
    found = (
        extractor.extract_many(*zip(*small, strict=True))
        if several
        else [extractor.extract(*small[0])]
    )
    (height, width), (own_height, own_width) = small[0][0].shape[:2], frames[0][0].shape[:2]
    # the first pixel's centre is (0.5, 0.5): sizes scale as a whole
    ratio = np.array([own_width / width, own_height / height], np.float32)
    return found if small[0][0] is frames[0][0] else [_scaled(each, ratio) for each in found]


def _reduced(
    image: NDArray[np.uint8], mask: NDArray[np.bool_] | None, max_megapixels: float
) -> Frame:
    small = bounded_image(image, max_megapixels)
    if mask is None or small is image:
        return small, mask
    ignored = (~mask).astype(np.uint8) * 255
    size = small.shape[1], small.shape[0]
    return small, np.asarray(cv2.resize(ignored, size, interpolation=cv2.INTER_AREA) == 0)


def _scaled(features: LocalFeatures, ratio: NDArray[np.float32]) -> LocalFeatures:
    if not isinstance(features, LocalFeatures):
        return features  # whoever checks plugins says so
    keypoints_px = features.keypoints_px.copy()
    keypoints_px[:, :2] *= ratio
    return replace(features, keypoints_px=keypoints_px)


def on_mask(mask: NDArray[np.bool_], points_px: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """Points (N, 2) that lie on True pixels of a mask (H, W); beyond it the nearest pixel counts.

    The first pixel's centre is (0.5, 0.5). Rounding may put a keypoint of a resized image onto the
    image's last edge.
    """
    last = np.array(mask.shape[::-1]) - 1
    column, row = np.clip(points_px.astype(np.int64), 0, last).T
    return mask[row, column]
