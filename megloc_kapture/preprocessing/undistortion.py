"""The pinhole camera that sees what a camera with distortion saw."""

from __future__ import annotations

from dataclasses import replace

from megloc_kapture.io.colmap import undistorted_pinhole
from megloc_kapture.preprocessing.resizing import with_two_focals
from megloc_kapture.values import Camera

PINHOLE_MODELS = frozenset({"PINHOLE", "SIMPLE_PINHOLE"})
# models whose distortion is a polynomial of the tangent: without coefficients there is none (the
# fisheye models' is one of the angle)
_POLYNOMIAL_MODELS = frozenset({"OPENCV", "FULL_OPENCV"})


def undistorted_camera(camera: Camera, *, blank_pixels: float = 0.0) -> Camera:
    """The camera of the undistorted image, as COLMAP chooses it: its focal lengths are kept.

    Parameters
    ----------
    blank_pixels : 0: as large as it can be without a pixel that the image does not show; 1: as
        large as it must be to show all of the image; in between, in between.

    Returns
    -------
    A pinhole camera; the argument itself where it is one already.
    """
    if camera.model in PINHOLE_MODELS:
        return camera
    lens = with_two_focals(camera)
    if lens.model in _POLYNOMIAL_MODELS and not any(lens.params[4:]):
        return replace(lens, model="PINHOLE", params=lens.params[:4])
    return undistorted_pinhole(camera, blank_pixels=blank_pixels)
