"""Arithmetic and poses with the same bits on every processor.

Sums, products, quotients and square roots are correctly rounded (IEEE 754), so they are equal
everywhere. BLAS products, OpenCV filters and elementary functions depend on the processor's
instructions, such as fused multiply-add. So matrix products and filters are explicit sums here, and
elementary functions are computed in float64 and rounded.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.values import RigidTransform

_DECIMALS = 9  # a nanometre, a million times the errors of the elementary functions
_CUBIC = -0.75  # slope of the kernel at distance 1, as in OpenCV

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bools = NDArray[np.bool_]


def settled(values: ArrayLike) -> Float64:
    """Round metres, radians or components of unit vectors to nine decimals, float64."""
    rounded = np.round(np.asarray(values, np.float64), _DECIMALS)
    return np.asarray(rounded + 0.0, np.float64)  # adding 0 turns -0 into 0


def settled_pose(rotation: Float64, translation: Float64) -> RigidTransform:
    """Return the transform of a rotation (3, 3) and a translation (3,), rounded."""
    quat = settled(RigidTransform.from_matrix(rotation, translation).quat_wxyz)
    # rounding errors of w decide the quaternion's sign for rotations by 180 degrees
    quat = quat * np.sign(quat[np.flatnonzero(quat)[0]])
    w, x, y, z = (quat / np.sqrt((quat * quat).sum()) + 0.0).tolist()
    tx, ty, tz = settled(translation).tolist()
    return RigidTransform((w, x, y, z), (tx, ty, tz))


def _rounded(function: np.ufunc) -> Callable[..., Float32]:
    """Compute the function in float64 and round to float32; angles are in radians."""
    return lambda *arguments: function(*arguments, dtype=np.float64).astype(np.float32)


exp, sin, log2, arctan2 = (_rounded(f) for f in (np.exp, np.sin, np.log2, np.arctan2))


def product(left: Float64, right: Float64) -> Float64:
    """Return ``left @ right``, (..., K) by (K,) or (K, M), for a small K >= 1."""
    terms = (left[..., k, None] * right[k] for k in range(len(right)))
    total = next(terms)
    for term in terms:
        total = total + term
    return total[..., 0] if right.ndim == 1 else total


def looking_at(position: Float64, yaw: float, pitch: float, roll: float) -> RigidTransform:
    """Return ``cam_from_world`` of a camera at ``position`` (3,), metres, in a frame with z up.

    Its axis points along ``yaw`` (radians from +x towards +y) and ``pitch`` above the horizon;
    ``roll`` rotates the camera about this axis (clockwise as seen by the camera).
    """
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    cos, sin = np.cos(roll), np.sin(roll)
    rotation = np.stack([cos * right + sin * down, cos * down - sin * right, forward])
    return settled_pose(rotation, -product(rotation, position))


def cam_from_rig(right_deg: float, up_deg: float, position: ArrayLike) -> RigidTransform:
    """Return the pose of a camera on a rig with axes x right, y down and z forward, metres.

    The camera points ``right_deg`` to the right and ``up_deg`` upwards, from ``position``.
    """
    angles = np.radians(right_deg), np.radians(up_deg)
    (cos_y, cos_x), (sin_y, sin_x) = np.cos(angles), np.sin(angles)
    about_y = np.array([[cos_y, 0, -sin_y], [0, 1, 0], [sin_y, 0, cos_y]])
    about_x = np.array([[1, 0, 0], [0, cos_x, sin_x], [0, -sin_x, cos_x]])
    rotation = product(about_x, about_y)
    return settled_pose(rotation, -product(rotation, np.array(position)))


def resized(image: Float32, width: int, height: int, *, cubic: bool = False) -> Float32:
    """Enlarge an image (h, w, ...) to (height, width, ...), linearly or by Keys' cubic.

    Pixel centres are half a pixel inside the image; edge pixels are repeated outside it.
    """
    across = _interpolated(np.moveaxis(image, 1, 0), width, cubic)
    return _interpolated(np.moveaxis(across, 0, 1), height, cubic)


def _interpolated(rows: Float32, count: int, cubic: bool) -> Float32:
    """Resample an array (N, ...) to ``count`` equidistant rows."""
    at = (np.arange(count) + 0.5) * (len(rows) / count) - 0.5
    first = np.floor(at).astype(np.int64)
    part = at - first
    weights = {0: 1 - part, 1: part}
    if cubic:
        weights = {tap: _keys(np.abs(part - tap)) for tap in (-1, 0, 1, 2)}
    taps = np.clip(first + np.array(list(weights))[:, None], 0, len(rows) - 1)
    shares = np.array(list(weights.values()), np.float32)
    flat = np.ascontiguousarray(rows, np.float32).reshape(len(rows), -1)
    return _summed(flat, taps, shares).reshape(count, *rows.shape[1:])


@compiled_loop
def _summed(rows: Float32, taps: NDArray[np.int64], shares: Float32) -> Float32:
    """Return weighted sums of rows of an array (N, M), with indices and weights (T, K)."""
    total = np.zeros((taps.shape[1], rows.shape[1]), np.float32)
    for row in range(len(total)):
        for tap in range(len(taps)):
            share, taken = shares[tap, row], rows[taps[tap, row]]
            for column in range(rows.shape[1]):
                total[row, column] += taken[column] * share
    return total


def _keys(distance: Float64) -> Float64:
    """Return weights of samples at distances of 0 to 2 (Keys 1981, equation 4, free slope at 1)."""
    d = distance
    near = ((_CUBIC + 2) * d - (_CUBIC + 3)) * d * d + 1
    return np.where(d <= 1, near, _CUBIC * (((d - 5) * d + 8) * d - 4))


def averaged(image: Float32, factor: int) -> Float32:
    """Average blocks of ``factor`` by ``factor`` pixels: (h // factor, w // factor, ...)."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    image = image[: height * factor, : width * factor]
    down = sum(image[k::factor] for k in range(factor))
    across = sum(np.asarray(down)[:, k::factor] for k in range(factor))
    return np.asarray(across, np.float32) * np.float32(1 / factor**2)


def blurred(image: Float32, deviation_px: float) -> Float32:
    """Blur an image (h, w, ...) by a Gaussian, up to four deviations, mirrored at the edges."""
    radius = int(round(4 * deviation_px))
    weights = np.asarray(exp(-0.5 * (np.arange(radius + 1) / deviation_px) ** 2), np.float64)
    weights = (weights / (weights[0] + 2 * np.sum(weights[1:]))).astype(np.float32)
    for axis in (0, 1):
        size = image.shape[axis]
        padding = [(0, 0)] * image.ndim
        padding[axis] = (radius, radius)
        padded = np.moveaxis(np.pad(image, padding, mode="reflect"), axis, 0)
        total = padded[radius : radius + size] * weights[0]
        for k in range(1, radius + 1):
            below, above = radius - k, radius + k
            total += (padded[below : below + size] + padded[above : above + size]) * weights[k]
        image = np.moveaxis(total, 0, axis)
    return np.ascontiguousarray(image)
