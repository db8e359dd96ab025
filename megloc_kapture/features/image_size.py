"""An image as a network takes it, made smaller where it is larger than that should see."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from megloc_kapture.nets.runtime import image_tensor


def sized_tensor(
    image: NDArray[np.uint8], max_size_px: int | None, device: torch.device
) -> torch.Tensor:
    """An RGB image, uint8 (H, W, 3), as float32 (1, 3, h, w) in [0, 1]; never larger than it was.

    Beyond ``max_size_px`` pixels are the means of the areas they cover, not rounded, as hloc makes
    them. Sides are rounded to whole pixels, halves to even ones, and are at least 1.
    """
    height, width = image.shape[:2]
    if max_size_px is None or max(height, width) <= max_size_px:
        return image_tensor(image, device)
    scale = max_size_px / max(height, width)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    resized = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(np.asarray(resized)).to(device).permute(2, 0, 1)[None] / 255.0
