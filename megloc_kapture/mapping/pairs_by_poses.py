"""Pairs of images that stand close and look the same way."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from megloc_kapture.mapping.pairs import unique_pairs
from megloc_kapture.values import Options, RigidTransform

_BLOCK_ELEMENTS = 1 << 20  # distances held at once; each takes about 80 bytes on the way
# where hardly any two images look the same way, an image searches no further than this
_MAX_SEARCHED = 1024


class PairsByPosesOptions(Options):
    """Options of pairs by poses; the distance is per image, so it needs no metric scale."""

    num_neighbours: int = Field(default=20, gt=0, description="nearest centres taken per image")
    max_distance: float | None = Field(
        default=None, gt=0, description="in the map's unit; none: no bound"
    )
    max_angle_deg: float = Field(default=60.0, gt=0, le=180, description="between optical axes")
    min_overlap: float | None = Field(
        default=None,
        gt=0,
        le=1,
        description="share of one image's points in the other's view, of the pairs so found; "
        "needs points; none: no bound",
    )


def pairs_by_poses(
    cams_from_world: list[RigidTransform], options: PairsByPosesOptions | None = None
) -> NDArray[np.int64]:
    """Pairs of images that stand close and look the same way.

    Candidates come from a k-d tree in growing neighbourhoods, block by block. An image looks at no
    more than the 1024 nearest centres, so that time and memory grow with the number of images.

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
    # an image is its own nearest centre
    largest = min(count, max(_MAX_SEARCHED, options.num_neighbours) + 1)
    size = min(largest, 4 * options.num_neighbours + 1)
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
            # an image whose neighbours look elsewhere searches further
            done = (rank[:, -1] >= options.num_neighbours) | ~np.isfinite(distance[:, -1])
            done |= size >= largest
            take = good & (rank <= options.num_neighbours) & done[:, None]
            rows, columns = np.nonzero(take)
            found.append(np.stack([part[rows], index[rows, columns]], axis=1))
            unfinished.append(part[~done])
        waiting = np.concatenate(unfinished)
        size = min(largest, 2 * size)
    return unique_pairs(np.concatenate(found))
