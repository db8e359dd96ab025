"""Clusters of a query's candidates, each with a pose of its own.

MegLoc, section "Cluster-wise localization": retrieval returns images of several places that look
alike, and the matches of one place are outliers to the pose of another. So the retrieved images are
clustered by the proximity of their centres, whatever they look at, or by co-visibility, and each
cluster is localized in by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from megloc_kapture.localization.map_index import MapIndex
from megloc_kapture.values import Options


class ClusterOptions(Options):
    """Options of the clusters of a query's candidates."""

    by: Literal["none", "poses", "covisibility"] = Field(
        default="covisibility",
        description="none: all candidates are one cluster; poses: images whose centres are near; "
        "covisibility: images that see the same points",
    )
    radius: float | None = Field(
        default=None,
        gt=0,
        description="poses: centres this close, in the map's unit, belong together, and so do "
        "all that are joined by such steps",
    )
    min_shared_points: int = Field(
        default=10, gt=0, description="covisibility: images with so many points in common"
    )
    max_clusters: int = Field(
        default=10, gt=0, description="clusters tried, those with the most matches"
    )

    def idle(self) -> dict[str, str]:
        idle = {}
        if self.by != "poses":
            idle["radius"] = f"it is for clusters by poses, these are by {self.by}"
        if self.by != "covisibility":
            idle["min_shared_points"] = f"it is for covisibility, clusters are by {self.by}"
        return idle

    @model_validator(mode="after")
    def _has_scale(self) -> ClusterOptions:
        if self.by == "poses" and self.radius is None:
            raise ValueError("clusters by poses need a radius, in the map's unit")
        return self


def cluster_by_centers(centers: NDArray[np.float64], radius: float) -> NDArray[np.int64]:
    """Single linkage of centres (N, 3): labels int64 (N,), in the order of their first members."""
    if len(centers) == 0:
        return np.zeros(0, np.int64)
    pairs = cKDTree(centers).query_pairs(radius, output_type="ndarray")
    return _components(len(centers), pairs)


def cluster_by_shared_points(
    shared: NDArray[np.int64], min_shared_points: int
) -> NDArray[np.int64]:
    """Images joined by the points they share (N, N): labels int64 (N,), as of centres.

    Where no two images share a point at all (a map lifted from depth) co-visibility says nothing,
    and all are one cluster.
    """
    apart = shared - np.diag(np.diag(shared))
    if not apart.any():
        return np.zeros(len(shared), np.int64)
    return _components(len(shared), np.argwhere(np.triu(apart) >= min_shared_points))


def cluster_candidates(
    images: Sequence[str],
    frames: Sequence[str],
    options: ClusterOptions,
    *,
    centers: Mapping[str, NDArray[np.float64]],
    indices: Sequence[MapIndex],
) -> list[tuple[str, ...]]:
    """Divide candidates into clusters.

    Parameters
    ----------
    images : the candidates, best first.
    frames : the coordinate frame of each; different frames are never joined.
    centers : of the images in the world, (3,) each.
    indices : the map's points by keypoints type; shared points of all types add up.

    Returns
    -------
    Clusters in the order of their first members, images in the order given.
    """
    clusters: list[list[int]] = []
    for frame in dict.fromkeys(frames):
        members = [at for at, own in enumerate(frames) if own == frame]
        names = [images[at] for at in members]
        if options.by == "poses" and options.radius is not None:
            labels = cluster_by_centers(np.array([centers[name] for name in names]), options.radius)
        elif options.by == "covisibility":
            shared = sum(
                (index.shared_points(names) for index in indices),
                np.zeros((len(names), len(names)), np.int64),
            )
            labels = cluster_by_shared_points(shared, options.min_shared_points)
        else:
            labels = np.zeros(len(names), np.int64)
        clusters += [
            [members[at] for at in np.flatnonzero(labels == label)]
            for label in range(int(labels.max()) + 1 if len(labels) else 0)
        ]
    return [tuple(images[at] for at in cluster) for cluster in sorted(clusters)]


def _components(count: int, pairs: NDArray[np.integer]) -> NDArray[np.int64]:
    links = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _, labels = connected_components(links, directed=False)
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))
    return np.asarray(order[inverse], np.int64)
