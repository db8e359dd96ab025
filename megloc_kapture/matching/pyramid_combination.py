"""The matches of a pair and of its variants put together, and the keypoints that they add.

MegLoc, section "Guided pyramid matching": ALL is the union, MAX the richest. In both a keypoint has
one match at most with the other image, as everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.matching.guided_pyramid import PairMatches, VariantMatches
from megloc_kapture.matching.keypoint_union import KeypointUnion


@dataclass(frozen=True, eq=False)
class Tried:
    """A variant of the first (0) or the second (1) image of a pair, with its matches."""

    side: Literal[0, 1]
    matches: VariantMatches


@dataclass(frozen=True, eq=False)
class Combined:
    """The matches of a pair, with those of its variants.

    Attributes
    ----------
    matches : int64 (K, 2), rows of the two images' keypoints; each row at most once.
    scores : float64 (K,).
    best : which of the tried variants has most matches, None where the images as they are have
        as many.
    added : for both images, of each keypoint that was appended: the tried variant it comes from,
        and which of its matches; int64 (A, 2).
    """

    matches: NDArray[np.int64]
    scores: NDArray[np.float64]
    best: int | None
    added: tuple[NDArray[np.int64], NDArray[np.int64]]


def combine(
    base: PairMatches,
    tried: Sequence[Tried],
    mode: Literal["all", "max"],
    keypoints: tuple[KeypointUnion, KeypointUnion | None],
) -> Combined:
    """Put the matches of a pair and of its variants together, and append their keypoints.

    The base's matches come first, then those of the richest variant, in each the best first; one
    whose keypoint has a match already, in either image, has nothing to add. By ``max`` the richest
    variant stands for the base where it has more.

    Parameters
    ----------
    base : matches (K, 2) of the images as they are, and scores (K,).
    keypoints : of both images, appended to; the second is not needed where no variant is of it.
    """
    base_matches, base_scores = base
    order = sorted(range(len(tried)), key=lambda at: -len(tried[at].matches))
    best = order[0] if order and len(tried[order[0]].matches) > len(base_matches) else None
    lengths = [0 if union is None else len(union) for union in keypoints]
    if mode == "max":
        if best is not None:
            alone = _Combination((base_matches[:0], base_scores[:0]), keypoints)
            alone.take(best, tried[best])
            if len(alone.matches) > len(base_matches):
                return alone.result(best)
            # several of its keypoints are the same one
            for union, length in zip(keypoints, lengths, strict=True):
                if union is not None:
                    union.truncate(length)
        return _Combination(base, keypoints).result(None)
    together = _Combination(base, keypoints)
    for at in order:
        together.take(at, tried[at])
    return together.result(best)


class _Combination:
    """Matches of a pair that grow, every keypoint in at most one."""

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

    def take(self, number: int, tried: Tried) -> None:
        """Add the matches of a variant whose keypoints have none yet."""
        side, found = tried.side, tried.matches
        union = self._keypoints[side]
        if union is None:
            raise ValueError("a variant of an image whose keypoints are not given")
        known = union.find(found.keypoints_px)
        used, used_other = self._used[side], self._used[1 - side]
        for k in np.argsort(-found.scores, kind="stable").tolist():
            other = int(found.other_rows[k])
            if other in used_other:
                continue
            row = int(known[k])
            if row < 0:  # it may have been appended since
                row = union.find_added(found.keypoints_px[k])
            if row < 0:
                row = union.append(found.keypoints_px[k])
                self._added[side].append((number, k))
            elif row in used:
                continue
            used.add(row)
            used_other.add(other)
            self.matches.append((row, other) if side == 0 else (other, row))
            self._scores.append(float(found.scores[k]))

    def result(self, best: int | None) -> Combined:
        first, second = (np.array(added, dtype=np.int64).reshape(-1, 2) for added in self._added)
        return Combined(
            np.array(self.matches, dtype=np.int64).reshape(-1, 2),
            np.array(self._scores, dtype=np.float64),
            best,
            (first, second),
        )
