"""View of a map from above."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.poses import invert_quats, rotate

# length of the mean "down" below which cameras agree on no vertical
_MIN_AGREEMENT = 0.5
# a vertical this close to a world axis is snapped to it, for labels x, y and z
_AXIS_COSINE = float(np.cos(np.deg2rad(15.0)))


@dataclass(frozen=True, eq=False, slots=True)
class TopView:
    """Orthonormal directions (3,) of the world that are right and up on the page; axis labels."""

    right: NDArray[np.float64]
    up: NDArray[np.float64]
    labels: tuple[str, str]

    def project(self, centers: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([centers @ self.right, centers @ self.up], axis=1)


def top_view(quats_wxyz: NDArray[np.float64], centers: NDArray[np.float64]) -> TopView:
    """Look down on cameras ``cam_from_world`` (N, 4) with centres (N, 3), N at least 1.

    Vertical is the mean downward direction of the images, or without agreement the direction in
    which the centres spread least.
    """
    down = rotate(invert_quats(quats_wxyz), np.array([0.0, 1.0, 0.0])).mean(axis=0)
    length = float(np.linalg.norm(down))
    spread = centers - centers.mean(axis=0)
    axes = np.linalg.eigh(spread.T @ spread)[1].T[::-1]
    upward = -down / length if length >= _MIN_AGREEMENT else _signed(axes[2])
    nearest = int(np.argmax(np.abs(upward)))
    if abs(upward[nearest]) >= _AXIS_COSINE:
        first, second = (nearest + 1) % 3, (nearest + 2) % 3
        if upward[nearest] < 0:  # swapped, so that the page is not mirrored
            first, second = second, first
        return TopView(np.eye(3)[first], np.eye(3)[second], ("xyz"[first], "xyz"[second]))
    right = axes[0] - (axes[0] @ upward) * upward
    if np.linalg.norm(right) < 1e-6:  # the cameras are on one vertical line
        right = np.eye(3)[int(np.argmin(np.abs(upward)))]
        right = right - (right @ upward) * upward
    right = _signed(right / np.linalg.norm(right))
    return TopView(right, np.cross(upward, right), ("along the map", "across the map"))


def _signed(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    return direction if direction[int(np.argmax(np.abs(direction)))] > 0 else -direction
