"""Which of the map's cameras a query's pose is compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.evaluation.check.reference import Reference
from megloc_kapture.io.side_tables import ImageGroup


@dataclass(frozen=True, eq=False)
class Pools:
    """Groups of the map's cameras, and for each pose its own.

    Parameters
    ----------
    members : positions of cameras, int64 (K,) each, K > 0.
    own : int64 (N,), each pose's pool: what its prior permits, else the cameras of its frame, else
        all cameras.
    other : int64 (N,), the pool of the frames that are not the pose's own; its own where there is
        none, or where nothing says which frame is its own.
    labels : per pool, its frames or locations in words.
    """

    members: tuple[NDArray[np.int64], ...]
    own: NDArray[np.int64]
    other: NDArray[np.int64]
    labels: tuple[str, ...]

    @property
    def has_other(self) -> NDArray[np.bool_]:
        """(N,) whether a pose has other frames that it could stand in by mistake."""
        return self.other != self.own


def pools_of(reference: Reference, queries: Sequence[str | None]) -> Pools:
    """The pools of poses of these queries; None is a pose of nobody knows which query.

    A prior that names single images permits, for this purpose, all cameras of their frames: a pose
    has to be near some of the map, not near the very images that retrieval was allowed.
    """
    if reference.cameras is None:
        raise ValueError("without a map there are no pools")
    images = reference.cameras.images
    default = ImageGroup()
    groups = [reference.groups.get(image, default) for image in images]
    by_name: dict[str, list[int]] = {}
    for position, group in enumerate(groups):
        for name in {group.location, group.frame} - {""}:
            by_name.setdefault(name, []).append(position)
    frames = sorted({group.frame for group in groups})
    frame_of = dict(zip(images, (group.frame for group in groups), strict=True))
    everything = tuple(frames)
    keys: dict[tuple[str, tuple[str, ...]], int] = {}
    members: list[NDArray[np.int64]] = []
    labels: list[str] = []

    def pool(kind: str, names: tuple[str, ...]) -> int:
        key = (kind, names)
        if key not in keys:
            if kind == "frames":
                found = [i for i, group in enumerate(groups) if group.frame in names]
            else:
                found = sorted({i for name in names for i in by_name[name]})
            keys[key] = len(members)
            members.append(np.array(found, dtype=np.int64))
            labels.append(", ".join(filter(None, names)))
        return keys[key]

    own, other = [], []
    for query in queries:
        names = () if query is None else tuple(_permitted(reference.priors, query, by_name))
        single = () if query is None else reference.priors.get(query, ())
        its_frames = {groups[i].frame for name in names for i in by_name[name]}
        its_frames |= {frame_of[name] for name in single if name in frame_of}
        if not its_frames and query is not None:
            group = reference.groups.get(query, default)
            its_frames = {name for name in (group.frame, group.condition) if name in frames} - {""}
        known = tuple(sorted(its_frames)) or everything
        own.append(pool("groups", names) if names else pool("frames", known))
        rest = tuple(frame for frame in frames if frame not in known)
        other.append(pool("frames", rest) if rest else own[-1])
    return Pools(tuple(members), np.array(own, np.int64), np.array(other, np.int64), tuple(labels))


def _permitted(
    priors: Mapping[str, Sequence[str]], query: str, by_name: Mapping[str, Sequence[int]]
) -> list[str]:
    """The groups of map images that a query's prior names; empty where it names images only."""
    return sorted(name for name in priors.get(query, ()) if name in by_name)
