"""All textures of a place and their smaller levels in one image, so that one lookup serves all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

NUM_LEVELS = 7  # each half the size of the one before
ATLAS_WIDTH = 4096
_BORDER = 2  # texels repeated around each level: bilinear lookups at the edge stay inside


@dataclass(frozen=True, eq=False)
class Atlas:
    """Textures packed with their levels.

    Parameters
    ----------
    image : uint8 (H, ATLAS_WIDTH, 3), RGB.
    corner : float32 (T, NUM_LEVELS, 2): x, y of each level's upper left corner in ``image``.
    size : float32 (T, NUM_LEVELS, 2): width and height of each level, texels.
    """

    image: NDArray[np.uint8]
    corner: NDArray[np.float32]
    size: NDArray[np.float32]


def _half(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    size = (image.shape[1] + 1) // 2, (image.shape[0] + 1) // 2
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def build_atlas(textures: Sequence[NDArray[np.uint8]]) -> Atlas:
    """Pack textures, uint8 (h, w, 3) each, at most ATLAS_WIDTH - 4 wide."""
    levels: list[NDArray[np.uint8]] = []
    for texture in textures:
        current = texture
        for level in range(NUM_LEVELS):
            if level:
                current = _half(current)
            levels.append(current)
    heights = np.array([piece.shape[0] for piece in levels]) + 2 * _BORDER
    widths = np.array([piece.shape[1] for piece in levels]) + 2 * _BORDER
    corner = np.zeros((len(levels), 2), np.int64)
    x = y = shelf = 0
    for index in np.argsort(-heights, kind="stable"):  # shelves, highest first
        if x + widths[index] > ATLAS_WIDTH:
            x, y, shelf = 0, y + shelf, 0
        corner[index] = (x + _BORDER, y + _BORDER)
        x += int(widths[index])
        shelf = max(shelf, int(heights[index]))
    image = np.zeros((y + shelf, ATLAS_WIDTH, 3), np.uint8)
    for (left, top), piece in zip(corner - _BORDER, levels, strict=True):
        padded = cv2.copyMakeBorder(piece, _BORDER, _BORDER, _BORDER, _BORDER, cv2.BORDER_REPLICATE)
        image[top : top + padded.shape[0], left : left + padded.shape[1]] = padded
    size = np.array([(piece.shape[1], piece.shape[0]) for piece in levels], np.float32)
    shape = (len(textures), NUM_LEVELS, 2)
    return Atlas(image, corner.astype(np.float32).reshape(shape), size.reshape(shape))
