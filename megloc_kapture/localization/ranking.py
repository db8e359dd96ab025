"""Which of several candidate poses is right, by their inliers: our own pose rankers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.plugins import HypothesisView, PoseHypothesis, RankingScene
from megloc_kapture.values import Options


class InlierCount:
    """Plugin ``inliers``: the number of inliers."""

    def score(
        self, hypotheses: Sequence[PoseHypothesis], scene: RankingScene
    ) -> NDArray[np.float64]:
        """Scores (H,)."""
        return _sum_of_views(hypotheses, lambda view, _: float(view.inliers.sum()))


class InlierSpreadOptions(Options):
    """Options of the ranker ``spread``."""

    cells: int = Field(default=16, gt=1, description="along the longer side of the image")


class InlierSpread:
    """Plugin ``spread``: the cells of a grid over the image that hold inliers.

    A repeated detail gives many inliers in one place of the image, the right pose has them all over
    it (Irschara et al., "From structure-from-motion point clouds to fast location recognition",
    CVPR 2009, section 4: effective inliers). Of equal numbers of cells more inliers win.
    """

    Options = InlierSpreadOptions

    def __init__(self, options: InlierSpreadOptions | None = None) -> None:
        self.options = options or InlierSpreadOptions()

    def score(
        self, hypotheses: Sequence[PoseHypothesis], scene: RankingScene
    ) -> NDArray[np.float64]:
        """Scores (H,)."""
        return _sum_of_views(hypotheses, lambda view, _: self._cells(view))

    def _cells(self, view: HypothesisView) -> float:
        size_px = max(view.camera.width, view.camera.height) / self.options.cells
        inliers = view.points_px[view.inliers]
        occupied = np.unique(np.floor(inliers / size_px), axis=0)
        # a fraction that never reaches one cell
        return len(occupied) + len(inliers) / (1.0 + len(inliers))


class ReprojectionScore:
    """Plugin ``reprojection``: inliers weighted by how well they fit.

    The sum of ``1 - (error / max_error)^2`` over the inliers: MSAC's score (Torr and Zisserman,
    "MLESAC", CVIU 2000, section 3) with its sign turned.
    """

    def score(
        self, hypotheses: Sequence[PoseHypothesis], scene: RankingScene
    ) -> NDArray[np.float64]:
        """Scores (H,)."""

        def fit(view: HypothesisView, max_error_px: float) -> float:
            return float((1.0 - (view.errors_px[view.inliers] / max_error_px) ** 2).sum())

        return _sum_of_views(hypotheses, fit)


def _sum_of_views(
    hypotheses: Sequence[PoseHypothesis], score: Callable[[HypothesisView, float], float]
) -> NDArray[np.float64]:
    return np.array(
        [sum(score(view, each.max_error_px) for view in each.views) for each in hypotheses],
        dtype=np.float64,
    )
