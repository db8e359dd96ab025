"""A map's points as arrays, a query's matches with them, and the pose problem that they make.

One view or the views of a rig are treated alike; each keypoints type has an index of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.values import Camera, RigidTransform

Floats = NDArray[np.float64]
Integers = NDArray[np.integer[Any]]
ImageMatches = tuple[str, NDArray[np.int64], NDArray[np.floating]]


@dataclass(frozen=True, eq=False)
class MapIndex:
    """Observations grouped by image; read-only, and safe to use from many threads.

    Attributes
    ----------
    xyz : float64 (N, 3), the points in the world frame.
    row_of_image : image name -> row of ``offsets``.
    offsets : int64 (I + 1,); image i's observations are rows offsets[i] to offsets[i + 1].
    keypoint_ids : int32 (O,), ascending within an image.
    point_ids : int32 (O,), rows of ``xyz``.
    covariances : float64 (N, 6) of the points as xx, xy, xz, yy, yz, zz in the map's unit squared,
        for a measurement noise of 1 px, NaN where unknown; None where the map has none.
    local_type : the keypoints type that it is of; empty where nobody asks.
    noise_rad, noise_px : median angle, and distance in the image, between an observation and its
        point, seen by the map's image; NaN where they are not known.
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
        """Group observations, given as parallel arrays (O,), by image and keypoint."""
        from megloc_kapture.localization import kernels

        counts = np.bincount(image_ids, minlength=len(image_names))
        offsets = np.zeros(len(image_names) + 1, dtype=np.int64)
        np.cumsum(counts, out=offsets[1:])
        keypoints = np.empty(len(image_ids), dtype=np.int32)
        points = np.empty(len(image_ids), dtype=np.int32)
        kernels.group_by_image(image_ids, keypoint_ids, point_ids, offsets, keypoints, points)
        return cls(
            xyz=_read_only(np.ascontiguousarray(xyz, dtype=np.float64)),
            row_of_image={name: row for row, name in enumerate(image_names)},
            offsets=_read_only(offsets),
            keypoint_ids=_read_only(keypoints),
            point_ids=_read_only(points),
            covariances=covariances,
        )

    @cached_property
    def seen_once(self) -> NDArray[np.bool_]:
        """Points (N,) that one image observes: lifted through its depth, not triangulated."""
        return np.bincount(self.point_ids, minlength=len(self.xyz)) == 1

    def observed(self, image: str) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Keypoint rows (ascending) and their point rows of one image; empty if it has none."""
        row = self.row_of_image.get(image)
        if row is None:
            return self.keypoint_ids[:0], self.point_ids[:0]
        part = slice(self.offsets[row], self.offsets[row + 1])
        return self.keypoint_ids[part], self.point_ids[part]

    def seen_by(self, images: Sequence[str]) -> Floats:
        """The points that some of the images observe, each once, (K, 3)."""
        seen = np.zeros(len(self.xyz), dtype=np.bool_)
        for image in images:
            seen[self.observed(image)[1]] = True
        return self.xyz[np.flatnonzero(seen)]

    def rows_of(self, images: Sequence[str]) -> NDArray[np.int64]:
        """Row of each image in ``offsets``, -1 where it is not in the map; int64 (n,)."""
        return np.array([self.row_of_image.get(image, -1) for image in images], dtype=np.int64)

    def shared_points(self, images: Sequence[str]) -> NDArray[np.int64]:
        """Number of points that every two of the images both observe, int64 (n, n), symmetric.

        The diagonal has the points that an image observes. The cost grows with these images'
        observations, not with the map; an image that is not in the map shares nothing.
        """
        from megloc_kapture.localization import kernels

        rows = self.rows_of(images)
        keys = kernels.sightings(self.offsets, self.point_ids, rows)
        keys.sort()
        shared = np.zeros((len(rows), len(rows)), dtype=np.int64)
        kernels.count_shared(keys, shared)
        return shared


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    """The array, not to be written to: also the one kind that the compiled loops then meet."""
    view = array.view()
    view.setflags(write=False)
    return view


@dataclass(frozen=True, eq=False)
class Correspondences:
    """2D-3D matches: every keypoint and every point at most once.

    Attributes
    ----------
    keypoint_ids, point_ids : int64 (N,), rows of the query's keypoints, ascending, and of the
        points.
    support : int64 (N,), number of map images that say so.
    image_rows : int64 (sum of support,), these images, match by match.
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
    seen_once: NDArray[np.bool_] | None = None,
) -> Correspondences:
    """One point per keypoint and one keypoint per point, of matches (M,) with conflicts and all.

    The same keypoint can meet several points through different map images, and the reverse. A point
    that several images observe comes before one that was lifted through one's depth (``seen_once``;
    None: there is none); then what most images say wins; then the best similarity, higher is
    better; then the smaller ids. Conflicts are settled greedily from the best on, so that a loser
    may still get its second choice. ``image_rows`` are the map images that the matches are with.
    """
    from megloc_kapture.localization import kernels

    if len(keypoint_ids) == 0:
        none = np.zeros(0, dtype=np.int64)
        return Correspondences(none, none, none, none)
    # both in one number: equals are the same pair, and their order does not matter
    order = np.argsort((keypoint_ids << 32) | point_ids)
    keypoints, points = keypoint_ids[order], point_ids[order]
    # every distinct pair once, sorted by keypoint, then point
    first = np.flatnonzero(np.diff(keypoints, prepend=-1) | np.diff(points, prepend=-1))
    best = np.maximum.reduceat(similarities[order], first)
    support = np.diff(first, append=len(order))
    keypoints, points = keypoints[first], points[first]
    worth = [-best, -support]
    if seen_once is not None:
        worth.append(seen_once[order][first])
    chosen = kernels.choose(
        np.lexsort(worth),
        np.cumsum(np.diff(keypoints, prepend=keypoints[0]) != 0),
        np.unique(points, return_inverse=True)[1],
    )
    return Correspondences(
        keypoints[chosen],
        points[chosen],
        support[chosen],
        image_rows[order][np.repeat(chosen, support)],
    )


