"""Two views of one photograph under random homographies and random light.

As SuperPoint and the open matchers are pretrained (DeTone et al., CVPR workshops 2018, section 5):
no depth, no poses and no labels are needed, any folder of photographs will do.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.values import Options

_HALF = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]


class HomographyOptions(Options):
    """Options of random views of a photograph."""

    min_scale: float = Field(default=0.5, gt=0, le=1, description="of a view, of the photograph")
    max_angle_deg: float = Field(default=45.0, ge=0, le=180, description="of a view's rotation")
    perspective: float = Field(
        default=0.2, ge=0, lt=0.5, description="how far corners move, of the view's sides"
    )
    light: float = Field(
        default=1.0, ge=0, le=1, description="strength of changes of light, noise, blur and JPEG"
    )


def random_view(
    image: Image, size: tuple[int, int], rng: np.random.Generator, options: HomographyOptions
) -> tuple[Image, Floats]:
    """A view of a quadrilateral of the photograph, which lies in it as a whole.

    Parameters
    ----------
    image : uint8 (H, W, 3).
    size : width and height of the view.

    Returns
    -------
    view : uint8 (height, width, 3).
    view_from_image : float64 (3, 3), of pixels whose first centre is (0.5, 0.5).
    """
    width, height = size
    sides = np.array([image.shape[1], image.shape[0]], np.float64)
    rectangle = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64) * size
    moved = rectangle + rng.uniform(-1, 1, (4, 2)) * options.perspective * np.array(size)
    angle = np.radians(rng.uniform(-1, 1) * options.max_angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    corners = (moved - rectangle.mean(axis=0)) @ turn.T
    extent = np.ptp(corners, axis=0)
    # as large a part of the photograph as fits, times the scale
    corners *= rng.uniform(options.min_scale, 1.0) * (sides / extent).min()
    corners -= corners.min(axis=0)
    corners += rng.uniform(0, 1, 2) * (sides - corners.max(axis=0))
    view_from_image = cv2.getPerspectiveTransform(
        corners.astype(np.float32), rectangle.astype(np.float32)
    )
    # OpenCV's warp has the first pixel's centre at (0, 0)
    warp = np.linalg.inv(_HALF) @ view_from_image @ _HALF
    view = cv2.warpPerspective(
        image, warp, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(view, np.uint8), np.asarray(view_from_image, np.float64)


def relit(image: Image, rng: np.random.Generator, strength: float = 1.0) -> Image:
    """The photograph in other light, by another camera: gamma, exposure, cast, noise, blur, JPEG.

    Parameters
    ----------
    strength : 0 changes nothing.
    """
    if strength <= 0:
        return image
    gamma, exposure = np.exp2(rng.uniform(-1, 1, 2) * strength)
    cast = np.exp2(rng.normal(0, 0.12 * strength, 3))
    noise, blur = rng.uniform(0, 0.04 * strength), rng.uniform(0, 1.2 * strength)
    level = (image.astype(np.float32) / 255) ** np.float32(gamma)
    # what is brighter than white is lost, so exposure mostly takes light away
    level *= (min(exposure, 1.3) * cast).astype(np.float32)
    if blur > 0.3:
        level = np.asarray(cv2.GaussianBlur(level, (0, 0), float(blur)), np.float32)
    level += rng.normal(0, noise, level.shape).astype(np.float32)
    lit = np.clip(255 * level, 0, 255).astype(np.uint8)
    quality = int(rng.integers(100 - int(60 * strength), 101))
    done, encoded = cv2.imencode(".jpg", lit, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), np.uint8) if done else lit
