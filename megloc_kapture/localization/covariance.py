"""Covariance of an estimated pose, and how well it places the camera.

First-order propagation (Hartley and Zisserman, Multiple View Geometry, section 5.2.2): with J the
Jacobian of the whitened reprojections with respect to the pose, the covariance is
``sigma^2 (J^T J)^-1``, sigma estimated from the residuals.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# a handful of perfect matches is no proof of perfection
_MIN_VARIANCE_PX2 = 0.1**2
_MAX_CONDITION = 1e12


def pose_covariance(
    information: NDArray[np.float64], variance_px2: float
) -> NDArray[np.float64] | None:
    """Covariance (6, 6) of a pose from its normal matrix ``J^T J`` (6, 6) for a noise of 1 px.

    Order: rotation in radians, then translation in the unit of the map, both of a left
    perturbation: ``cam_from_world_true = exp(rotation, translation) cam_from_world``.

    Returns None when the matrix does not determine the pose.
    """
    if not np.isfinite(information).all() or not (np.diagonal(information) > 0).all():
        return None
    # columns differ by the scene's scale: equilibrate before judging the condition
    scale = np.sqrt(np.diagonal(information))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if values[0] * _MAX_CONDITION <= values[-1]:
        return None
    half = vectors / np.sqrt(values) / scale[:, None]
    return np.asarray(max(variance_px2, _MIN_VARIANCE_PX2) * (half @ half.T))


def center_deviation(covariance: NDArray[np.float64]) -> float:
    """Largest standard deviation of the camera's centre over all directions, in the map's unit.

    Of a ``covariance`` (6, 6) as :func:`pose_covariance` has it: a left perturbation moves the
    centre by its translation, seen in the camera, to first order.
    """
    return float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
