"""A camera of every model."""

from __future__ import annotations

import pytest

from megloc_kapture.values import Camera

F, CX, CY = 500.0, 321.0, 238.5
PARAMS = {
    "SIMPLE_PINHOLE": (F, CX, CY),
    "PINHOLE": (F, 510.0, CX, CY),
    "SIMPLE_RADIAL": (F, CX, CY, -0.05),
    "RADIAL": (F, CX, CY, -0.05, 0.01),
    "OPENCV": (F, 510.0, CX, CY, -0.05, 0.01, 1e-3, -2e-3),
    "OPENCV_FISHEYE": (F, 510.0, CX, CY, 0.02, -0.01, 3e-3, -1e-3),
    "FULL_OPENCV": (F, 510.0, CX, CY, -0.05, 0.01, 1e-3, -2e-3, 1e-3, 0.02, -0.01, 1e-3),
    "FOV": (F, 510.0, CX, CY, 0.9),
    "SIMPLE_RADIAL_FISHEYE": (F, CX, CY, 0.02),
    "RADIAL_FISHEYE": (F, CX, CY, 0.02, -0.01),
    "THIN_PRISM_FISHEYE": (F, 510.0, CX, CY, 0.02, -0.01, 1e-3, -1e-3, 1e-3, 0.0, 1e-3, -1e-3),
}


@pytest.fixture(scope="session")
def cameras() -> dict[str, Camera]:
    return {model: Camera(model, 640, 480, params) for model, params in PARAMS.items()}
