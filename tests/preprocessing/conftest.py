"""A camera of every COLMAP model, and images of functions of pixel coordinates."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.values import Camera

LENSES: dict[str, tuple[float, ...]] = {
    "SIMPLE_PINHOLE": (330.0, 243.0, 181.0),
    "PINHOLE": (330.0, 341.0, 243.0, 181.0),
    "SIMPLE_RADIAL": (330.0, 243.0, 181.0, -0.08),
    "RADIAL": (330.0, 243.0, 181.0, -0.2, 0.05),
    "OPENCV": (330.0, 341.0, 243.0, 181.0, -0.25, 0.08, 1e-3, -5e-4),
    "OPENCV_FISHEYE": (250.0, 258.0, 243.0, 181.0, -0.02, 0.005, -1e-3, 2e-4),
    "FULL_OPENCV": (330.0, 341.0, 243.0, 181.0, -0.25, 0.08, 1e-3, -5e-4, 0.01, 0.02, 0.01, 1e-3),
    "FOV": (250.0, 258.0, 243.0, 181.0, 0.9),
    "SIMPLE_RADIAL_FISHEYE": (250.0, 243.0, 181.0, -0.02),
    "RADIAL_FISHEYE": (250.0, 243.0, 181.0, -0.02, 0.003),
    "THIN_PRISM_FISHEYE": (
        *(250.0, 258.0, 243.0, 181.0, -0.02, 0.005, 1e-3, 2e-4),
        *(1e-3, 1e-4, 1e-3, -1e-3),
    ),
}
WIDTH, HEIGHT = 483, 362


def camera_of(model: str) -> Camera:
    return Camera(model, WIDTH, HEIGHT, LENSES[model])


@pytest.fixture(params=sorted(LENSES))
def camera(request: pytest.FixtureRequest) -> Camera:
    return camera_of(request.param)


@pytest.fixture(params=sorted(set(LENSES) - {"PINHOLE", "SIMPLE_PINHOLE"}))
def distorted(request: pytest.FixtureRequest) -> Camera:
    return camera_of(request.param)


@pytest.fixture
def painted() -> Callable[..., NDArray[np.uint8]]:
    """Return a function that samples brightness at pixel centres to an image (H, W, 3)."""

    def paint(
        brightness: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]],
        width: int = WIDTH,
        height: int = HEIGHT,
    ) -> NDArray[np.uint8]:
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        grey = np.clip(np.rint(brightness(x, y)), 0, 255).astype(np.uint8)
        return np.repeat(grey[:, :, None], 3, axis=2)

    return paint


@pytest.fixture
def lens() -> Callable[[str], Camera]:
    return camera_of
