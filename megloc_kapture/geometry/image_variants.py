"""An image scaled and turned by quarters, and the exact map of its pixels to the original's.

Pixel coordinates are continuous, the first pixel's centre at (0.5, 0.5): an image of size (w, h)
covers [0, w] x [0, h]. A variant covers the same scene from edge to edge, so that coordinates
scale by the ratio of the sizes, which is not exactly ``scale`` where a size had to be rounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, order=True)
class ImageVariant:
    """Scale and rotation of an image.

    Parameters
    ----------
    scale : size of the variant over that of the original.
    rotation_deg : 0, 90, 180 or 270, counter-clockwise as one sees it, after scaling.
    """

    scale: float = 1.0
    rotation_deg: int = 0

    def __post_init__(self) -> None:
        if self.rotation_deg not in (0, 90, 180, 270):
            raise ValueError(f"a rotation is 0, 90, 180 or 270 degrees, got {self.rotation_deg}")
        if not 0 < self.scale < np.inf:
            raise ValueError(f"scale {self.scale} is not positive")

    def __str__(self) -> str:
        return f"{self.scale:.4g}@{self.rotation_deg}"

    @property
    def is_identity(self) -> bool:
        """True if it is the image as it is."""
        return self == ImageVariant()

    def scaled_size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height before turning."""
        return max(1, round(width * self.scale)), max(1, round(height * self.scale))

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the variant of an image of this size."""
        scaled = self.scaled_size(width, height)
        return scaled if self.rotation_deg % 180 == 0 else (scaled[1], scaled[0])

    def of_image(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The variant of an image, uint8 (H, W) or (H, W, 3).

        A smaller pixel is the mean of the area it covers, so that nothing aliases; a larger image
        is interpolated linearly, rounded the same way on every processor.
        """
        import cv2  # 0.1 s, and most that imports this never looks at an image

        height, width = image.shape[:2]
        size = self.scaled_size(width, height)
        if size != (width, height):
            smaller = size[0] <= width and size[1] <= height
            how = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR_EXACT
            image = np.asarray(cv2.resize(image, size, interpolation=how), dtype=np.uint8)
        return np.ascontiguousarray(np.rot90(image, self.rotation_deg // 90))

    def of_mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """The variant of a mask (H, W): True where every pixel it covers a part of is True."""
        height, width = mask.shape
        scaled_width, scaled_height = self.scaled_size(width, height)
        ignored = np.zeros((height + 1, width + 1), dtype=np.int64)
        np.cumsum(np.cumsum(~mask, axis=0), axis=1, out=ignored[1:, 1:])
        top, bottom = _covered(height, scaled_height)
        left, right = _covered(width, scaled_width)
        count = (
            ignored[np.ix_(bottom, right)]
            - ignored[np.ix_(top, right)]
            - ignored[np.ix_(bottom, left)]
            + ignored[np.ix_(top, left)]
        )
        return np.ascontiguousarray(np.rot90(count == 0, self.rotation_deg // 90))

    def px_in_original(
        self, px: NDArray[np.floating[Any]], width: int, height: int
    ) -> NDArray[np.float64]:
        """Pixels (N, 2) of the variant, in the original of this size; float64 (N, 2)."""
        scaled = self.scaled_size(width, height)
        x, y = np.asarray(px, dtype=np.float64).T
        back = {
            0: (x, y),
            90: (scaled[0] - y, x),
            180: (scaled[0] - x, scaled[1] - y),
            270: (y, scaled[1] - x),
        }
        return np.stack(back[self.rotation_deg], axis=1) * (
            np.array([width, height]) / np.array(scaled)
        )


def _covered(length: int, scaled: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First pixel, and the one behind the last, that each of ``scaled`` pixels covers a part of."""
    at = np.arange(scaled, dtype=np.int64)
    return at * length // scaled, -((at + 1) * -length // scaled)
