"""Arrays of a map's points, 2D-3D matches of a query, and the resulting pose problem."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from megloc_kapture.values import Camera, RigidTransform

Floats = NDArray[np.float64]
Integers = NDArray[np.integer[Any]]
ImageMatches = tuple[str, NDArray[np.int64], NDArray[np.floating]]


@dataclass(frozen=True, eq=False)
class MapIndex:
    """Observations grouped by image; never changed, as several threads use them.

    Attributes
    ----------
    xyz : float64 (N, 3), points in the world.
    row_of_image : row of ``offsets`` by image name.
    offsets : int64 (I + 1,); rows offsets[i] to offsets[i + 1] are image i's observations.
    keypoint_ids, point_ids : int32 (O,), within an image sorted by keypoint, then point.
    covariances : float64 (N, 6) as xx, xy, xz, yy, yz, zz for a noise of 1 px, NaN if unknown; or
        None.
    noise_rad, noise_px : median reprojection error of the map as an angle and in pixels; NaN if
        unknown.
    """

    xyz: Floats
    row_of_image: dict[str, int]
    offsets: NDArray[np.int64]
    keypoint_ids: NDArray[np.int32]
    point_ids: NDArray[np.int32]
    covariances: Floats | None = None
    local_type: str = ""
    noise_rad: float = math.nan
    noise_px: float = math.nan

    @classmethod
    def build(
        cls,
        xyz: Floats,
        image_names: tuple[str, ...],
        image_ids: Integers,
        keypoint_ids: Integers,
        point_ids: Integers,
        covariances: Floats | None = None,
    ) -> MapIndex:
        """Group observations, parallel arrays (O,), by image and keypoint."""
        counts = np.bincount(image_ids, minlength=len(image_names))
        offsets = np.zeros(len(image_names) + 1, dtype=np.int64)
        np.cumsum(counts, out=offsets[1:])
        keys = _paired(keypoint_ids, point_ids)[np.argsort(image_ids, kind="stable")]
        for first, last in pairwise(offsets.tolist()):
            keys[first:last].sort()
        return cls(
            xyz=np.ascontiguousarray(xyz, dtype=np.float64),
            row_of_image={name: row for row, name in enumerate(image_names)},
            offsets=offsets,
            keypoint_ids=(keys >> 32).astype(np.int32),
            point_ids=(keys & 0xFFFFFFFF).astype(np.int32),
            covariances=covariances,
        )

    @cached_property
    def seen_once(self) -> NDArray[np.bool_]:
        """Return a mask (N,) of points with one observation: from depth, not triangulation."""
        return np.bincount(self.point_ids, minlength=len(self.xyz)) == 1

    def observed(self, image: str) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return keypoint rows (ascending) and point rows of an image; empty for unknown images."""
        row = self.row_of_image.get(image)
        if row is None:
            return self.keypoint_ids[:0], self.point_ids[:0]
        part = slice(self.offsets[row], self.offsets[row + 1])
        return self.keypoint_ids[part], self.point_ids[part]

    def seen_by(self, images: Sequence[str]) -> Floats:
        """Return the points (K, 3) that at least one of the images observes."""
        seen = np.zeros(len(self.xyz), dtype=np.bool_)
        for image in images:
            seen[self.observed(image)[1]] = True
        return self.xyz[np.flatnonzero(seen)]

    def shared_points(self, images: Sequence[str]) -> NDArray[np.int64]:
        """Count the points that pairs of images share, int64 (n, n).

        The diagonal has the number of points of each image.
        """
        seen_by = [np.unique(self.observed(image)[1]) for image in images]
        rows = np.repeat(np.arange(len(images)), [len(points) for points in seen_by])
        points = np.concatenate([self.point_ids[:0], *seen_by])
        sees = csr_array(
            (np.ones(len(rows), np.int64), (rows, points)), shape=(len(images), len(self.xyz))
        )
        return np.asarray((sees @ sees.T).toarray())


def _paired(high: Integers, low: Integers) -> NDArray[np.int64]:
    """Pack two indices of 31 bits into one number, for faster sorting."""
    return (high.astype(np.int64) << 32) | low


@dataclass(frozen=True, eq=False)
class Correspondences:
    """2D-3D matches with unique keypoints and points.

    Attributes
    ----------
    keypoint_ids, point_ids : int64 (N,), rows of the query's keypoints, ascending, and of the map
        points.
    support : int64 (N,), number of map images that contribute the match.
    image_rows : int64 (sum of support,), these images as indices into ``TypedMatches.matches``,
        grouped by match.
    """

    keypoint_ids: NDArray[np.int64]
    point_ids: NDArray[np.int64]
    support: NDArray[np.int64]
    image_rows: NDArray[np.int64]


