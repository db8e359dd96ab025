"""Combination of a pair's matches and keypoints with those of its variants.

MegLoc, section "Guided pyramid matching": ALL is the union of the matches; MAX has the matches of
the variant with the most matches. A keypoint has at most one match per other image.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.matching.guided_pyramid import PairMatches, VariantMatches

SAME_KEYPOINT_PX = 1.0
Float32 = NDArray[np.float32]


TriedVariant = tuple[int, VariantMatches]
"""Matches of a variant of the first (0) or the second (1) image of a pair."""


@dataclass(frozen=True, eq=False)
class Combined:
    """Matches of a pair, combined with those of its variants.

    Attributes
    ----------
    matches, scores : int64 (K, 2) and float64 (K,).
    best : index of the variant with the most matches; None if the base has as many.
    added : per image int64 (A, 2), indices of the variant and of its match for each appended
        keypoint.
    """

    matches: NDArray[np.int64]
    scores: NDArray[np.float64]
    best: int | None
    added: tuple[NDArray[np.int64], NDArray[np.int64]]


def combine(
    base: PairMatches,
    tried: Sequence[TriedVariant],
    mode: Literal["all", "max"],
    keypoints: tuple[KeypointUnion, KeypointUnion | None],
) -> Combined:
    """Combine the matches of a pair and its variants, and append their keypoints.

    The base matches (K, 2) come first. Then come the variants, those with the most matches first,
    and the matches of each by score; keypoints that already have a match are skipped. With ``max``,
    the variant with the most matches replaces the base if it has more. The second image's keypoints
    may be None if that image has no variants.
    """
    base_matches, base_scores = base
    order = sorted(range(len(tried)), key=lambda at: -len(tried[at][1]))
    best = order[0] if order and len(tried[order[0]][1]) > len(base_matches) else None
    lengths = [0 if union is None else len(union) for union in keypoints]
    if mode == "max":
        if best is not None:
            alone = _Combination((base_matches[:0], base_scores[:0]), keypoints)
            alone.take(best, tried[best])
            if len(alone.matches) > len(base_matches):
                return alone.result(best)
            # merging identical keypoints has removed some of the variant's matches
            for union, length in zip(keypoints, lengths, strict=True):
                if union is not None:
                    union.truncate(length)
        return _Combination(base, keypoints).result(None)
    together = _Combination(base, keypoints)
    for at in order:
        together.take(at, tried[at])
    return together.result(best)


class _Combination:
    def __init__(
        self, base: PairMatches, keypoints: tuple[KeypointUnion, KeypointUnion | None]
    ) -> None:
        self._keypoints = keypoints
        self.matches = [(int(a), int(b)) for a, b in base[0]]
        self._scores = [float(score) for score in base[1]]
        self._used: tuple[set[int], set[int]] = (
            {a for a, _ in self.matches},
            {b for _, b in self.matches},
        )
        self._added: tuple[list[tuple[int, int]], list[tuple[int, int]]] = ([], [])

    def take(self, number: int, tried: TriedVariant) -> None:
        """Add the matches of a variant between keypoints that have no match yet."""
        side, matched = tried
        union = self._keypoints[side]
        if union is None:
            raise ValueError("keypoints are missing for an image with variants")
        known = union.find(matched.keypoints_px)
        used, used_other = self._used[side], self._used[1 - side]
        for k in np.argsort(-matched.scores, kind="stable").tolist():
            other = int(matched.other_rows[k])
            if other in used_other:
                continue
            row = int(known[k])
            if row < 0:  # the keypoint may have been appended in this loop
                row = union.find_added(matched.keypoints_px[k])
            if row < 0:
                row = union.append(matched.keypoints_px[k])
                self._added[side].append((number, k))
            elif row in used:
                continue
            used.add(row)
            used_other.add(other)
            self.matches.append((row, other) if side == 0 else (other, row))
            self._scores.append(float(matched.scores[k]))

    def result(self, best: int | None) -> Combined:
        first, second = (np.array(added, dtype=np.int64).reshape(-1, 2) for added in self._added)
        return Combined(
            np.array(self.matches, dtype=np.int64).reshape(-1, 2),
            np.array(self._scores, dtype=np.float64),
            best,
            (first, second),
        )


class KeypointUnion:
    """Base keypoints float32 (N, C), followed by added ones.

    A keypoint within a pixel of existing keypoints counts as identical to the nearest of them.
    """

    def __init__(self, base: Float32, added: Float32 | None = None) -> None:
        self._base = base
        self._tree = cKDTree(base[:, :2]) if len(base) else None
        self._added: list[Float32] = []
        self._rows_in: dict[tuple[int, int], list[int]] = defaultdict(list)
        for keypoint in () if added is None else added:
            self.append(keypoint)

    def __len__(self) -> int:
        return len(self._base) + len(self._added)

    def find(self, keypoints_px: Float32) -> NDArray[np.int64]:
        """Return the rows (K,) of identical keypoints, -1 for new ones."""
        rows_of = np.full(len(keypoints_px), -1, dtype=np.int64)
        if self._tree is not None and len(keypoints_px):
            near = self._tree.query_ball_point(
                keypoints_px[:, :2], SAME_KEYPOINT_PX, return_sorted=True
            )
            for k, rows in enumerate(near):
                if rows:
                    rows_of[k] = self._nearest(keypoints_px[k], rows)
        for k in np.flatnonzero(rows_of < 0).tolist():
            rows_of[k] = self.find_added(keypoints_px[k])
        return rows_of

    def find_added(self, keypoint_px: Float32) -> int:
        """Return the row of an identical added keypoint (C,), see :meth:`find`."""
        x, y = _cell(keypoint_px)
        rows = [
            row
            for step_x, step_y in product((-1, 0, 1), repeat=2)
            for row in self._rows_in.get((x + step_x, y + step_y), ())
        ]
        near = [row for row in sorted(rows) if self._distance(keypoint_px, row) <= SAME_KEYPOINT_PX]
        return self._nearest(keypoint_px, near) if near else -1

    def append(self, keypoint_px: Float32) -> int:
        """Append a new keypoint (C,) and return its row."""
        row = len(self)
        self._added.append(np.array(keypoint_px, dtype=np.float32))
        self._rows_in[_cell(keypoint_px)].append(row)
        return row

    def truncate(self, length: int) -> None:
        """Remove the keypoints added last, down to ``length``."""
        while len(self) > length:
            self._rows_in[_cell(self._added.pop())].pop()

    def added(self) -> Float32:
        """Return the added keypoints, float32 (M, C)."""
        if not self._added:
            return np.zeros((0, self._base.shape[1]), dtype=np.float32)
        return np.stack(self._added)

    def _nearest(self, keypoint_px: Float32, rows: list[int]) -> int:
        return min(rows, key=lambda row: (self._distance(keypoint_px, row), row))

    def _distance(self, keypoint_px: Float32, row: int) -> float:
        n = len(self._base)
        position = self._base[row] if row < n else self._added[row - n]
        dx, dy = (float(keypoint_px[k]) - float(position[k]) for k in (0, 1))
        return float(np.hypot(dx, dy))


def _cell(keypoint_px: Float32) -> tuple[int, int]:
    return int(np.floor(keypoint_px[0])), int(np.floor(keypoint_px[1]))
