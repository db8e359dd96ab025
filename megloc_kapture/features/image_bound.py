"""Size limit of images for local feature extraction.

Memory grows with the number of pixels: RootSIFT and ALIKED take about 0.25 GB per megapixel. Images
above the limit are reduced first, and their keypoints scaled back.
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
    max_megapixels: float = Field(
        default=DEFAULT_MEGAPIXELS,
        gt=0,
        allow_inf_nan=False,
        description="larger images are reduced to this size for extraction, and keypoints scaled "
        "back; memory grows with the number of pixels",
    )


def bounded_size(width: int, height: int, max_megapixels: float) -> tuple[int, int]:
    if width * height <= max_megapixels * 1e6:
        return width, height
    scale = math.sqrt(max_megapixels * 1e6 / (width * height))
    return max(1, int(width * scale)), max(1, int(height * scale))


def bounded_image(
    image: NDArray[np.uint8], max_megapixels: float = DEFAULT_MEGAPIXELS
) -> NDArray[np.uint8]:
    """Reduce an image (H, W, 3) if it is too large; else return the same array."""
    height, width = image.shape[:2]
    size = bounded_size(width, height, max_megapixels)
    if size == (width, height):
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def max_megapixels_of(extractor: object) -> float:
    options: Any = getattr(extractor, "options", None)
    return float(getattr(options, "max_megapixels", DEFAULT_MEGAPIXELS))


def extract_bounded(extractor: Any, frames: Sequence[Frame]) -> list[LocalFeatures]:
    """Extract from images of equal size, reduced to the extractor's limit.

    Keypoints are in pixels of the given images. A pixel of a reduced mask is usable if all pixels
    that it covers are. For more than one image the extractor needs ``extract_many``.
    """
    bound = max_megapixels_of(extractor)
    small = [_reduced(*frame, bound) for frame in frames]
    several = len(frames) > 1
    features = (
        extractor.extract_many(*zip(*small, strict=True))
        if several
        else [extractor.extract(*small[0])]
    )
    (height, width), (own_height, own_width) = small[0][0].shape[:2], frames[0][0].shape[:2]
    # the first pixel's centre is (0.5, 0.5), so coordinates scale with the size
    ratio = np.array([own_width / width, own_height / height], np.float32)
    return features if small[0][0] is frames[0][0] else [_scaled(each, ratio) for each in features]


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
        return features
    keypoints_px = features.keypoints_px.copy()
    keypoints_px[:, :2] *= ratio
    return replace(features, keypoints_px=keypoints_px)


def on_mask(mask: NDArray[np.bool_], points_px: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """Return a mask (N,) of the points (N, 2) on True pixels of a mask (H, W).

    Points outside are clamped to the border.
    """
    last = np.array(mask.shape[::-1]) - 1
    column, row = np.clip(points_px.astype(np.int64), 0, last).T
    return mask[row, column]
