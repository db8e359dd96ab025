"""Fixed masks, static regions in images of a moving camera (a car's bonnet), and mask margins."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from megloc_kapture.geometry.cameras import reduced_size
from megloc_kapture.values import Options

# polygons are tested in blocks of rows, to bound memory
_ROWS_AT_ONCE = 256
# edges of fewer images may agree by chance
MIN_IMAGES = 10
# more images add no information
MAX_IMAGES = 60
_WORKING_SIZE_PX = 256
_NOISE_PER_PX = 3.0  # grey levels per pixel of the reduced image; weaker edges count less
# mean agreement of two images' edges, -1 to 1: static edges reach 0.5, moving edges at most 0.1
_MIN_AGREEMENT = 0.3
_WIDE_PX, _NARROW_PX = 9, 3  # averaging windows
# a pixel is changing if its edges are strong, relative to the median, and disagree
_CHANGING_AGREEMENT, _CHANGING_STRENGTH = 0.1, 0.5
_MAX_CHANGING = 0.4  # largest share of changing pixels in a column below the frontier
_MIN_RUN = 0.1  # smallest width of a region, as a share of the image's; bonnets are wider
_MAX_GAP = 0.05  # smaller gaps, as a share of the width, are closed
# varying light lowers the detected frontier by up to this much
_MARGIN_PX = 4
_MAX_AREA = 0.6  # a region with a larger share of the image means a static camera
Float32 = NDArray[np.float32]


class FixedMask(Options):
    """Mask for all images of a camera, by one of ``file``, ``polygon`` and ``bottom_share``.

    These refer to the original images, before undistortion and resizing.
    """

    camera: str = Field(
        min_length=1, description="a sensor's id, or a pattern of image names (left/*.jpg)"
    )
    file: Path | None = Field(
        default=None, description="image of the camera's size, 0 for ignored pixels"
    )
    polygon: tuple[tuple[float, float], ...] | None = Field(
        default=None,
        min_length=3,
        description="corners (x, y) of an ignored polygon, as shares of width and height",
    )
    bottom_share: float | None = Field(
        default=None, gt=0, lt=1, description="ignored share of the height, from the bottom"
    )
    fallback: bool = Field(
        default=False,
        description="only for cameras without a detected ego-vehicle region",
    )

    @model_validator(mode="after")
    def _exactly_one(self) -> FixedMask:
        given = [self.file, self.polygon, self.bottom_share]
        if sum(value is not None for value in given) != 1:
            raise ValueError("a fixed mask needs exactly one of file, polygon and bottom_share")
        if any(not 0 <= share <= 1 for corner in self.polygon or () for share in corner):
            raise ValueError("coordinates of a polygon's corners must be between 0 and 1")
        return self

    def is_for(self, sensor_id: str, image: str) -> bool:
        return self.camera == sensor_id or fnmatchcase(image, self.camera)

    def drawn(self, width: int, height: int) -> NDArray[np.bool_]:
        """Return the mask bool (H, W), True = use, of the polygon or the bottom share."""
        if self.polygon is not None:
            return outside_polygon(np.array(self.polygon), width, height)
        assert self.bottom_share is not None
        rows = (np.arange(height) + 0.5) / height < 1 - self.bottom_share
        return np.repeat(rows[:, None], width, axis=1)


def outside_polygon(corners: NDArray[np.floating], width: int, height: int) -> NDArray[np.bool_]:
    """Return a mask (H, W), True outside a polygon (N, 2) by the even-odd rule.

    Corners are in shares of width and height.
    """
    x0, y0 = (np.asarray(corners, np.float64) * [width, height]).T
    x1, y1 = np.roll(x0, -1), np.roll(y0, -1)
    x = np.arange(width) + 0.5
    outside = np.ones((height, width), dtype=bool)
    for start in range(0, height, _ROWS_AT_ONCE):
        rows = outside[start : start + _ROWS_AT_ONCE]
        y = np.arange(start, start + len(rows)) + 0.5
        for ax, ay, bx, by in zip(x0, y0, x1, y1, strict=True):
            # a pixel changes sides at each edge that a ray to the left crosses; edges are half open
            # so that a corner counts once
            crossed = (ay <= y) != (by <= y)
            if crossed.any():
                at = ax + (y[crossed] - ay) * ((bx - ax) / (by - ay))
                rows[crossed] ^= at[:, None] <= x
    return outside


def with_margin(mask: NDArray[np.bool_], margin_px: float) -> NDArray[np.bool_]:
    """Erode a mask bool (H, W), True = use, by a Euclidean margin, except at the image border."""
    if margin_px <= 0 or mask.all():
        return mask
    import cv2  # takes 0.1 s, and most commands do not need it

    distances = cv2.distanceTransform(
        mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE, dstType=cv2.CV_32F
    )
    return np.asarray(distances > margin_px)


@dataclass(frozen=True)
class UnchangingRegion:
    """Static region below a frontier across the image; an empty region is falsy and has a reason.

    The frontier has one value for each of N equally wide columns of the image: its distance from
    the top as a share of the height, 1 in columns without a region.
    """

    frontier: tuple[float, ...]
    reason: str = ""

    def __bool__(self) -> bool:
        return not self.reason

    def mask(self, width: int, height: int) -> NDArray[np.bool_]:
        """Return the mask bool (H, W), True = use."""
        if not self:
            return np.ones((height, width), dtype=bool)
        columns = np.arange(width) * len(self.frontier) // width
        limit = np.array(self.frontier)[columns]
        return np.asarray(((np.arange(height) + 0.5) / height)[:, None] < limit[None])


def edge_directions(image: NDArray[np.uint8]) -> Float32:
    """Return normalised gradients float32 (h, w, 2), length 0 to 1, of a downscaled RGB image."""
    import cv2

    height, width = image.shape[:2]
    size = reduced_size(width, height, _WORKING_SIZE_PX)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    # the kernel returns 8 times the slope
    slopes = [
        cv2.Sobel(small, cv2.CV_32F, *axis, ksize=3, scale=1 / 8) for axis in ((1, 0), (0, 1))
    ]
    directions = np.stack(slopes, axis=-1)
    strength = np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.asarray(directions / (strength + np.float32(_NOISE_PER_PX)), np.float32)


def find_unchanging_region(sequence: Iterable[Float32]) -> UnchangingRegion:
    """Find the static region at the bottom of a moving camera's images.

    ``sequence`` has the :func:`edge_directions` of at least MIN_IMAGES images.
    """
    total: Any
    total = lengths = squares = np.float32(0)
    count = 0
    for directions in sequence:
        length = np.linalg.norm(directions, axis=-1)
        total, lengths, squares = total + directions, lengths + length, squares + length**2
        count += 1
    assert count >= MIN_IMAGES
    # sums of dot products and of products of lengths over all pairs of different images
    agreeing = np.square(total).sum(axis=-1) - squares
    present = np.square(lengths) - squares
    wide, narrow = (
        _mean(agreeing, window) / np.maximum(_mean(present, window), 1e-6)
        for window in (_WIDE_PX, _NARROW_PX)
    )
    persistent = np.minimum(wide, narrow) >= _MIN_AGREEMENT
    strength = _mean(present, _WIDE_PX)
    changing = (wide < _CHANGING_AGREEMENT) & (strength > _CHANGING_STRENGTH * np.median(strength))
    tops = _column_tops(persistent, changing)
    height, width = persistent.shape
    tops = _without_slivers(tops, height)
    nothing = (1.0,) * width
    if (tops == height).all():
        return UnchangingRegion(nothing, "its images have no static region at the bottom")
    if 1 - tops.mean() / height > _MAX_AREA:
        return UnchangingRegion(nothing, "most of the image is static, so the camera hardly moves")
    tops = np.where(tops < height, np.maximum(tops - _MARGIN_PX, 0), tops)
    return UnchangingRegion(tuple(float(top) for top in tops / height))


def _mean(values: Float32, window: int) -> Float32:
    import cv2

    return np.asarray(cv2.blur(values, (window, window)))


def _column_tops(persistent: NDArray[np.bool_], changing: NDArray[np.bool_]) -> NDArray[np.int64]:
    height = len(persistent)
    below = np.arange(height, 0, -1)[:, None]
    share = np.cumsum(changing[::-1], axis=0)[::-1] / below
    frontier = persistent & (share <= _MAX_CHANGING)
    return np.where(frontier.any(axis=0), frontier.argmax(axis=0), height)


def _without_slivers(tops: NDArray[np.int64], height: int) -> NDArray[np.int64]:
    width = len(tops)
    inside = np.flatnonzero(tops < height)
    if len(inside) == 0:
        return tops
    tops = tops.copy()
    for left, right in zip(inside[:-1], inside[1:], strict=True):
        if 1 < right - left <= _MAX_GAP * width:
            tops[left + 1 : right] = max(tops[left], tops[right])
    padded = np.pad(tops, 2, mode="edge")
    tops = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1).astype(np.int64)
    runs = np.flatnonzero(np.diff(np.concatenate([[0], tops < height, [0]])))
    for start, stop in runs.reshape(-1, 2):
        if stop - start < _MIN_RUN * width:
            tops[start:stop] = height
    return tops
