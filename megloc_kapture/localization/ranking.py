"""Pose rankers: scores of the candidate poses of a query by their inliers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from megloc_kapture.geometry.cameras import project
from megloc_kapture.plugins import HypothesisView, PoseHypothesis, RankingScene
from megloc_kapture.values import Options


class _SumOfViews(ABC):
    """Scores that are summed over the views of a hypothesis."""

    def score(
        self, hypotheses: Sequence[PoseHypothesis], scene: RankingScene
    ) -> NDArray[np.float64]:
        """Scores (H,)."""
        return np.array(
            [sum(self._of(view, each.max_error_px) for view in each.views) for each in hypotheses],
            dtype=np.float64,
        )

    @abstractmethod
    def _of(self, view: HypothesisView, max_error_px: float) -> float:
        """What a view adds; ``max_error_px`` is the largest error of an inlier."""


class InlierCount(_SumOfViews):
    """Plugin ``inliers``: the number of inliers."""

    def _of(self, view: HypothesisView, max_error_px: float) -> float:
        return float(view.inliers.sum())


class InlierSpreadOptions(Options):
    """Options of the ranker ``spread``."""

    cells: int = Field(default=16, gt=1, description="along the longer side of the image")


class InlierSpread(_SumOfViews):
    """Plugin ``spread``: the cells of a grid over the image that hold inliers.

    A repeated detail gives many inliers in one part of the image, the right pose has them all over
    it (Irschara et al., "From structure-from-motion point clouds to fast location recognition",
    CVPR 2009, section 4: effective inliers). Of equal numbers of cells more inliers win.
    """

    Options = InlierSpreadOptions

    def __init__(self, options: InlierSpreadOptions | None = None) -> None:
        self.options = options or InlierSpreadOptions()

    def _of(self, view: HypothesisView, max_error_px: float) -> float:
        size_px = max(view.camera.width, view.camera.height) / self.options.cells
        inliers = view.points_px[view.inliers]
        occupied = np.unique(np.floor(inliers / size_px), axis=0)
        # a fraction that never reaches one cell
        return len(occupied) + len(inliers) / (1.0 + len(inliers))


class ReprojectionScore(_SumOfViews):
    """Plugin ``reprojection``: inliers weighted by how well they fit.

    The sum of ``1 - (error / max_error)^2`` over the inliers: MSAC's score (Torr and Zisserman,
    "MLESAC", CVIU 2000, section 3) with its sign turned.
    """

    def _of(self, view: HypothesisView, max_error_px: float) -> float:
        return float((1.0 - (view.errors_px[view.inliers] / max_error_px) ** 2).sum())


class DistinctiveInliersOptions(Options):
    """Options of the ranker ``distinctive``."""

    radius: float = Field(
        default=0.03, ge=0, description="of a place's inliers, share of the image's longer side"
    )
    power: float = Field(default=4.0, gt=0, description="1 shares an inlier evenly")


class DistinctiveInliers:
    """Plugin ``distinctive``: inliers, each weighted by how few hypotheses explain it.

    Rooms that are alike all explain the query's walls and furniture, and which of them gives most
    inliers hangs on how well each was mapped. What only one of them explains tells them apart. So
    an inlier has the weight ``1 / n ** power``, where ``n`` counts the hypotheses with an inlier
    within a radius, its own included (no hypothesis has a match for every keypoint of what it
    explains): after the geometric bursts between places of Sattler et al., "Large-scale location
    recognition and the geometric burstiness problem", CVPR 2016. Hypotheses of which either's pose
    explains the other's inliers do not count against each other.
    """

    Options = DistinctiveInliersOptions

    def __init__(self, options: DistinctiveInliersOptions | None = None) -> None:
        self.options = options or DistinctiveInliersOptions()

    def score(
        self, hypotheses: Sequence[PoseHypothesis], scene: RankingScene
    ) -> NDArray[np.float64]:
        """Scores (H,)."""
        scores = np.zeros(len(hypotheses))
        same = [[poses_agree(a, b) for b in hypotheses] for a in hypotheses]
        for number in range(len(hypotheses[0].views) if hypotheses else 0):
            views = [hypothesis.views[number] for hypothesis in hypotheses]
            camera = views[0].camera
            radius_px = max(self.options.radius * max(camera.width, camera.height), 1e-3)
            inliers = [view.points_px[view.inliers] for view in views]
            trees = [cKDTree(points) for points in inliers]
            for at, points in enumerate(inliers):
                explaining = np.ones(len(points))
                for other, tree in enumerate(trees):
                    if other != at and not same[at][other]:
                        explaining += np.isfinite(
                            tree.query(points, distance_upper_bound=radius_px)[0]
                        )
                scores[at] += float((explaining**-self.options.power).sum())
        return scores


def poses_agree(one: PoseHypothesis, other: PoseHypothesis) -> bool:
    """True if either pose has at least half of the other's inliers as inliers too."""
    return _explains(one, other) or _explains(other, one)


def _explains(this: PoseHypothesis, other: PoseHypothesis) -> bool:
    close = total = 0
    for view, others in zip(this.views, other.views, strict=True):
        points, pixels = others.points_world[others.inliers], others.points_px[others.inliers]
        errors = np.linalg.norm(project(view.camera, view.cam_from_world, points) - pixels, axis=1)
        close += int((errors <= this.max_error_px).sum())
        total += len(points)
    return 2 * close >= total
