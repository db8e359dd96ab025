"""Pose ranker ``distinctive``: inliers that other places do not have as well."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from megloc_kapture.localization.same_place import same_place
from megloc_kapture.plugins import PoseHypothesis, RankingScene
from megloc_kapture.values import Options


class DistinctiveInliersOptions(Options):
    """Options of the ranker ``distinctive``."""

    radius: float = Field(
        default=0.03, ge=0, description="of a place's inliers, share of the image's longer side"
    )
    power: float = Field(default=4.0, gt=0, description="1 shares an inlier evenly")


class DistinctiveInliers:
    """Plugin ``distinctive``: inliers, each weighted by how few places explain it.

    Rooms that are alike all explain the query's walls and furniture, and which of them gives most
    inliers hangs on how well each was mapped. What only one of them explains tells them apart. So
    an inlier has the weight ``1 / n ** power``, where ``n`` counts the places with an inlier there,
    its own included: after the geometric bursts between places of Sattler et al., "Large-scale
    location recognition and the geometric burstiness problem", CVPR 2016. It counts within a
    radius, as no place has a match for every keypoint of what it explains.

    Two hypotheses are the same place where either's pose explains the inliers of the other; they
    do not count against each other.
    """

    Options = DistinctiveInliersOptions

    def __init__(self, options: DistinctiveInliersOptions | None = None) -> None:
        self.options = options or DistinctiveInliersOptions()

    def score(
        self, hypotheses: Sequence[PoseHypothesis], scene: RankingScene
    ) -> NDArray[np.float64]:
        """Scores (H,)."""
        scores = np.zeros(len(hypotheses))
        same = [[same_place(a, b) for b in hypotheses] for a in hypotheses]
        for number in range(len(hypotheses[0].views) if hypotheses else 0):
            views = [hypothesis.views[number] for hypothesis in hypotheses]
            camera = views[0].camera
            radius_px = max(self.options.radius * max(camera.width, camera.height), 1e-3)
            inliers = [view.points_px[view.inliers] for view in views]
            trees = [cKDTree(points) for points in inliers]
            for at, points in enumerate(inliers):
                places = np.ones(len(points))
                for other, tree in enumerate(trees):
                    if other != at and not same[at][other]:
                        places += np.isfinite(tree.query(points, distance_upper_bound=radius_px)[0])
                scores[at] += float((places**-self.options.power).sum())
        return scores
