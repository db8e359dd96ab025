"""Are the poses a storey off? Heights above the map's cameras around them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.evaluation.check.reference import MapCameras
from megloc_kapture.geometry.poses import rotation_matrices

# the mean of the cameras' up directions is this long where most of them stand upright
_UPRIGHT = 0.8
# no ceiling is lower, and no two ways of holding a camera differ so much
_STOREY_M = 1.5
# this many times the map's own difference in height between neighbours
_OWN = 4.0
_SHARE = 0.6
_NEIGHBOURS = 8


def storey_offset(cameras: MapCameras, centers: NDArray[np.float64]) -> float | None:
    """Height that most poses have above the map's cameras around them, where it is a storey's.

    Parameters
    ----------
    cameras : of the map, in metres.
    centers : float64 (N, 3), of the poses, in the same frame.

    Returns
    -------
    Metres, negative below; None where the heights are usual, or where the map does not say which
    way is up.
    """
    ups = -rotation_matrices(cameras.quats)[:, 1, :]
    up = ups.mean(axis=0)
    length = float(np.linalg.norm(up))
    centers = centers[np.isfinite(centers).all(axis=1) & (np.abs(centers) < 1e100).all(axis=1)]
    if length < _UPRIGHT or not len(centers):
        return None
    up /= length
    # two directions that lie level
    _, _, level = np.linalg.svd(up[None])
    middle = np.median(cameras.centers, axis=0)
    own, given = cameras.centers - middle, centers - middle
    extent = float(np.quantile(np.linalg.norm(own, axis=1), 0.9))
    if not extent > 0:
        return None
    # cameras of one place count once, or each would be its own neighbour
    grid = extent / 200
    own = np.unique(np.round(own / grid), axis=0) * grid
    tree = cKDTree(own @ level[1:].T)
    count = min(_NEIGHBOURS, len(own) - 1)
    if count < 1:
        return None
    heights = own @ up
    _, found = tree.query(own @ level[1:].T, k=np.arange(1, count + 2))
    usual = float(np.quantile(_smallest(heights[found[:, 1:]] - heights[:, None]), 0.9))
    distance, found = tree.query(given @ level[1:].T, k=np.arange(1, count + 1))
    near = distance[:, 0] <= extent
    if not near.any():
        return None
    differences = (given @ up)[:, None] - heights[found]
    best = np.argmin(np.abs(differences), axis=1)
    above = differences[np.arange(len(best)), best][near]
    offset = float(np.median(above))
    alike = np.abs(above - offset) < 0.5 * abs(offset)
    if abs(offset) < max(_STOREY_M, _OWN * usual) or alike.mean() * near.mean() < _SHARE:
        return None
    return offset


def _smallest(differences: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.abs(differences).min(axis=1)
