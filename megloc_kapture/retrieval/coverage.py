"""The images that together match most keypoints of a query."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def most_covering(
    keypoint_ids: Sequence[NDArray[np.int64]], keep: int
) -> tuple[list[int], list[int]]:
    """Choose images one by one, each for the keypoints that those before it do not match.

    By the number of matches alone, neighbours of the best image come next, which see the same
    from nearly the same place. This is the greedy solution of maximum coverage, which is at least
    a share of 1 - 1/e of the best one (Nemhauser, Wolsey and Fisher, "An analysis of
    approximations for maximizing submodular set functions", Mathematical Programming 1978).

    Parameters
    ----------
    keypoint_ids : of each image, the query's keypoints that it matches, each once.
    keep : at most so many images.

    Returns
    -------
    order : places in ``keypoint_ids``. Of images that add as many, the one with more matches
        comes first, of those the first.
    added : keypoints that each of them adds.
    """
    size = max((int(ids.max()) + 1 for ids in keypoint_ids if len(ids)), default=0)
    missing = np.ones(size, dtype=bool)
    left = list(range(len(keypoint_ids)))
    order: list[int] = []
    added: list[int] = []
    while left and len(order) < keep:
        gains = {at: int(missing[keypoint_ids[at]].sum()) for at in left}
        best = max(left, key=lambda at: (gains[at], len(keypoint_ids[at]), -at))
        missing[keypoint_ids[best]] = False
        left.remove(best)
        order.append(best)
        added.append(gains[best])
    return order, added
