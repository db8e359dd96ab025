"""A camera of every model, 640 x 480 pixels."""

from __future__ import annotations

from megloc_kapture.values import Camera

F, CX, CY = 500.0, 321.0, 238.5
_PARAMS = {
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
CAMERAS = {model: Camera(model, 640, 480, params) for model, params in _PARAMS.items()}
PINHOLE = CAMERAS["PINHOLE"]
# a lens whose image does not reach the corners: their pixels have no ray
STRONG = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.3))
