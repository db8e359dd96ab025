"""Rankers of candidate poses: by inliers, or by the image distance to warped map images.

MegLoc, section "Cluster-wise localization", indoor strategy: a view is rendered at each cluster's
pose, and the pose whose view is most similar to the query wins. ``perceptual`` warps the view from
the cluster's map images with depth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from megloc_kapture.geometry.cameras import project
from megloc_kapture.geometry.warping import PosedImage, WarpedView, image_with_depth, warp_to_view
from megloc_kapture.plugin_loading import NetworkOptions, load_chosen, weights_of
from megloc_kapture.plugins import (
    IMAGE_DISTANCES,
    ImageDistance,
    PluginChoice,
    PoseHypothesis,
    RankingScene,
)
from megloc_kapture.values import Camera, RigidTransform

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
_Compared = tuple[NDArray[np.uint8], WarpedView]

# inliers of two hypotheses within this radius, as a share of the image's longer side, count as the
# same; an inlier of n hypotheses counts 1 / n ** _POWER (docs/experiments/clusters.md)
_RADIUS, _POWER = 0.03, 4.0
# map images with depth per view; their number bounds the time
_REFERENCES = 5
_ANOTHER_VIEW = 0.2  # views that differ by less are near duplicates, see _nearest_first
_LONG_SIDE_PX = 320  # longer side of the compared views, which are never enlarged
# clusters with fewer inliers than this share of the largest number are not compared
_MIN_INLIER_SHARE = 0.05
_MIN_VALID = 0.15  # smallest share of the query's pixels that must be comparable
_FINALISTS = 6  # number of clusters that are compared in pairs


class InlierCount:
    """Plugin ``inliers``: the number of inliers."""

    def score(self, hypotheses: Sequence[PoseHypothesis], scene: RankingScene) -> Floats:
        return np.array(
            [sum(int(view.inliers.sum()) for view in each.views) for each in hypotheses],
            dtype=np.float64,
        )


class DistinctiveInliers:
    """Plugin ``distinctive``: inliers weighted by how few hypotheses explain them.

    Similar rooms all explain the query's walls and furniture. An inlier has the weight ``1 / n **
    4``, with ``n`` the number of hypotheses that have an inlier within a radius (after the
    geometric bursts of Sattler et al., CVPR 2016). Two hypotheses do not compete if one explains
    the other's inliers.
    """

    def score(self, hypotheses: Sequence[PoseHypothesis], scene: RankingScene) -> Floats:
        scores = np.zeros(len(hypotheses))
        same = [[poses_agree(a, b) for b in hypotheses] for a in hypotheses]
        for number in range(len(hypotheses[0].views) if hypotheses else 0):
            views = [hypothesis.views[number] for hypothesis in hypotheses]
            camera = views[0].camera
            radius_px = max(_RADIUS * max(camera.width, camera.height), 1e-3)
            inliers = [view.points_px[view.inliers] for view in views]
            trees = [cKDTree(points) for points in inliers]
            for at, points in enumerate(inliers):
                explaining = np.ones(len(points))
                for other, tree in enumerate(trees):
                    if other != at and not same[at][other]:
                        explaining += np.isfinite(
                            tree.query(points, distance_upper_bound=radius_px)[0]
                        )
                scores[at] += float((explaining**-_POWER).sum())
        return scores


def poses_agree(first: PoseHypothesis, second: PoseHypothesis) -> bool:
    """Return True if one pose explains at least half of the other's inliers."""
    return _explains(first, second) or _explains(second, first)


def _explains(this: PoseHypothesis, other: PoseHypothesis) -> bool:
    close = total = 0
    for view, others in zip(this.views, other.views, strict=True):
        points, pixels = others.points_world[others.inliers], others.points_px[others.inliers]
        errors = np.linalg.norm(project(view.camera, view.cam_from_world, points) - pixels, axis=1)
        close += int((errors <= this.max_error_px).sum())
        total += len(points)
    return 2 * close >= total


class PerceptualOptions(NetworkOptions):
    distance: PluginChoice = Field(
        default=PluginChoice(name="structure"),
        description="distance of two aligned images: structure, lpips, or a plugin",
    )


