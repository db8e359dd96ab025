"""A map from above, for the page: its cameras, some of its points, two axes of the ground."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.poses import camera_centers, invert_quats, rotate, stack_poses
from megloc_kapture.pipeline.kapture_map import KaptureMap

_MAX_POINTS, _MAX_CAMERAS = 15_000, 3_000


def map_overview(kapture_map: KaptureMap) -> bytes:
    """JSON: ``right`` and ``up``, unit vectors of the world, and an ``origin`` in it; on these
    ``points`` [x, y, ...] and ``cameras`` [x, y, direction x, direction y, ...]; how many
    ``images`` there are, and the ``unit`` of the world, ``m`` or ``units``.

    Of many points and cameras a sample.
    """
    # matplotlib comes with it, and worker processes are given what it makes
    from megloc_kapture.evaluation.report.map_view import top_view

    names = kapture_map.images
    quats, translations = stack_poses([kapture_map.poses[name] for name in names])
    centers = camera_centers(quats, translations)
    origin = centers.mean(axis=0)
    view = top_view(quats, centers)
    forward = rotate(invert_quats(quats), np.array([0.0, 0.0, 1.0]))
    cameras = np.hstack([view.project(centers - origin), view.project(forward)])
    points = _trimmed(np.concatenate([k.index.xyz for k in kapture_map.keypoints.values()]))
    content = {
        "images": len(names),
        "unit": kapture_map.unit,
        "right": _rounded(view.right, 9),
        "up": _rounded(view.up, 9),
        "origin": origin.tolist(),
        "cameras": _rounded(_sample(cameras, _MAX_CAMERAS)),
        "points": _rounded(view.project(_sample(points, _MAX_POINTS) - origin)),
    }
    return json.dumps(content, separators=(",", ":")).encode()


def _trimmed(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Without the outermost, which would make the rest a dot."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        return points
    low, high = np.percentile(points, [1.0, 99.0], axis=0)
    margin = 0.5 * (high - low)
    return points[((points >= low - margin) & (points <= high + margin)).all(axis=1)]


def _sample(rows: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    if len(rows) <= most:
        return rows
    return rows[np.sort(np.random.default_rng(0).choice(len(rows), most, replace=False))]


def _rounded(values: NDArray[np.float64], digits: int = 5) -> list[float]:
    return [float(f"{value:.{digits}g}") for value in values.ravel().tolist()]


@cache
def read(name: str) -> str:
    """A page of this folder."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