@dataclass(frozen=True, eq=False)
class TypedMatches:
    """Matches of one query image in one keypoints type, and the map's points of the type.

    Of the query's keypoints, float32 (N, 2 or more), with each candidate: its name, rows of query
    and map keypoints (K, 2), scores (K,). A candidate that is not in the map has nothing to say.
    """

    index: MapIndex
    keypoints_px: NDArray[np.float32]
    matches: Sequence[tuple[str, Integers, NDArray[np.floating]]]

    @cached_property
    def observed(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats, NDArray[np.int64]]:
        """The matches whose map keypoint observes a point, conflicts and all.

        Rows of the query's keypoints and of the map's points, scores, and which of the candidates
        each is with; (M,) each.
        """
        from megloc_kapture.localization import kernels

        if not self.matches:
            empty = np.zeros(0, dtype=np.int64)
            return empty, empty, np.zeros(0), empty
        images, pairs, scores = zip(*self.matches, strict=True)
        starts = np.zeros(len(images) + 1, dtype=np.int64)
        np.cumsum([len(own) for own in pairs], out=starts[1:])
        index = self.index
        found: tuple[NDArray[np.int64], NDArray[np.int64], Floats, NDArray[np.int64]]
        found = kernels.observed(
            index.offsets,
            index.keypoint_ids,
            index.point_ids,
            index.rows_of(images),
            starts,
            np.concatenate(pairs, dtype=np.int64),
            np.concatenate(scores, dtype=np.float64),
        )
        return found

    def are_with(self, images: Sequence[str]) -> NDArray[np.bool_]:
        """Mask (M,) of the observed matches that are with some images."""
        members = set(images)
        asked = np.array([image in members for image, _, _ in self.matches], bool)
        return np.asarray(asked[self.observed[3]])

    def correspondences(self, images: Sequence[str] | None = None) -> Correspondences:
        """2D-3D matches, see :func:`resolve_conflicts`; only these images have a say, or all."""
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
    """One camera and its matches; a camera on its own is a rig of one, at its origin.

    Raises DataError where the arrays do not have these shapes.

    Attributes
    ----------
    points_px, points_world : float (N, 2) pixels, first pixel's centre at (0.5, 0.5), and float64
        (N, 3) the points that they are matched with.
    point_covariances : float64 (N, 6) of the points as xx, xy, xz, yy, yz, zz in the map's unit
        squared, for a measurement noise of 1 px, not finite where unknown; or None. An unknown
        covariance counts as none at all.
    """

    camera: Camera
    cam_from_rig: RigidTransform
    points_px: NDArray[np.floating[Any]]
    points_world: Floats
    point_covariances: Floats | None = None

    def __post_init__(self) -> None:
        count = len(self.points_px)
        if self.points_px.shape != (count, 2) or self.points_world.shape != (count, 3):
            raise DataError(
                f"pixels {self.points_px.shape} and points {self.points_world.shape} of a view "
                "are not (N, 2) and (N, 3)"
            )
        if self.point_covariances is not None and self.point_covariances.shape != (count, 6):
            raise DataError(
                f"covariances {self.point_covariances.shape} of {count} points are not ({count}, 6)"
            )


