"""An image at several scales."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch.nn import functional

_STEPS_PER_OCTAVE = 4
_TOLERANCE = 0.001  # of a scale: a side that rounding leaves a pixel short is still large enough


def pyramid_levels(image: torch.Tensor, *, min_size: int, max_size: int) -> Iterator[torch.Tensor]:
    """An image at scales 1, 2^-1/4, 2^-1/2 and so on, each level resized from the one before.

    This is R2D2's pyramid (Revaud et al., 2019, section 4); a pixel of one level is w'/w of the
    pixels of another, both having their origin at the image's corner.

    Parameters
    ----------
    image : float (B, C, H, W).
    min_size, max_size : the levels' longer side in pixels; larger ones are made but left out. An
        image that is itself smaller than ``min_size`` is the only level.

    Yields
    ------
    (B, C, h, w), largest first.
    """
    height, width = image.shape[-2:]
    longer = max(height, width)
    smallest = min(1.0, min_size / longer)
    level, step = image, 0
    while (scale := 2.0 ** (-step / _STEPS_PER_OCTAVE)) + _TOLERANCE >= smallest:
        size = round(height * scale), round(width * scale)
        if min(size) == 0:
            return
        if step:
            level = functional.interpolate(level, size, mode="bilinear", align_corners=False)
        if scale - _TOLERANCE <= max_size / longer:
            yield level
        step += 1
