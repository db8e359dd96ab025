"""Keypoints that were stored without descriptors, found again among those extracted anew."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

# a keypoint that is found again is found at the same place but for rounding
SAME_PLACE_PX = 0.1


def rows_found_again(
    stored: NDArray[np.float32], extracted: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Row of ``extracted`` (M, 2) for each row of ``stored`` (N, 2), -1 where there is none.

    Each row of ``extracted`` is taken once. Several keypoints may stand at one place with different
    orientations; they are joined in the order both have them.
    """
    if len(stored) == len(extracted) and np.allclose(stored, extracted, atol=1e-3):
        return np.arange(len(stored), dtype=np.int64)
    rows = np.full(len(stored), -1, dtype=np.int64)
    if len(extracted) == 0:
        return rows
    near = cKDTree(extracted).query_ball_point(stored, SAME_PLACE_PX, return_sorted=True)
    used: set[int] = set()
    for row, candidates in enumerate(near):
        for candidate in candidates:
            if candidate not in used:
                used.add(candidate)
                rows[row] = candidate
                break
    return rows


def rows_at_their_places(
    stored: NDArray[np.float32], extracted: NDArray[np.float32], max_shift_px: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All keypoints that stand where the stored ones do: one of ``stored`` may be any of them.

    The place of a stored keypoint is that of the nearest extracted one.

    Parameters
    ----------
    stored, extracted : float32 (N, 2) and (M, 2), pixels.
    max_shift_px : how far the nearest may be.

    Returns
    -------
    Rows of ``stored`` and of ``extracted``, int64 (K,) each, sorted by the first, then the second.
    """
    none = np.zeros(0, dtype=np.int64)
    if len(stored) == 0 or len(extracted) == 0:
        return none, none
    tree = cKDTree(extracted)
    distance, nearest = tree.query(stored)
    found = np.flatnonzero(distance <= max_shift_px)
    near = tree.query_ball_point(extracted[nearest[found]], SAME_PLACE_PX, return_sorted=True)
    lengths = [len(rows) for rows in near]
    if not lengths:
        return none, none
    return np.repeat(found, lengths), np.concatenate(near).astype(np.int64)
