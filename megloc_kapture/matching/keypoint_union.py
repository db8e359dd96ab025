"""Keypoints of one image that grow: what stands at a known place is known, the rest is appended."""

from __future__ import annotations

from collections import defaultdict
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

SAME_PLACE_PX = 1.0


class KeypointUnion:
    """Keypoints that were there, which keep their rows, and behind them those that are added.

    A keypoint within a pixel of one that is there already is that one (the nearest, of equals the
    first), and never adds a row.

    Parameters
    ----------
    base : float32 (N, C), x and y first, in pixels of the original image.
    added : float32 (M, C), what was added to it before.
    """

    def __init__(self, base: NDArray[np.float32], added: NDArray[np.float32] | None = None) -> None:
        self._base = base
        self._tree = cKDTree(base[:, :2]) if len(base) else None
        self._added: list[NDArray[np.float32]] = []
        self._rows_in: dict[tuple[int, int], list[int]] = defaultdict(list)
        for keypoint in () if added is None else added:
            self.append(keypoint)

    def __len__(self) -> int:
        return len(self._base) + len(self._added)

    def find(self, keypoints_px: NDArray[np.float32]) -> NDArray[np.int64]:
        """Row (K,) of the keypoint that stands where each of (K, C) does, -1 where none does."""
        found = np.full(len(keypoints_px), -1, dtype=np.int64)
        if self._tree is not None and len(keypoints_px):
            near = self._tree.query_ball_point(
                keypoints_px[:, :2], SAME_PLACE_PX, return_sorted=True
            )
            for k, rows in enumerate(near):
                if rows:
                    found[k] = self._nearest(keypoints_px[k], rows)
        for k in np.flatnonzero(found < 0).tolist():
            found[k] = self.find_added(keypoints_px[k])
        return found

    def find_added(self, keypoint_px: NDArray[np.float32]) -> int:
        """As :meth:`find` of one keypoint (C,), among those that were added."""
        x, y = _cell(keypoint_px)
        rows = [
            row
            for step_x, step_y in product((-1, 0, 1), repeat=2)
            for row in self._rows_in.get((x + step_x, y + step_y), ())
        ]
        near = [row for row in sorted(rows) if self._distance(keypoint_px, row) <= SAME_PLACE_PX]
        return self._nearest(keypoint_px, near) if near else -1

    def append(self, keypoint_px: NDArray[np.float32]) -> int:
        """Add a keypoint (C,) that stands nowhere yet; its row."""
        row = len(self)
        self._added.append(np.array(keypoint_px, dtype=np.float32))
        self._rows_in[_cell(keypoint_px)].append(row)
        return row

    def truncate(self, length: int) -> None:
        """Take back what was added since there were ``length`` keypoints."""
        while len(self) > length:
            self._rows_in[_cell(self._added.pop())].pop()

    def added(self) -> NDArray[np.float32]:
        """The keypoints that were added, float32 (M, C)."""
        if not self._added:
            return np.zeros((0, self._base.shape[1]), dtype=np.float32)
        return np.stack(self._added)

    def keypoints_px(self) -> NDArray[np.float32]:
        """All keypoints, float32 (N + M, C)."""
        return np.concatenate([self._base, self.added()])

    def _nearest(self, keypoint_px: NDArray[np.float32], rows: list[int]) -> int:
        return min(rows, key=lambda row: (self._distance(keypoint_px, row), row))

    def _distance(self, keypoint_px: NDArray[np.float32], row: int) -> float:
        n = len(self._base)
        there = self._base[row] if row < n else self._added[row - n]
        dx, dy = (float(keypoint_px[k]) - float(there[k]) for k in (0, 1))
        return float(np.hypot(dx, dy))


def _cell(keypoint_px: NDArray[np.float32]) -> tuple[int, int]:
    """The square of a pixel's size that a keypoint stands in."""
    return int(np.floor(keypoint_px[0])), int(np.floor(keypoint_px[1]))
