"""The best keypoints of an image that its mask allows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def select_keypoints(
    xy_px: NDArray[np.float32],
    scores: NDArray[np.float32],
    *,
    size: tuple[int, int],
    mask: NDArray[np.bool_] | None,
    max_keypoints: int,
) -> tuple[NDArray[np.int64], int]:
    """Rows of the best keypoints, best first, ties by y, then x; and how many the mask removed.

    Parameters
    ----------
    xy_px : float32 (N, 2), the first pixel's centre at (0.5, 0.5).
    scores : float32 (N,).
    size : (H, W) of the image.
    mask : bool (H, W), True where keypoints may be, or None; applied before the best are selected.
    """
    rows = np.arange(len(xy_px))
    num_masked = 0
    if mask is not None:
        # rounding may put a keypoint of a resized image onto the image's last edge
        last = np.array([size[1] - 1, size[0] - 1])
        column, row = np.clip(xy_px.astype(np.int64), 0, last).T
        allowed = mask[row, column]
        rows = rows[allowed]
        num_masked = len(allowed) - len(rows)
    order = np.lexsort((xy_px[rows, 0], xy_px[rows, 1], -scores[rows]))
    return rows[order[:max_keypoints]], num_masked