class PerceptualRanker:
    """Plugin ``perceptual``: image distance between the query and the map warped to its pose.

    Only clusters with enough inliers take part. The clusters with the smallest distances, the
    finalists, are compared pairwise over the pixels valid in both, since distances over different
    image parts are not comparable; a finalist's score is its mean margin. The remaining clusters
    follow by their distance, then those without depth or with few inliers. If the cluster that
    ``distinctive`` ranks first is not compared, the scores of ``distinctive`` are returned.
    """

    Options = PerceptualOptions

    def __init__(self, options: PerceptualOptions | None = None) -> None:
        self.options = options or PerceptualOptions()
        placement = NetworkOptions(
            device=self.options.device, half_precision=self.options.half_precision
        )
        self._distance: ImageDistance = load_chosen(
            IMAGE_DISTANCES, self.options.distance, placement
        )

    def plugins(self) -> tuple[object, ...]:
        return (self._distance,)

    def weights(self) -> dict[str, str]:
        return weights_of(self._distance)

    def score(self, hypotheses: Sequence[PoseHypothesis], scene: RankingScene) -> Floats:
        if len(hypotheses) < 2:
            return np.zeros(len(hypotheses))
        otherwise = DistinctiveInliers().score(hypotheses, scene)
        inliers = InlierCount().score(hypotheses, scene)
        enough = _MIN_INLIER_SHARE * inliers.max()
        read = cache(scene.query_image), cache(partial(image_with_depth, scene=scene))
        compared = [
            self._views(each, scene, *read) if count >= enough else []
            for each, count in zip(hypotheses, inliers, strict=True)
        ]
        distances = np.array(
            [self._mean_distance(v, [warped.valid for _, warped in v]) for v in compared]
        )
        compared_rows = np.flatnonzero(np.isfinite(distances))
        if not np.isfinite(distances[int(np.argmax(otherwise))]):
            return otherwise
        by_own = compared_rows[np.argsort(distances[compared_rows], kind="stable")]
        scores = np.full(len(distances), -np.inf)
        finalists = by_own[:_FINALISTS]
        scores[finalists] = self._against_each_other(
            [compared[at] for at in finalists], distances, finalists
        )
        rest = by_own[_FINALISTS:]
        scores[rest] = scores[finalists].min() - distances[rest]
        untold = ~np.isfinite(distances)
        scores[untold] = scores[compared_rows].min() - 1.0 - 1.0 / (1.0 + otherwise[untold])
        return scores

    def _views(
        self,
        hypothesis: PoseHypothesis,
        scene: RankingScene,
        query_image: Callable[[str], NDArray[np.uint8]],
        source_of: Callable[[str], PosedImage | None],
    ) -> list[_Compared]:
        """Return the query image and the map warped into it, at reduced size, for each view."""
        views = []
        for view in hypothesis.views:
            place = view.camera, view.cam_from_world
            warped = aligned_view(*place, hypothesis.images, scene, source_of)
            height, width = warped.valid.shape
            mask, valid = scene.query_mask(view.name), warped.valid
            if mask is not None:
                valid = valid & _mask_at_size(mask, width, height)
            query = query_at_size(query_image(view.name), width, height)
            views.append((query, replace(warped, valid=valid)))
        return views

    def _against_each_other(
        self,
        finalists: Sequence[Sequence[_Compared]],
        distances: Floats,
        at: NDArray[np.int64],
    ) -> Floats:
        """Return how much smaller each distance is than the others', on average."""
        margins = np.zeros(len(finalists))
        for i, first in enumerate(finalists):
            for j, second in enumerate(finalists[:i]):
                both = [a.valid & b.valid for (_, a), (_, b) in zip(first, second, strict=True)]
                margin = self._mean_distance(second, both) - self._mean_distance(first, both)
                if not np.isfinite(margin):  # too few pixels are valid in both
                    margin = distances[at[j]] - distances[at[i]]
                margins[i] += margin
                margins[j] -= margin
        return margins / max(len(finalists) - 1, 1)

    def _mean_distance(self, views: Sequence[_Compared], valid: Sequence[Mask]) -> float:
        """Average over a rig's views, weighted by valid pixels; infinite if these are too few."""
        counts = np.array([int(each.sum()) for each in valid])
        if counts.sum() < max(1.0, _MIN_VALID * sum(each.size for each in valid)):
            return float("inf")
        distances = [
            self._distance.distance(query, warped.image, mask) if count else np.inf
            for (query, warped), mask, count in zip(views, valid, counts, strict=True)
        ]
        known = np.isfinite(distances)
        if not known.any():
            return float("inf")
        return float(np.average(np.array(distances)[known], weights=counts[known]))


def aligned_view(
    camera: Camera,
    cam_from_world: RigidTransform,
    images: Sequence[str],
    scene: RankingScene,
    source_of: Callable[[str], PosedImage | None],
) -> WarpedView:
    """Warp the map images with depth that are nearest to a pose into its view, at reduced size."""
    found = filter(None, map(source_of, _nearest_first(images, cam_from_world, scene)))
    sources = list(islice(found, _REFERENCES))
    scale = min(1.0, _LONG_SIDE_PX / max(camera.width, camera.height))
    return warp_to_view(sources, camera, cam_from_world, scale=scale)


def query_at_size(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _mask_at_size(mask: Mask, width: int, height: int) -> Mask:
    share = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(share > 0.999, np.bool_)


def _nearest_first(
    images: Sequence[str], cam_from_world: RigidTransform, scene: RankingScene
) -> list[str]:
    """Sort images by similarity to the pose; near duplicates of an earlier image come last.

    The difference of two views is the angle between their axes plus the distance between their
    centres, the latter divided by the images' median distance from the pose. Near duplicates, such
    as successive video frames, would leave most of the view uncovered.
    """
    if not images:
        return []
    poses = [scene.map_pose(name) for name in images]
    centres = np.array([pose.center() for pose in poses])
    axes = np.array([pose.rotation_matrix()[2] for pose in poses])
    distances = np.linalg.norm(centres - cam_from_world.center(), axis=1)
    scale = max(float(np.median(distances)), 1e-9)

    def unlike(centre: Floats, axis: Floats) -> Floats:
        angles = np.arccos(np.clip(axes @ axis, -1.0, 1.0))
        return np.asarray(angles + np.linalg.norm(centres - centre, axis=1) / scale)

    nearest = unlike(cam_from_world.center(), cam_from_world.rotation_matrix()[2])
    repeated = np.zeros(len(images), np.bool_)
    waiting = []
    order = []
    for at in np.argsort(nearest, kind="stable"):
        if repeated[at]:
            waiting.append(at)
            continue
        order.append(at)
        repeated |= unlike(centres[at], axes[at]) < _ANOTHER_VIEW
    return [images[at] for at in (*order, *waiting)]
