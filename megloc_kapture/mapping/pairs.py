"""Which images of a map to match with each other: by poses, or all of them."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from megloc_kapture.values import Options, RigidTransform

_BLOCK_ELEMENTS = 1 << 20  # distances held at once; each takes about 80 bytes on the way


class PairsByPosesOptions(Options):
    """Options of pairs by poses; the distance is per image, so it needs no metric scale."""

    num_neighbours: int = Field(default=20, gt=0, description="nearest centres taken per image")
    max_distance: float | None = Field(
        default=None, gt=0, description="in the map's unit; none: no bound"
    )
    max_angle_deg: float = Field(default=60.0, gt=0, le=180, description="between optical axes")


def pairs_by_poses(
    cams_from_world: list[RigidTransform], options: PairsByPosesOptions | None = None
) -> NDArray[np.int64]:
    """Pairs of images that stand close and look the same way.

    Candidates come from a k-d tree in growing neighbourhoods, block by block: memory does not grow
    with the number of pairs, even where hardly any two images look the same way.

    Returns
    -------
    int64 (P, 2), indices i < j, sorted, each pair once.
    """
    options = options or PairsByPosesOptions()
    count = len(cams_from_world)
    if count < 2:
        return np.zeros((0, 2), dtype=np.int64)
    centers = np.array([pose.center() for pose in cams_from_world])
    axes = np.array([pose.rotation_matrix()[2] for pose in cams_from_world])
    min_cosine = np.cos(np.radians(options.max_angle_deg))
    # the tree's own bound is exclusive
    bound = np.inf if options.max_distance is None else np.nextafter(options.max_distance, np.inf)
    tree = cKDTree(centers)
    found = [np.zeros((0, 2), dtype=np.int64)]
    waiting = np.arange(count)
    size = min(count, 4 * options.num_neighbours + 1)
    while len(waiting):
        unfinished = []
        block = max(1, _BLOCK_ELEMENTS // size)
        for start in range(0, len(waiting), block):
            part = waiting[start : start + block]
            distance, index = tree.query(centers[part], k=size, distance_upper_bound=bound)
            valid = np.isfinite(distance) & (index != part[:, None])
            other = np.where(valid, index, 0)
            cosine = np.einsum("nd,nkd->nk", axes[part], axes[other])
            good = valid & (cosine >= min_cosine - 1e-12)
            rank = np.cumsum(good, axis=1)
            # an image whose neighbours look elsewhere searches further, until all are seen
            done = (rank[:, -1] >= options.num_neighbours) | ~np.isfinite(distance[:, -1])
            done |= size >= count
            take = good & (rank <= options.num_neighbours) & done[:, None]
            rows, columns = np.nonzero(take)
            found.append(np.stack([part[rows], index[rows, columns]], axis=1))
            unfinished.append(part[~done])
        waiting = np.concatenate(unfinished)
        size = min(count, 2 * size)
    return unique_pairs(np.concatenate(found))


def exhaustive_pairs(count: int) -> NDArray[np.int64]:
    """All pairs i < j of ``count`` images; for small maps."""
    return np.array(list(combinations(range(count), 2)), dtype=np.int64).reshape(-1, 2)


def unique_pairs(pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs (P, 2) with i < j, sorted, each once, none with itself."""
    ordered = np.sort(pairs.reshape(-1, 2), axis=1)
    ordered = ordered[ordered[:, 0] != ordered[:, 1]]
    return np.asarray(np.unique(ordered, axis=0), dtype=np.int64)