def resolve_conflicts(
    keypoint_ids: NDArray[np.int64],
    point_ids: NDArray[np.int64],
    similarities: Floats,
    image_rows: NDArray[np.int64],
    seen_once: NDArray[np.bool_],
) -> Correspondences:
    """Select one point per keypoint and one keypoint per point from conflicting matches (M,).

    The selection is greedy. Triangulated points come before points with a single observation, which
    are from depth (``seen_once``); then matches are sorted by the number of map images that give
    them (``image_rows``), by similarity and by ids.
    """
    order = np.argsort(_paired(keypoint_ids, point_ids))
    keypoints, points = keypoint_ids[order], point_ids[order]
    # distinct pairs, sorted by keypoint, then point
    first = np.flatnonzero(np.diff(keypoints, prepend=-1) | np.diff(points, prepend=-1))
    best = np.maximum.reduceat(similarities[order], first)
    support = np.diff(first, append=len(order))
    keypoints, points = keypoints[first], points[first]
    ranked = np.lexsort((-best, -support, seen_once[order][first]))
    chosen = np.zeros(len(ranked), np.bool_)
    used_keypoints: set[int] = set()
    used_points: set[int] = set()
    pairs = zip(keypoints[ranked].tolist(), points[ranked].tolist(), strict=True)
    for row, (keypoint, point) in zip(ranked.tolist(), pairs, strict=True):
        if keypoint not in used_keypoints and point not in used_points:
            used_keypoints.add(keypoint)
            used_points.add(point)
            chosen[row] = True
    return Correspondences(
        keypoints[chosen],
        points[chosen],
        support[chosen],
        image_rows[order][np.repeat(chosen, support)],
    )


@dataclass(frozen=True, eq=False)
class TypedMatches:
    """Matches of one query image in one keypoints type.

    ``keypoints_px`` float32 (N, 2 or more) are the query's. ``matches`` has, for each candidate,
    the name of the map image, rows of query and map keypoints (K, 2), and scores (K,).
    """

    index: MapIndex
    keypoints_px: NDArray[np.float32]
    matches: Sequence[tuple[str, Integers, NDArray[np.floating]]]

    @cached_property
    def observed(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats, NDArray[np.int64]]:
        """Return the matches of map keypoints that have a map point, conflicts included.

        The arrays (M,) are query keypoint rows, point rows, scores and candidate indices.
        """
        empty = np.zeros(0, dtype=np.int64)
        rows, points, similarities, candidates = [empty], [empty], [np.zeros(0)], [empty]
        for candidate, (image, pairs, scores) in enumerate(self.matches):
            keypoint_ids, point_ids = self.index.observed(image)
            at = np.searchsorted(keypoint_ids, pairs[:, 1])
            known = at < len(keypoint_ids)
            known[known] = keypoint_ids[at[known]] == pairs[known, 1]
            rows.append(pairs[known, 0].astype(np.int64))
            points.append(point_ids[at[known]].astype(np.int64))
            similarities.append(scores[known].astype(np.float64))
            candidates.append(np.full(len(rows[-1]), candidate))
        return (
            np.concatenate(rows),
            np.concatenate(points),
            np.concatenate(similarities),
            np.concatenate(candidates),
        )

    def are_with(self, images: Sequence[str]) -> NDArray[np.bool_]:
        """Return a mask (M,) of the observed matches with any of these images."""
        members = set(images)
        asked = np.array([image in members for image, _, _ in self.matches], bool)
        return np.asarray(asked[self.observed[3]])

    def correspondences(self, images: Sequence[str] | None = None) -> Correspondences:
        """Return 2D-3D matches with some or all images; see :func:`resolve_conflicts`."""
        taken: Any = slice(None) if images is None else self.are_with(images)
        keypoint_ids, point_ids, similarities, image_rows = self.observed
        return resolve_conflicts(
            keypoint_ids[taken],
            point_ids[taken],
            similarities[taken],
            image_rows[taken],
            self.index.seen_once[point_ids[taken]],
        )


