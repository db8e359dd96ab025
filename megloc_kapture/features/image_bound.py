"""A bound on the size of the images that local features are extracted from.

Memory grows with the pixels: RootSIFT and ALIKED take about 0.25 GB for a megapixel. A larger
image is reduced first, and its keypoints are scaled back.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.values import LocalFeatures, Options

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


class _Extractor(Protocol):
    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures: ...


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


def extract_bounded(
    extractor: _Extractor, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
) -> LocalFeatures:
    """Extract from an image, reduced where it is larger than the extractor's bound.

    x and y of the keypoints are those in the image as given; other columns, as a scale, are those
    of the reduced one. A pixel of a reduced mask is used where all that it covers is.
    """
    small = bounded_image(image, max_megapixels_of(extractor))
    if small is image:
        return extractor.extract(image, mask)
    height, width = small.shape[:2]
    if mask is not None:
        ignored = (~mask).astype(np.uint8) * 255
        mask = cv2.resize(ignored, (width, height), interpolation=cv2.INTER_AREA) == 0
    found = extractor.extract(small, mask)
    if not isinstance(found, LocalFeatures):
        return found  # whoever checks plugins says so
    keypoints_px = found.keypoints_px.copy()
    # the first pixel's centre is (0.5, 0.5): sizes scale as a whole
    keypoints_px[:, :2] *= np.array([image.shape[1] / width, image.shape[0] / height], np.float32)
    return replace(found, keypoints_px=keypoints_px)
