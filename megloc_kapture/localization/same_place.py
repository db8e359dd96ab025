"""Whether two poses of a query, from different clusters of candidates, are of the same place."""

from __future__ import annotations

import numpy as np

from megloc_kapture.geometry.cameras import project
from megloc_kapture.plugins import PoseHypothesis


def same_place(one: PoseHypothesis, other: PoseHypothesis) -> bool:
    """Whether either pose has at least half of the other's inliers as inliers too."""
    return _explains(one, other) or _explains(other, one)


def _explains(this: PoseHypothesis, other: PoseHypothesis) -> bool:
    close = total = 0
    for view, others in zip(this.views, other.views, strict=True):
        points, pixels = others.points_world[others.inliers], others.points_px[others.inliers]
        errors = np.linalg.norm(project(view.camera, view.cam_from_world, points) - pixels, axis=1)
        close += int((errors <= this.max_error_px).sum())
        total += len(points)
    return 2 * close >= total
