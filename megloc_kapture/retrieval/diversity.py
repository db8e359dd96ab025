"""A ranking that does not spend itself on near-duplicates of one place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.values import Options


class DiversityOptions(Options):
    """When two map images are views of one place, and how many such a ranking may have."""

    max_per_place: int = Field(default=3, gt=0, description="images within radius and angle")
    radius: float = Field(default=2.0, gt=0, description="of camera centres, unit of the map")
    angle_deg: float = Field(default=30.0, gt=0, le=180, description="between viewing directions")


def diversified(
    ranking: NDArray[np.int64],
    centers: NDArray[np.float64],
    directions: NDArray[np.float64],
    top_k: int,
    options: DiversityOptions,
) -> NDArray[np.int64]:
    """Positions in a ranking of the images to keep, in its order.

    Greedy: an image is passed over when ``max_per_place`` of those kept are near it. Passed-over
    images fill what is left of ``top_k`` in the end, so no place in the ranking stays empty.

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
