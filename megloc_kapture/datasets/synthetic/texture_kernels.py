"""Compiled lookups in images between their pixels.

OpenCV's have fused multiplications on some processors; a compiled loop has none.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import numpy as np

from megloc_kapture.compiling import compiled_loop


@compiled_loop
def bilinear(image, x, y):
    """Values of an image (H, W, C) at ``x``, ``y``, float32 (R, S) each: float32 (R, S, C).

    The first pixel's centre is (0, 0); beyond the edge is what lies on it, at NaN the first pixel.
    """
    height, width, channels = image.shape
    rows, columns = x.shape
    result = np.empty((rows, columns, channels), np.float32)
    for row in range(rows):
        for column in range(columns):
            at_x, at_y = x[row, column], y[row, column]
            at_x = min(at_x, np.float32(width - 1)) if at_x > 0 else np.float32(0)
            at_y = min(at_y, np.float32(height - 1)) if at_y > 0 else np.float32(0)
            left, top = int(at_x), int(at_y)
            right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
            part_x, part_y = at_x - np.float32(left), at_y - np.float32(top)
            for channel in range(channels):
                upper = np.float32(image[top, left, channel])
                upper += part_x * (np.float32(image[top, right, channel]) - upper)
                lower = np.float32(image[bottom, left, channel])
                lower += part_x * (np.float32(image[bottom, right, channel]) - lower)
                result[row, column, channel] = upper + part_y * (lower - upper)
    return result