@dataclass(frozen=True, eq=False)
class View:
    """One camera of a rig and its matches; a single camera is a rig of one.

    Attributes
    ----------
    points_px, points_world : float (N, 2), the first pixel's centre is (0.5, 0.5); float64 (N, 3).
    point_covariances : float64 (N, 6), see :class:`MapIndex`; None or not finite counts as zero.
    """

    camera: Camera
    cam_from_rig: RigidTransform
    points_px: NDArray[np.floating[Any]]
    points_world: Floats
    point_covariances: Floats | None = None


@dataclass(frozen=True, eq=False)
class PoseProblem:
    """The matches of all cameras of a rig.

    Attributes
    ----------
    points_px, points : float64 (N, 2) and (N, 3), the latter minus ``offset`` (3,): float64 loses
        digits far from the origin (ECEF).
    covariances : float64 (N, 6), or (0, 6) if all are unknown.
    starts : int64 (V + 1,), first match of each view.
    """

    views: tuple[View, ...]
    points_px: Floats
    points: Floats
    covariances: Floats
    starts: NDArray[np.int64]
    offset: Floats

    @classmethod
    def of(cls, views: Sequence[View]) -> PoseProblem:
        starts = np.zeros(len(views) + 1, dtype=np.int64)
        np.cumsum([len(view.points_px) for view in views], out=starts[1:])
        world = _joined([view.points_world for view in views], 3)
        offset = _amid(world)
        given = [view.point_covariances for view in views]
        known = any(covariance is not None for covariance in given)
        covariances = [
            np.zeros((len(view.points_px), 6)) if covariance is None else covariance
            for view, covariance in zip(views, given, strict=True)
            if known
        ]
        return cls(
            views=tuple(views),
            points_px=_joined([view.points_px for view in views], 2),
            points=world - offset,
            covariances=_joined(covariances, 6),
            starts=starts,
            offset=offset,
        )

    def split(self, per_match: NDArray[Any]) -> list[NDArray[Any]]:
        """Split an array over all matches into one part per view."""
        return np.split(per_match, self.starts[1:-1])


def _joined(parts: Sequence[NDArray[np.floating[Any]]], width: int) -> Floats:
    return np.concatenate([np.zeros((0, width)), *parts], dtype=np.float64)


def _amid(points: Floats) -> Floats:
    # the median of a subset: any point nearby will do, and outliers must not move it far
    some = points[:: max(1, len(points) // 64)]
    some = np.sort(some[np.isfinite(some).all(axis=1)], axis=0)
    return some[len(some) // 2] if len(some) else np.zeros(3)


def undo_recentring(pose: RigidTransform, offset: Floats) -> RigidTransform:
    """Return ``rig_from_world`` for a pose in a world that was moved by minus ``offset`` (3,)."""
    t = np.array(pose.translation) - pose.rotation_matrix() @ offset
    return RigidTransform(pose.quat_wxyz, (float(t[0]), float(t[1]), float(t[2])))


@dataclass(frozen=True, eq=False)
class QueryView:
    """One camera of a query with its pose in the rig and its matches by keypoints type."""

    name: str
    camera: Camera
    matches: tuple[TypedMatches, ...]
    cam_from_rig: RigidTransform = RigidTransform.identity()

    def matched_images(self) -> list[str]:
        """Return the map images with matches, in the given order."""
        named = (image for typed in self.matches for image, pairs, _ in typed.matches if len(pairs))
        return list(dict.fromkeys(named))

    def among(self, images: Sequence[str]) -> QueryView:
        """Keep the matches with these map images only."""
        members = set(images)
        kept = (
            replace(typed, matches=[pair for pair in typed.matches if pair[0] in members])
            for typed in self.matches
        )
        return replace(self, matches=tuple(kept))

    def view(self, correspondences: Sequence[Correspondences]) -> View:
        """Return the camera with its 2D-3D matches, all types concatenated."""
        pixels, points, covariances = [np.zeros((0, 2))], [np.zeros((0, 3))], [np.zeros((0, 6))]
        for typed, of_type in zip(self.matches, correspondences, strict=True):
            pixels.append(typed.keypoints_px[of_type.keypoint_ids, :2].astype(np.float64))
            points.append(typed.index.xyz[of_type.point_ids])
            if typed.index.covariances is None:
                covariances.append(np.full((len(of_type.point_ids), 6), np.nan))
            else:
                covariances.append(np.asarray(typed.index.covariances[of_type.point_ids]))
        known = any(typed.index.covariances is not None for typed in self.matches)
        return View(
            camera=self.camera,
            cam_from_rig=self.cam_from_rig,
            points_px=np.concatenate(pixels),
            points_world=np.concatenate(points),
            point_covariances=np.concatenate(covariances) if known else None,
        )
