"""Which reading of a file explains its poses clearly better than the right one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# no single pose counts for more than this: a share of truly wrong ones must not decide
_CLIP = 3.0
# no score below this is told from it: it is as far from the map as it takes
_FLOOR = 12.0
# a reading has to gain so much per pose on average, also at the lower end of what is certain
_GAIN, _CERTAIN_GAIN = 0.7, 0.3
# ... for this share of the poses, and this share of them has to fit the map when read so: more
# where it takes a rare mistake or several
_SHARE_BETTER, _SHARE_FITTING, _SHARE_FITTING_RARE = 0.6, 0.5, 0.6
# each mistake more has to gain this in all, and this per pose
_PER_MISTAKE, _PER_MISTAKE_AND_POSE = 3.0, 0.6
# readings this near to the best, per pose or in what is certain, explain the file as well
_AS_GOOD = 0.3
# with fewer poses, chance finds a reading for them
MIN_POSES = 3


@dataclass(frozen=True)
class Explanation:
    """A wrong reading that explains the file.

    Parameters
    ----------
    reading : its index.
    as_good : indices of others that explain the file as well.
    fitting, fitting_as_is : share of poses that fit the map when read so, and when read rightly.
    """

    reading: int
    as_good: tuple[int, ...]
    fitting: float
    fitting_as_is: float


def explain(
    scores: NDArray[np.float64], fits: NDArray[np.bool_], mistakes: Sequence[float]
) -> Explanation | None:
    """The wrong reading that explains the poses clearly better than the right one, or None.

    Parameters
    ----------
    scores : float64 (R, N) of N poses in R readings; the first reading is the right one.
    fits : bool (R, N), whether a pose could be one in a reading.
    mistakes : of each reading; ascending.
    """
    number = scores.shape[1]
    if number < MIN_POSES:
        return None
    gains = _gains(scores, scores[0])
    mean = gains.mean(axis=1)
    uncertain = gains.std(axis=1, ddof=1) / np.sqrt(number)
    share = (gains > 0.5).mean(axis=1)
    fitting = fits.mean(axis=1)
    good = (mean > _GAIN) & (mean - 2 * uncertain > _CERTAIN_GAIN)
    count = np.array(mistakes)
    wanted = np.where(count > 1, _SHARE_FITTING_RARE, _SHARE_FITTING)
    good &= (share >= _SHARE_BETTER) & (fitting >= wanted) & (fitting >= fitting[0])
    found = np.flatnonzero(good)
    if not len(found):
        return None
    # compared with one another, not with the right reading, over which they may all gain the most
    # that counts; what is left out is worse than all of these
    base = scores[found[np.argmax(scores[found].clip(-_FLOOR).mean(axis=1))]]
    worth = np.array([_gains(own, base).mean() for own in scores])
    worth -= count * max(_PER_MISTAKE / number, _PER_MISTAKE_AND_POSE)
    best = int(found[np.argmax(worth[found])])
    as_good = [int(r) for r in found if _is_as_good(scores[r], scores[best])]
    # of what cannot be told apart the simplest, and of equally simple ones the best
    as_good.sort(key=lambda r: (count[r], -worth[r]))
    first, *others = as_good
    others = [r for r in others if count[r] <= count[first]]
    return Explanation(first, tuple(others), float(fitting[first]), float(fitting[0]))


def undecided(scores: NDArray[np.float64]) -> list[int]:
    """Readings that the right one (the first of ``scores``) is not clearly better than."""
    return [r for r in range(1, len(scores)) if _is_as_good(scores[r], scores[0])]


def _is_as_good(scores: NDArray[np.float64], best: NDArray[np.float64]) -> bool:
    more = _gains(best, scores)
    return bool(more.mean() < max(_AS_GOOD, 2 * more.std(ddof=1) / np.sqrt(len(more))))


def _gains(scores: NDArray[np.float64], base: NDArray[np.float64]) -> NDArray[np.float64]:
    """Clipped differences; a pose that is infinitely far in both readings gains nothing."""
    with np.errstate(invalid="ignore"):
        difference = scores - base
    return np.clip(np.nan_to_num(difference, nan=0.0, posinf=_CLIP, neginf=-_CLIP), -_CLIP, _CLIP)
