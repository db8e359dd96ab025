"""Shadows of the sun: heights of what the sun sees, on a grid across its direction."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.portable import product
from megloc_kapture.datasets.synthetic.surfaces import Surfaces

_SIZE = 1024
_BIAS_M = 0.05  # surfaces must not shade themselves
_NOTHING = np.float32(-1e9)

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ShadowMap:
    """Greatest height along the sun's direction over a grid of lines parallel to it.

    Parameters
    ----------
    axes : float64 (3, 3), rows: the grid's x and y directions and the sun's.
    low : float64 (2,), the grid's corner; ``step`` : metres between its lines.
    height : float32 (_SIZE, _SIZE), metres along the sun's direction.
    """

    axes: NDArray[np.float64]
    low: NDArray[np.float64]
    step: float
    height: Float32

    def lit(self, x: Float32, y: Float32, z: Float32) -> Float32:
        """1 where the sun reaches a point, else 0; arrays of one shape, metres."""
        a = self.axes.astype(np.float32)
        gx, gy, up = (row[0] * x + row[1] * y + row[2] * z for row in a)
        gx = (gx - np.float32(self.low[0])) / np.float32(self.step) - np.float32(0.5)
        gy = (gy - np.float32(self.low[1])) / np.float32(self.step) - np.float32(0.5)
        top = cv2.remap(
            self.height,
            gx,
            gy,
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=float(_NOTHING),
        )
        return (up + np.float32(_BIAS_M) > top).astype(np.float32)


def cast_shadows(surfaces: Surfaces, sun_direction: tuple[float, float, float]) -> ShadowMap:
    """The shadow map of the surfaces (both sides cast shadows)."""
    sun = np.array(sun_direction)
    side = np.cross([0.0, 0.0, 1.0] if abs(sun[2]) < 0.99 else [1.0, 0.0, 0.0], sun)
    side /= np.sqrt((side * side).sum())
    axes = np.stack([side, np.cross(sun, side), sun])
    flat = product(surfaces.corners(), axes.T)[..., :2]
    low, high = flat.min((0, 1)) - 0.1, flat.max((0, 1)) + 0.1
    step = float((high - low).max() / _SIZE)
    nothing = ShadowMap(axes, low, step, np.full((_SIZE, _SIZE), _NOTHING, np.float32))
    return add_shadows(nothing, surfaces)


def add_shadows(shadows: ShadowMap, surfaces: Surfaces) -> ShadowMap:
    """The map with the shadows of more surfaces, where they lie on its grid."""
    axes, low, step = shadows.axes, shadows.low, shadows.step
    height = shadows.height.copy()
    outline = (product(surfaces.corners(), axes.T)[..., :2] - low) / step
    first = np.clip(np.floor(outline.min(1)) - 1, 0, _SIZE).astype(int)
    last = np.clip(np.ceil(outline.max(1)) + 1, 0, _SIZE).astype(int)
    along = surfaces.moved(axes, np.zeros(3))
    origin, edge_u, edge_v = along.origin, along.edge_u, along.edge_v
    across = edge_u[:, 0] * edge_v[:, 1] - edge_u[:, 1] * edge_v[:, 0]
    for index in np.flatnonzero((np.abs(across) > 1e-6) & (first < last).all(1)):
        (left, top), (right, bottom) = first[index], last[index]
        x = (low[0] + (np.arange(left, right) + 0.5) * step - origin[index, 0])[None]
        y = (low[1] + (np.arange(top, bottom) + 0.5) * step - origin[index, 1])[:, None]
        x, y = x.astype(np.float32), y.astype(np.float32)
        eu, ev = edge_u[index].astype(np.float32), edge_v[index].astype(np.float32)
        area = np.float32(across[index])
        u = x * (ev[1] / area) - y * (ev[0] / area)
        v = y * (eu[0] / area) - x * (eu[1] / area)
        up = np.float32(origin[index, 2]) + u * eu[2] + v * ev[2]
        window = height[top:bottom, left:right]
        inside = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1) & (up > window)
        np.copyto(window, up, where=inside)
    return ShadowMap(axes, low, step, height)
