"""Reranking of candidates: by the keypoints they cover together, and without near-duplicates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.values import Options


def greedy_coverage(
    keypoint_ids: Sequence[NDArray[np.int64]], keep: int
) -> tuple[list[int], list[int]]:
    """Choose images one by one, each for the keypoints that those before it do not match.

    By the number of matches alone, neighbours of the best image come next, which see the same
    from nearly the same position. This is the greedy solution of maximum coverage, at least a
    share of 1 - 1/e of the best one (Nemhauser, Wolsey and Fisher, "An analysis of
    approximations for maximizing submodular set functions", Mathematical Programming 1978).

    Parameters
    ----------
    keypoint_ids : of each image, the query's keypoints that it matches, each once.
    keep : at most so many images.

    Returns
    -------
    order : indices into ``keypoint_ids``. Of images that add as many, the one with more matches
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


class DiversityOptions(Options):
    """Options of diversity: near-duplicates by pose, and how many a ranking may have."""

    max_per_place: int = Field(default=3, gt=0, description="images within radius and angle")
    radius: float = Field(default=2.0, gt=0, description="of camera centres, unit of the map")
    angle_deg: float = Field(default=30.0, gt=0, le=180, description="between viewing directions")


def diversify(
    ranking: NDArray[np.int64],
    centers: NDArray[np.float64],
    directions: NDArray[np.float64],
    top_k: int,
    options: DiversityOptions,
) -> NDArray[np.int64]:
    """Positions in a ranking of the images to keep, in its order.

    Greedy: an image is passed over when ``max_per_place`` of those kept are near it. Passed-over
    images fill what is left of ``top_k`` in the end, so that the ranking stays as long.

    Parameters
    ----------
    ranking : int64 (K,), images as rows of the following, best first.
    centers, directions : float64 (N, 3), of camera centres and of unit viewing directions.

    Returns
    -------
    int64 (min(K, top_k),) positions in ``ranking``: the kept ones, then the fillers.
    """
    at, towards = centers[ranking], directions[ranking]
    cosine = np.cos(np.deg2rad(options.angle_deg))
    kept: list[int] = []
    passed: list[int] = []
    for position in range(len(ranking)):
        if len(kept) == top_k:
            break
        distance = np.linalg.norm(at[kept] - at[position], axis=1)
        near = (distance <= options.radius) & (towards[kept] @ towards[position] >= cosine)
        (passed if near.sum() >= options.max_per_place else kept).append(position)
    return np.array([*kept, *passed[: top_k - len(kept)]], dtype=np.int64)
