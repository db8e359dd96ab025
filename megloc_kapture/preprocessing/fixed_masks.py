"""Masks that stand still: what a camera always sees of the car, the tripod or itself."""

from __future__ import annotations

from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from megloc_kapture.values import Options

# more pixels than this times the edges of a polygon are not tested at once
_ROWS_AT_ONCE = 256


class FixedMask(Options):
    """What is ignored in every image of a camera: one of ``file``, ``polygon``, ``bottom_share``.

    All of them refer to the original images, before they are undistorted and resized.
    """

    camera: str = Field(
        min_length=1, description="a sensor's id, or a pattern of image names (left/*.jpg)"
    )
    file: Path | None = Field(
        default=None, description="an image of the camera's size, 0 where it is ignored"
    )
    polygon: tuple[tuple[float, float], ...] | None = Field(
        default=None,
        min_length=3,
        description="corners (x, y) of what is ignored, in shares of the width and the height",
    )
    bottom_share: float | None = Field(
        default=None, gt=0, lt=1, description="share of the height, from the bottom"
    )
    fallback: bool = Field(
        default=False,
        description="only for cameras whose unchanging region was not looked for or not found",
    )

    @model_validator(mode="after")
    def _exactly_one(self) -> FixedMask:
        given = [self.file, self.polygon, self.bottom_share]
        if sum(value is not None for value in given) != 1:
            raise ValueError("a fixed mask takes one of file, polygon and bottom_share")
        if any(not 0 <= share <= 1 for corner in self.polygon or () for share in corner):
            raise ValueError("a polygon's corners are shares between 0 and 1")
        return self

    def is_for(self, sensor_id: str, image: str) -> bool:
        """Whether it applies to an image of a sensor."""
        return self.camera == sensor_id or fnmatchcase(image, self.camera)

    def drawn(self, width: int, height: int) -> NDArray[np.bool_]:
        """The mask bool (H, W), True = use, of a polygon or a bottom share.

        Raises
        ------
        ValueError : it is a file.
        """
        if self.polygon is not None:
            return outside_polygon(np.array(self.polygon), width, height)
        if self.bottom_share is None:
            raise ValueError("the mask is a file, it is not drawn")
        rows = (np.arange(height) + 0.5) / height < 1 - self.bottom_share
        return np.repeat(rows[:, None], width, axis=1)


def outside_polygon(corners: NDArray[np.floating], width: int, height: int) -> NDArray[np.bool_]:
    """Which pixels' centres are not in a polygon; bool (H, W).

    Parameters
    ----------
    corners : (N, 2) x and y in shares of width and height; even-odd where edges cross.
    """
    x0, y0 = (np.asarray(corners, np.float64) * [width, height]).T
    x1, y1 = np.roll(x0, -1), np.roll(y0, -1)
    x = np.arange(width) + 0.5
    outside = np.ones((height, width), dtype=bool)
    for start in range(0, height, _ROWS_AT_ONCE):
        rows = outside[start : start + _ROWS_AT_ONCE]
        y = np.arange(start, start + len(rows)) + 0.5
        for ax, ay, bx, by in zip(x0, y0, x1, y1, strict=True):
            # edges that a ray to the left crosses; half open, so that a corner counts once
            crossed = (ay <= y) != (by <= y)
            if crossed.any():
                at = ax + (y[crossed] - ay) * ((bx - ax) / (by - ay))
                rows[crossed] ^= at[:, None] <= x
    return outside
