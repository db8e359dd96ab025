"""A query's cameras with their matches, and the 2D-3D matches that a cluster of map images gives.

One view or the views of a rig are treated alike; each keypoints type has an index of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.localization.confidence import MatchSources
from megloc_kapture.localization.estimation import View
from megloc_kapture.localization.map_index import Correspondences, MapIndex, ObservedMatches
from megloc_kapture.values import Camera, RigidTransform

ImageMatches = tuple[str, NDArray[np.int64], NDArray[np.floating]]


@dataclass(frozen=True, eq=False)
class TypedMatches:
    """Matches of one query image in one keypoints type.

    Attributes
    ----------
    index : the map's points of the type.
    keypoints_px : float32 (N, 2 or more), of the query.
    matches : of each candidate: its name, rows of query and map keypoints (K, 2), scores (K,).
    """

    index: MapIndex
    keypoints_px: NDArray[np.float32]
    matches: Sequence[ImageMatches]


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


def rows_of_images(typed: TypedMatches, cluster: Sequence[str]) -> NDArray[np.bool_]:
    """Which of the candidates are in a cluster."""
    members = set(cluster)
    return np.array([image in members for image, _, _ in typed.matches], bool)


def num_observed(
    views: Sequence[QueryView],
    gathered: Sequence[Sequence[ObservedMatches]],
    cluster: Sequence[str],
) -> int:
    """Matches of a cluster's images with keypoints of points."""
    total = 0
    for view, own in zip(views, gathered, strict=True):
        for typed, observed in zip(view.matches, own, strict=True):
            if len(typed.matches):
                total += int(rows_of_images(typed, cluster)[observed.image_rows].sum())
    return total


def view_of(view: QueryView, found: Sequence[Correspondences]) -> View:
    """The 2D-3D matches of one camera, types one after another."""
    pixels, points, covariances = [np.zeros((0, 2))], [np.zeros((0, 3))], [np.zeros((0, 6))]
    known = False
    for typed, own in zip(view.matches, found, strict=True):
        pixels.append(typed.keypoints_px[own.keypoint_ids, :2].astype(np.float64))
        points.append(typed.index.xyz[own.point_ids])
        if typed.index.covariances is None:
            covariances.append(np.full((len(own.point_ids), 6), np.nan))
        else:
            known = True
            covariances.append(np.asarray(typed.index.covariances[own.point_ids]))
    return View(
        camera=view.camera,
        cam_from_rig=view.cam_from_rig,
        points_px=np.concatenate(pixels),
        points_world=np.concatenate(points),
        point_covariances=np.concatenate(covariances) if known else None,
    )


def match_sources(
    views: Sequence[QueryView],
    found: Sequence[Sequence[Correspondences]],
    cluster: Sequence[str],
    centers: Mapping[str, NDArray[np.float64]],
) -> MatchSources:
    """Where the matches of a cluster come from, and what its images see."""
    number = {image: at for at, image in enumerate(cluster)}
    center_of = np.array([centers[image] for image in cluster]).reshape(-1, 3)
    support, images, seen = [], [], []
    noise: list[NDArray[np.float64]] = []
    for view, of_types in zip(views, found, strict=True):
        for typed, own in zip(view.matches, of_types, strict=True):
            rows = np.array([number.get(image, -1) for image, _, _ in typed.matches], np.int64)
            support.append(own.support)
            images.append(rows[own.image_rows])
            index = typed.index
            noise.append(np.tile([index.noise_rad, index.noise_px], (len(own.support), 1)))
        seen.append(
            np.concatenate([np.zeros((0, 3)), *(m.index.seen_by(cluster) for m in view.matches)])
        )
    rows_of_images = np.concatenate(images)
    return MatchSources(
        support=np.concatenate(support),
        centers=center_of[rows_of_images],
        images=rows_of_images,
        num_keypoints=sum(len(m.keypoints_px) for view in views for m in view.matches),
        noise=np.concatenate(noise),
        seen=seen,
        local_types={own.index.local_type for view in views for own in view.matches},
    )
