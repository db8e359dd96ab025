"""The map's cameras around poses: in position, in orientation, and in height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.evaluation.check.reading import MapCameras, Reference
from megloc_kapture.geometry.poses import rotation_matrices
from megloc_kapture.io.dataset_tables import ImageGroup

# how many map cameras a pose's orientation is compared with: a panoramic scan has 36 of one centre
_NEIGHBOURS = 48
# a neighbour may be this much farther than the nearest: which one it is does not matter far away,
# and a tree finds it many times faster
_TREE_SLACK = 0.2
# cameras nearer to each other than this share of the extent stand together
_TOGETHER = 1 / 200
# this many spacings, or this share of the extent, from a map camera a pose is still near it
_NEAR_SPACINGS, _NEAR_EXTENT = 10.0, 0.1
# coordinates that no map has; their squares must not overflow
_INFINITE = 1e100
# orientations this near are alike, beyond the second all are equally unlike; what one counts
_ALIKE_DEG, _UNLIKE_DEG, _ANGLE_SCALE_DEG = 45.0, 90.0, 20.0
# the mean of the cameras' up directions is this long where most of them stand upright
_UPRIGHT = 0.8
# no ceiling is lower, and no two ways of holding a camera differ so much
_STOREY_M = 1.5
# this many times the map's own difference in height between neighbours, for this share of poses
_STOREY_HEIGHTS, _STOREY_SHARE, _STOREY_NEIGHBOURS = 4.0, 0.6, 8


@dataclass(frozen=True, eq=False)
class CameraSets:
    """Sets of the map's cameras, and for each pose the one it is compared with.

    Parameters
    ----------
    members : positions of cameras, int64 (K,) each, K > 0.
    own : int64 (N,), each pose's set: what its prior permits, else the cameras of its frame, else
        all cameras.
    other : int64 (N,), the set of the frames that are not the pose's own; its own where there is
        none, or where nothing says which frame is its own.
    labels : per set, its frames or locations in words.
    """

    members: tuple[NDArray[np.int64], ...]
    own: NDArray[np.int64]
    other: NDArray[np.int64]
    labels: tuple[str, ...]

    @property
    def has_other(self) -> NDArray[np.bool_]:
        """(N,) whether a pose has other frames that it could stand in by mistake."""
        return self.other != self.own


def camera_sets(
    reference: Reference, cameras: MapCameras, queries: Sequence[str | None]
) -> CameraSets:
    """The sets that poses of these queries are compared with; None: the query is unknown.

    A prior that names single images permits, for this purpose, all cameras of their frames: a pose
    has to be near some of the map, not near the very images that retrieval was allowed.
    """
    default = ImageGroup()
    groups = [reference.groups.get(image, default) for image in cameras.images]
    by_name: dict[str, list[int]] = {}
    for position, group in enumerate(groups):
        for name in {group.location, group.frame} - {""}:
            by_name.setdefault(name, []).append(position)
    frames = sorted({group.frame for group in groups})
    frame_of = {image: group.frame for image, group in zip(cameras.images, groups, strict=True)}
    # names of groups, or of frames -> number of the set, its members
    sets: dict[tuple[bool, tuple[str, ...]], tuple[int, list[int]]] = {}

    def number_of(names: tuple[str, ...], *, of_frames: bool) -> int:
        if (of_frames, names) not in sets:
            found = [i for i, group in enumerate(groups) if group.frame in names]
            if not of_frames:
                found = sorted({i for name in names for i in by_name[name]})
            sets[of_frames, names] = (len(sets), found)
        return sets[of_frames, names][0]

    own, other = [], []
    for query in queries:
        permitted = () if query is None else reference.priors.get(query, ())
        names = tuple(sorted(name for name in permitted if name in by_name))
        of_query = {groups[i].frame for name in names for i in by_name[name]}
        of_query |= {frame_of[name] for name in permitted if name in frame_of}
        if not of_query and query is not None:
            group = reference.groups.get(query, default)
            of_query = ({group.frame, group.condition} & set(frames)) - {""}
        known = tuple(sorted(of_query)) or tuple(frames)
        own.append(number_of(names or known, of_frames=not names))
        rest = tuple(frame for frame in frames if frame not in known)
        other.append(number_of(rest, of_frames=True) if rest else own[-1])
    return CameraSets(
        tuple(np.array(members, dtype=np.int64) for _, members in sets.values()),
        np.array(own, np.int64),
        np.array(other, np.int64),
        tuple(", ".join(filter(None, names)) for _, names in sets),
    )


@dataclass(frozen=True, eq=False)
class Nearness:
    """N poses among the map's cameras.

    Parameters
    ----------
    distance : float64 (N,), to the nearest camera, in the map's unit; infinite without any.
    score : float64 (N,), how well each pose fits: 0 is best. It is that of the map camera which is
        most alike, in distance and orientation together, and falls with the logarithm of both.
        Distances count in spacings of the map's cameras, so that a table top and a city are alike.
    fits : bool (N,), whether a camera that is near looks alike.
    near : float64 (N,), the distance up to which a camera of its set is near.
    extent : float64 (N,), of the cameras of its set.
    """

    distance: NDArray[np.float64]
    score: NDArray[np.float64]
    fits: NDArray[np.bool_]
    near: NDArray[np.float64]
    extent: NDArray[np.float64]


class Neighbourhood:
    """The map's cameras by sets: each pose is compared with the cameras of its set only.

    The spacing of a set is the median distance from a camera to the next, where cameras that stand
    together (a rig, a panoramic scan) are one; infinite where there is only one.

    Parameters
    ----------
    cameras : of the map.
    sets : positions in ``cameras``, int64 (K,) each, K > 0.
    """

    def __init__(self, cameras: MapCameras, sets: Sequence[NDArray[np.int64]]) -> None:
        self._rows = np.concatenate(sets)
        self._set_of_row = np.repeat(np.arange(len(sets)), [len(own) for own in sets])
        self._quats, self._centers = cameras.quats, cameras.centers
        # sets lie apart in a fourth dimension, so that one tree and one call serve all of them
        size = float(np.ptp(cameras.centers, axis=0).max()) if len(cameras.centers) else 0.0
        self._gap = 1e4 * (size or 1.0)
        centers = cameras.centers[self._rows]
        self._tree = cKDTree(np.column_stack([centers, self._set_of_row * self._gap]))
        scales = [_scales(cameras.centers[own]) for own in sets]
        self.spacing, self.near, self.extent = np.array(scales).T

    def look(
        self, quats: NDArray[np.float64], centers: NDArray[np.float64], sets: NDArray[np.int64]
    ) -> Nearness:
        """Compare poses with the cameras of their sets.

        Parameters
        ----------
        quats, centers : float64 (N, 4) and (N, 3), of ``cam_from_local``; a centre that is not
            finite is infinitely far.
        sets : int64 (N,).
        """
        count = min(_NEIGHBOURS, len(self._rows))
        with np.errstate(invalid="ignore"):
            finite = np.abs(centers).max(axis=1, initial=0.0) < _INFINITE
        centers = np.where(finite[:, None], centers, 0.0)
        apart = np.column_stack([centers, sets * self._gap])
        _, found = self._tree.query(apart, k=np.arange(1, count + 1), eps=_TREE_SLACK)
        same = (self._set_of_row[found] == sets[:, None]) & finite[:, None]
        cameras = self._rows[found]
        offsets = self._centers[cameras] - centers[:, None]
        distance = np.where(same, np.linalg.norm(offsets, axis=2), np.inf)
        cosine = np.abs(np.einsum("nkd,nd->nk", self._quats[cameras], quats))
        angle_deg = np.rad2deg(2.0 * np.arccos(np.minimum(cosine, 1.0)))
        near = self.near[sets]
        turned = np.log1p((np.minimum(angle_deg, _UNLIKE_DEG) / _ANGLE_SCALE_DEG) ** 2)
        with np.errstate(invalid="ignore"):
            spacings = np.where(same, distance / self.spacing[sets, None], np.inf)
        score = (-np.log1p(spacings) - turned).max(axis=1)
        alike = same & (distance <= near[:, None]) & (angle_deg <= _ALIKE_DEG)
        return Nearness(distance.min(axis=1), score, alike.any(axis=1), near, self.extent[sets])


def _scales(centers: NDArray[np.float64]) -> tuple[float, float, float]:
    """Spacing, the distance that is near, and the extent of the cameras of one set."""
    extent = float(np.quantile(np.linalg.norm(centers - np.median(centers, axis=0), axis=1), 0.9))
    if extent > 0.0:
        apart = _one_of_each(centers, extent)
        if len(apart) > 1:
            spacing = float(np.median(cKDTree(apart).query(apart, k=2)[0][:, 1]))
            return spacing, max(_NEAR_SPACINGS * spacing, _NEAR_EXTENT * extent), extent
    return np.inf, np.inf, np.inf


def _one_of_each(centers: NDArray[np.float64], extent: float) -> NDArray[np.float64]:
    """Centres with one left of those that stand together, or each would be its own neighbour."""
    grid = extent * _TOGETHER
    return np.unique(np.round(centers / grid), axis=0) * grid


def storey_offset(cameras: MapCameras, centers: NDArray[np.float64]) -> float | None:
    """Height that most poses have above the map's cameras around them, where it is a storey's.

    Parameters
    ----------
    cameras : of the map, in metres.
    centers : float64 (N, 3), of the poses, in the same frame.

    Returns
    -------
    Metres, negative below; None where the heights are usual, or where the map does not say which
    way is up.
    """
    up = -rotation_matrices(cameras.quats)[:, 1, :].mean(axis=0)
    length = float(np.linalg.norm(up))
    centers = centers[np.isfinite(centers).all(axis=1) & (np.abs(centers) < _INFINITE).all(axis=1)]
    if length < _UPRIGHT or not len(centers):
        return None
    up /= length
    # two directions that lie level
    level = np.linalg.svd(up[None])[2][1:].T
    middle = np.median(cameras.centers, axis=0)
    own, given = cameras.centers - middle, centers - middle
    extent = float(np.quantile(np.linalg.norm(own, axis=1), 0.9))
    if not extent > 0:
        return None
    own = _one_of_each(own, extent)
    count = min(_STOREY_NEIGHBOURS, len(own) - 1)
    if count < 1:
        return None
    tree, heights = cKDTree(own @ level), own @ up
    _, found = tree.query(own @ level, k=np.arange(1, count + 2))
    usual = np.quantile(np.abs(heights[found[:, 1:]] - heights[:, None]).min(axis=1), 0.9)
    distance, found = tree.query(given @ level, k=np.arange(1, count + 1))
    near = distance[:, 0] <= extent
    if not near.any():
        return None
    differences = (given @ up)[:, None] - heights[found]
    nearest = np.abs(differences).argmin(axis=1)
    above = differences[np.arange(len(nearest)), nearest][near]
    offset = float(np.median(above))
    alike = np.abs(above - offset) < 0.5 * abs(offset)
    least = max(_STOREY_M, _STOREY_HEIGHTS * float(usual))
    if abs(offset) < least or alike.mean() * near.mean() < _STOREY_SHARE:
        return None
    return offset