@dataclass(frozen=True, eq=False)
class PoseProblem:
    """The matches of a camera, or of all cameras of a rig, that its pose is estimated from.

    Attributes
    ----------
    points_px, points : float64 (N, 2) and (N, 3), the latter minus ``offset`` (3,), a point amid
        the others: far from the origin (ECEF) float64 loses what a recentred world keeps.
    covariances : float64 (N, 6), or (0, 6) where no view has any.
    starts : int64 (V + 1,) first match of each view.
    """

    views: tuple[View, ...]
    points_px: Floats
    points: Floats
    covariances: Floats
    starts: NDArray[np.int64]
    offset: Floats

    @classmethod
    def of(cls, views: Sequence[View]) -> PoseProblem:
        """The problem of any number of views, their matches in the same order."""
        starts = np.zeros(len(views) + 1, dtype=np.int64)
        np.cumsum([len(view.points_px) for view in views], out=starts[1:])
        world = _joined([view.points_world for view in views], 3)
        offset = _amid(world)
        given = [view.point_covariances for view in views]
        known = any(own is not None for own in given)
        covariances = [
            np.zeros((len(view.points_px), 6)) if own is None else own
            for view, own in zip(views, given, strict=True)
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
        """One part for each view of what runs over the matches of all views, as inliers (N,)."""
        return np.split(per_match, self.starts[1:-1])


def _joined(parts: Sequence[NDArray[np.floating[Any]]], width: int) -> Floats:
    return np.concatenate([np.zeros((0, width)), *parts], dtype=np.float64)


def _amid(points: Floats) -> Floats:
    # the median of some of them: any point nearby serves, and wrong points must not move it far
    some = points[:: max(1, len(points) // 64)]
    some = np.sort(some[np.isfinite(some).all(axis=1)], axis=0)
    return some[len(some) // 2] if len(some) else np.zeros(3)


def undo_recentring(pose: RigidTransform, offset: Floats) -> RigidTransform:
    """``rig_from_world`` of a pose in a world that was moved by minus ``offset`` (3,)."""
    t = np.array(pose.translation) - pose.rotation_matrix() @ offset
    return RigidTransform(pose.quat_wxyz, (float(t[0]), float(t[1]), float(t[2])))


@dataclass(frozen=True, eq=False)
class QueryView:
    """One camera of a query: its pose on the rig, and its matches by keypoints type."""

    name: str
    camera: Camera
    matches: tuple[TypedMatches, ...]
    cam_from_rig: RigidTransform = RigidTransform.identity()

    def matched_images(self) -> list[str]:
        """Map images with a match, in the order given."""
        named = (image for own in self.matches for image, pairs, _ in own.matches if len(pairs))
        return list(dict.fromkeys(named))

    def among(self, images: Sequence[str]) -> QueryView:
        """With its matches with these map images only."""
        members = set(images)
        kept = (
            replace(typed, matches=[one for one in typed.matches if one[0] in members])
            for typed in self.matches
        )
        return replace(self, matches=tuple(kept))

    def view(self, found: Sequence[Correspondences]) -> View:
        """The camera with its 2D-3D matches of all types, one after another."""
        pixels, points, covariances = [np.zeros((0, 2))], [np.zeros((0, 3))], [np.zeros((0, 6))]
        for typed, own in zip(self.matches, found, strict=True):
            pixels.append(typed.keypoints_px[own.keypoint_ids, :2].astype(np.float64))
            points.append(typed.index.xyz[own.point_ids])
            if typed.index.covariances is None:
                covariances.append(np.full((len(own.point_ids), 6), np.nan))
            else:
                covariances.append(np.asarray(typed.index.covariances[own.point_ids]))
        known = any(typed.index.covariances is not None for typed in self.matches)
        return View(
            camera=self.camera,
            cam_from_rig=self.cam_from_rig,
            points_px=np.concatenate(pixels),
            points_world=np.concatenate(points),
            point_covariances=np.concatenate(covariances) if known else None,
        )
