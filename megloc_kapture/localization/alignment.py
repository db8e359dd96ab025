"""How far off the scene stands in a query, by what map images show around the points of a pose.

The keypoints of a photograph at night or in another season are off by pixels although its pose is
right: a detector finds another place on the same corner. The surroundings of the corner are where
the pose says. In the scene's like, or its mirror image, they are off as its keypoints are.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import focal_px, project
from megloc_kapture.plugins import RankingScene
from megloc_kapture.values import Camera, RigidTransform

# surroundings of a point, and how far they are looked for; of a query as it is localized
_HALF_PATCH_PX, _SEARCH_PX = 12, 6
# of an image, and of a view: what is looked at takes time
_MAX_POINTS, _MAX_IMAGES = 300, 4
# surroundings without texture say nothing, and such that look alike less are not found
_MIN_DEVIATION, _MIN_CORRELATION = 5.0, 0.6
# surroundings are compared as planes that face the camera
_MAX_SCALE = 2.0


def displacements_px(
    query: str,
    camera: Camera,
    cam_from_world: RigidTransform,
    points: NDArray[np.float64],
    shown_by: Sequence[str],
    scene: RankingScene,
) -> NDArray[np.float64]:
    """How far from a point's projection its surroundings are found in a query.

    Parameters
    ----------
    points : float64 (N, 3), in the world.
    shown_by : of each point a map image that observes it.

    Returns
    -------
    Distances in pixels of the query, of those that are found, at most a few hundred; none where
    there are no pixels of the query or the map.
    """
    most = [image for image, _ in Counter(shown_by).most_common(_MAX_IMAGES)]
    rows = [row for row, image in enumerate(shown_by) if image in most]
    rows = rows[:: max(1, math.ceil(len(rows) / _MAX_POINTS))]
    found: list[float] = []
    try:
        pixels = _grey(scene.query_image(query))
        for image in most:
            own = points[[row for row in rows if shown_by[row] == image]]
            found += _found_in(pixels, camera, cam_from_world, own, image, scene)
    except DataError:
        return np.zeros(0)
    return np.array(found)


def _found_in(
    pixels: NDArray[np.uint8],
    camera: Camera,
    cam_from_world: RigidTransform,
    points: NDArray[np.float64],
    image: str,
    scene: RankingScene,
) -> list[float]:
    """The displacements of the points of one map image."""
    map_camera, map_pose = scene.map_camera(image), scene.map_pose(image)
    shown = _grey(scene.map_image(image))
    with np.errstate(invalid="ignore", divide="ignore"):
        here, there = project(camera, cam_from_world, points), project(map_camera, map_pose, points)
        z_here, z_there = cam_from_world.apply(points)[:, 2], map_pose.apply(points)[:, 2]
        scales = (focal_px(camera) / z_here) / (focal_px(map_camera) / z_there)
        usable = (scales > 1 / _MAX_SCALE) & (scales < _MAX_SCALE) & (z_here > 0)
    usable &= np.isfinite(here).all(axis=1) & np.isfinite(there).all(axis=1)
    turn = (cam_from_world @ map_pose.inverse()).rotation_matrix()
    angle = math.atan2(turn[1, 0], turn[0, 0])
    side, found = 2 * _HALF_PATCH_PX + 1, []
    for row in np.flatnonzero(usable):
        cos, sin = math.cos(angle) / scales[row], -math.sin(angle) / scales[row]
        map_from_patch = np.array([[cos, -sin, 0.0], [sin, cos, 0.0]])
        middle = there[row] - 0.5  # OpenCV counts from the middle of the first pixel
        map_from_patch[:, 2] = middle - map_from_patch[:, :2].sum(axis=1) * _HALF_PATCH_PX
        patch = cv2.warpAffine(
            shown, map_from_patch, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        if patch.std() < _MIN_DEVIATION:
            continue
        around = cv2.getRectSubPix(
            pixels, (side + 2 * _SEARCH_PX,) * 2, tuple((here[row] - 0.5).tolist())
        )
        likeness = cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED)
        y, x = np.unravel_index(int(np.argmax(likeness)), likeness.shape)
        if likeness[y, x] >= _MIN_CORRELATION:
            at = (_peak(likeness[y], int(x)), _peak(likeness[:, x], int(y)))
            found.append(math.hypot(at[0] - _SEARCH_PX, at[1] - _SEARCH_PX))
    return found


def _peak(values: NDArray[Any], at: int) -> float:
    """The place of a maximum between samples, by a parabola."""
    if not 0 < at < len(values) - 1:
        return float(at)
    before, here, after = (float(value) for value in values[at - 1 : at + 2])
    curvature = before - 2 * here + after
    return at + 0.5 * (before - after) / curvature if curvature < 0 else float(at)


def _grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
