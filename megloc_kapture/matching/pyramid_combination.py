"""Combination of a pair's matches and keypoints with those of its variants.

MegLoc, section "Guided pyramid matching": ALL is the union of the matches; MAX has the matches of
the variant with the most matches. A keypoint has at most one match per other image.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import product
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.matching.guided_pyramid import PairMatches, VariantMatches

SAME_KEYPOINT_PX = 1.0
Float32 = NDArray[np.float32]


TriedVariant = tuple[int, VariantMatches]
"""Matches of a variant of the first (0) or the second (1) image of a pair."""


def combine(
    base: PairMatches,
    tried: Sequence[TriedVariant],
    mode: Literal["all", "max"],
    keypoints: Sequence[KeypointUnion],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Combine the matches of a pair and its variants, and append their keypoints.

    The base matches (K, 2) come first. Then come the variants, those with the most matches first,
    and the matches of each by score; keypoints that already have a match are skipped. With ``max``,
    the variant with the most matches replaces the base if it has more. ``keypoints`` has one union
    per image; that of the second may be omitted if it has no variants. Returns int64 (K, 2) and
    scores float64 (K,).
    """
    matches, scores = base
    richest_first = sorted(tried, key=lambda each: -len(each[1]))
    if mode == "all":
        return _extended(base, richest_first, keypoints)
    if richest_first and len(richest_first[0][1]) > len(matches):
        lengths = [len(union) for union in keypoints]
        alone = _extended((matches[:0], scores[:0]), richest_first[:1], keypoints)
        if len(alone[0]) > len(matches):
            return alone
        # merging identical keypoints has removed some of the variant's matches
        for union, length in zip(keypoints, lengths, strict=True):
            union.truncate(length)
    return _extended(base, (), keypoints)


def _extended(
    base: PairMatches, tried: Sequence[TriedVariant], keypoints: Sequence[KeypointUnion]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Add the matches of variants between keypoints that have no match yet."""
    matches = [(int(a), int(b)) for a, b in base[0]]
    scores = [float(score) for score in base[1]]
    used_by_image = {a for a, _ in matches}, {b for _, b in matches}
    for side, variant in tried:
        union = keypoints[side]
        known = union.find(variant.keypoints_px)
        used, used_other = used_by_image[side], used_by_image[1 - side]
        for k in np.argsort(-variant.scores, kind="stable").tolist():
            other = int(variant.other_rows[k])
            if other in used_other:
                continue
            row = int(known[k])
            if row < 0:  # the keypoint may have been appended in this loop
                row = union.find_added(variant.keypoints_px[k])
            if row < 0:
                row = union.append(variant.keypoints_px[k], variant.descriptors[k])
            elif row in used:
                continue
            used.add(row)
            used_other.add(other)
            matches.append((row, other) if side == 0 else (other, row))
            scores.append(float(variant.scores[k]))
    return np.array(matches, np.int64).reshape(-1, 2), np.array(scores, np.float64)


class KeypointUnion:
    """Base keypoints float32 (N, C), followed by added ones with their ``descriptors`` (D,).

    A keypoint counts as the same as the nearest one within a pixel, base keypoints first.
    """

    def __init__(self, base: Float32) -> None:
        self._base = base
        self._tree = cKDTree(base[:, :2]) if len(base) else None
        self._added: list[Float32] = []
        self.descriptors: list[NDArray[Any]] = []
        self._rows_in: dict[tuple[int, int], list[int]] = defaultdict(list)

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

    def append(self, keypoint_px: Float32, descriptor: NDArray[Any]) -> int:
        """Append a new keypoint (C,) and return its row."""
        row = len(self)
        self._added.append(np.array(keypoint_px, dtype=np.float32))
        self.descriptors.append(descriptor)
        self._rows_in[_cell(keypoint_px)].append(row)
        return row

    def truncate(self, length: int) -> None:
        """Remove the keypoints added last, down to ``length``."""
        while len(self) > length:
            self._rows_in[_cell(self._added.pop())].pop()
            self.descriptors.pop()

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
