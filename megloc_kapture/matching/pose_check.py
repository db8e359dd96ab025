"""Contradictions between given poses and the matches of the images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.poses import READINGS, better_conventions
from megloc_kapture.matching.verification import Floats, KnownPoseOptions, verify_with_poses
from megloc_kapture.values import RigidTransform

# largest Sampson distance as a share of the longer side; more than a degree, since poses from depth
# sensors have such errors
_MAX_ERROR_SHARE = 0.02
_AGREEING = 0.5  # the poses of a pair are correct if this share of its matches fits them
# an image is wrong if a larger share of its matches contradicts its pose; a map is wrong if a
# larger share of its images is wrong
_MOST = 0.5
# pairs with a smaller share of the usual number of matches may only look alike, and are left out
_WEAK = 0.5
_FEW = 3  # a map is rejected only if at least this many images are compared


@dataclass(frozen=True)
class PairEvidence:
    """Matches of a pair that fit its poses.

    ``num`` is the number of verified matches; ``fitting`` has the numbers of those that fit the
    poses as given, then the poses converted from each of :data:`~.poses.CONVENTIONS`.
    """

    image: str
    other: str
    num: int
    fitting: tuple[int, ...]

    @property
    def agrees(self) -> bool:
        return self.fitting[0] >= _AGREEING * self.num


def count_fitting(
    rays_a: Floats,
    slopes_a: Floats,
    rays_b: Floats,
    slopes_b: Floats,
    poses: tuple[RigidTransform, RigidTransform],
    side_px: int,
) -> tuple[int, ...]:
    """Count the matched rays that fit the poses as given, and in each convention.

    For rays and slopes see :func:`verify_with_poses`; ``side_px`` is the images' larger side.
    """
    options = KnownPoseOptions(max_error_px=_MAX_ERROR_SHARE * side_px)
    counts = []
    for read in READINGS:
        a, b = map(read, poses)
        good = verify_with_poses(
            rays_a, slopes_a, rays_b, slopes_b, b @ a.inverse(), options, min_matches=0
        )
        counts.append(int(good.sum()))
    return tuple(counts)


def pose_contradiction(pairs: Sequence[PairEvidence]) -> tuple[str, bool] | None:
    """Return a message, and True if the map should be rejected; None without a contradiction."""
    if not pairs:
        return None
    total = sum(pair.num for pair in pairs)
    counts: NDArray[np.int64] = np.sum([pair.fitting for pair in pairs], axis=0)
    if better := better_conventions((counts / total).tolist()):
        message = (
            f"the given poses contradict the matches: {counts[0]} of {total} matches in "
            f"{len(pairs)} image pairs fit them; with {' or '.join(better)}, {counts[1:].max()} "
            "would fit. Convert the poses to cam_from_world with x right, y down, z forward"
        )
        return message, True
    wrong, right = _split(pairs)
    if not wrong:
        return None
    shown = ", ".join(wrong[:5]) + (", ..." if len(wrong) > 5 else "")
    message = (
        f"the given poses of {len(wrong)} of {len(wrong) + right} compared images contradict their "
        f"matches: {shown}"
    )
    if len(wrong) + right < _FEW or len(wrong) <= _MOST * (len(wrong) + right):
        return message, False
    return f"{message}. No usual convention explains it: check poses, names and cameras", True


def _split(pairs: Sequence[PairEvidence]) -> tuple[list[str], int]:
    """Return the images with contradicting poses, and the number of images with an agreeing pair.

    Pairs are weighted by their numbers of matches. Images that only look alike have few matches, so
    pairs with less than half of the usual number, the median over the images of an image's largest
    number, are left out. A wrong pose also affects pairs with correctly posed images, so the worst
    image is removed first, repeatedly. A single pair is no evidence against an image.
    """
    largest: dict[str, int] = {}
    for pair in pairs:
        for image in (pair.image, pair.other):
            largest[image] = max(pair.num, largest.get(image, 0))
    left = [pair for pair in pairs if pair.num >= _WEAK * np.median(list(largest.values()))]
    number = Counter(image for pair in left for image in (pair.image, pair.other))
    wrong: list[str] = []
    while True:
        compared, contradicting = Counter[str](), Counter[str]()
        for pair in left:
            for image in (pair.image, pair.other):
                if number[image] > 1:
                    compared[image] += pair.num
                    contradicting[image] += 0 if pair.agrees else pair.num
        shares = [(contradicting[image] / num, num, image) for image, num in compared.items()]
        share, _, worst = max(shares, default=(0.0, 0, ""))
        if share <= _MOST:
            agreeing = {i for pair in left if pair.agrees for i in (pair.image, pair.other)}
            return sorted(wrong), len(agreeing)
        wrong.append(worst)
        left = [pair for pair in left if worst not in (pair.image, pair.other)]
