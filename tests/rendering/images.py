"""Images to extract features from: noise, smooth noise, blobs at known places; photographs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray

Image = NDArray[np.uint8]


def random_image(height: int, width: int, seed: int = 0) -> Image:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def texture(height: int, width: int, seed: int = 0, sigma_px: float = 2.0) -> Image:
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), sigma_px)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def photograph(source: Path, path: Path, *, orientation: int = 1, focal_35mm: int = 0) -> None:
    """Write an image as a camera with square pixels stores it in this orientation, by EXIF."""
    exif = PIL.Image.Exif()
    exif[0x112] = orientation
    if focal_35mm:
        exif.get_ifd(0x8769)[0xA405] = focal_35mm
    with PIL.Image.open(source) as image:
        if image.size == (400, 300):  # the rendered corner's, 300 px wide and 302 px high
            image = image.resize((400, 298))
        stored = image.transpose(PIL.Image.Transpose.ROTATE_90) if orientation == 6 else image
        path.parent.mkdir(parents=True, exist_ok=True)
        stored.save(path, exif=exif, quality=95)


def blobs(
    centres: NDArray[np.float64],
    sigma_px: float,
    *,
    amplitude: NDArray[np.float64] | float = 120.0,
    size: tuple[int, int] = (200, 260),
) -> Image:
    """Gaussian blobs on grey; centres (N, 2) in pixels, first pixel's centre at (0.5, 0.5)."""
    y, x = np.mgrid[: size[0], : size[1]] + 0.5
    grey = np.full(size, 60.0)
    strengths = np.broadcast_to(amplitude, len(centres))
    for (cx, cy), strength in zip(centres, strengths, strict=True):
        grey += strength * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma_px**2))
    return np.repeat(np.clip(np.round(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
