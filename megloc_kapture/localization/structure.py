"""Locally normalised image correlation: the distance ``structure``, and patch displacements."""

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
from megloc_kapture.localization.map_index import Correspondences, PoseProblem, QueryView
from megloc_kapture.plugins import RankingScene
from megloc_kapture.values import Camera, Pose, RigidTransform

_NOISE_VARIANCE = 9.0  # the constant c, grey levels squared: smaller variance counts as noise
_WINDOW = 0.02  # standard deviation of the windows, as a share of the image's longer side
_MIN_FILLED = 0.5  # smallest valid share of a window
# half side of a point's patch and radius of the search for it, in pixels of the query image
_HALF_PATCH_PX, _SEARCH_PX = 12, 6
# limits that bound the time: points per view, and map images from which patches are taken
_MAX_POINTS, _MAX_IMAGES = 300, 4
# a patch with a smaller standard deviation has no texture; if the best correlation is smaller, the
# patch is not found
_MIN_DEVIATION, _MIN_CORRELATION = 5.0, 0.6
# largest ratio of scales of query and map image; patches are treated as fronto-parallel planes
_MAX_SCALE = 2.0
Float32 = NDArray[np.float32]


class StructureDistance:
    """Plugin ``structure``: one minus the local correlation of two images' brightness.

    SSIM's structure term (Wang et al., IEEE TIP 2004, eq. 10), ``(cov + c) / (s_a s_b + c)`` in
    Gaussian windows over valid pixels. Differences in exposure and shading have little effect.
    """

    def distance(
        self, a: NDArray[np.uint8], b: NDArray[np.uint8], valid: NDArray[np.bool_]
    ) -> float:
        """Return the distance (0 to 2) between RGB images uint8 (H, W, 3) over valid pixels (H, W).

        Infinite if no window is at least half valid.
        """
        sigma = _WINDOW * max(valid.shape)
        weight = valid.astype(np.float32)

        def blurred(values: Float32) -> Float32:
            # pixels beyond the border are invalid
            smooth = cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
            return np.asarray(smooth, np.float32)

        filled = blurred(weight)
        used = valid & (filled >= _MIN_FILLED)
        if not used.any():
            return float("inf")
        filled = np.maximum(filled, np.float32(1e-6))
        grey_a, grey_b = (_grey(image, valid) for image in (a, b))

        def mean(values: Float32) -> Float32:
            return np.asarray(blurred(values * weight) / filled)

        mean_a, mean_b = mean(grey_a), mean(grey_b)
        variance_a = np.maximum(mean(grey_a * grey_a) - mean_a * mean_a, 0.0)
        variance_b = np.maximum(mean(grey_b * grey_b) - mean_b * mean_b, 0.0)
        covariance = mean(grey_a * grey_b) - mean_a * mean_b
        alike = (covariance + _NOISE_VARIANCE) / (
            np.sqrt(variance_a * variance_b) + _NOISE_VARIANCE
        )
        return max(0.0, float((1.0 - alike[used].astype(np.float64)).mean()))


def _grey(image: NDArray[np.uint8], valid: NDArray[np.bool_]) -> Float32:
    """Return brightness float32 (H, W) with zero mean, so that squares lose no precision."""
    grey = _grey_levels(image).astype(np.float32)
    return np.asarray(grey - grey[valid].mean(), np.float32)


def _grey_levels(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def displacements_rad(
    problem: PoseProblem,
    views: Sequence[QueryView],
    correspondences: Sequence[Sequence[Correspondences]],
    scene: RankingScene,
    pose: Pose,
) -> NDArray[np.float64]:
    """Return angles (K,) in radians between inliers' projections and their patches in the query.

    A patch is cut out around the point in the first map image of the match, and is searched for in
    the query. At night or in another season, detectors fire elsewhere on the same corner; for a
    correct pose, the patch is nevertheless at the projection. In a similar or mirrored scene, the
    patch is displaced like the keypoint. Empty if images cannot be read.
    """
    assert pose.inliers is not None  # poses estimated by localization have them
    angles = [np.zeros(0)]
    inliers = problem.split(pose.inliers)
    for query, view, of_types, kept in zip(
        views, problem.views, correspondences, inliers, strict=True
    ):
        shown_by = [
            typed.matches[row][0]
            for typed, of_type in zip(query.matches, of_types, strict=True)
            for row in of_type.image_rows[np.cumsum(of_type.support) - of_type.support].tolist()
        ]
        found_px = _displacements_px(
            query.name,
            view.camera,
            view.cam_from_rig @ pose.cam_from_world,
            view.points_world[kept],
            [shown_by[row] for row in np.flatnonzero(kept)],
            scene,
        )
        angles.append(found_px / focal_px(view.camera))
    return np.concatenate(angles)


def _displacements_px(
    query: str,
    camera: Camera,
    cam_from_world: RigidTransform,
    points: NDArray[np.float64],
    shown_by: Sequence[str],
    scene: RankingScene,
) -> NDArray[np.float64]:
    """Return displacements in pixels for points (N, 3) with one map image each."""
    most = [image for image, _ in Counter(shown_by).most_common(_MAX_IMAGES)]
    rows = [row for row, image in enumerate(shown_by) if image in most]
    rows = rows[:: max(1, math.ceil(len(rows) / _MAX_POINTS))]
    displacements: list[float] = []
    try:
        query_grey = _grey_levels(scene.query_image(query))
        for image in most:
            points_in_image = points[[row for row in rows if shown_by[row] == image]]
            displacements += _displacements_in(
                query_grey, camera, cam_from_world, points_in_image, image, scene
            )
    except DataError:
        return np.zeros(0)
    return np.array(displacements)


def _displacements_in(
    query_grey: NDArray[np.uint8],
    camera: Camera,
    cam_from_world: RigidTransform,
    points: NDArray[np.float64],
    image: str,
    scene: RankingScene,
) -> list[float]:
    map_camera, map_pose = scene.map_camera(image), scene.map_pose(image)
    map_grey = _grey_levels(scene.map_image(image))
    with np.errstate(invalid="ignore", divide="ignore"):
        in_query, in_map = (
            project(camera, cam_from_world, points),
            project(map_camera, map_pose, points),
        )
        z_query, z_map = cam_from_world.apply(points)[:, 2], map_pose.apply(points)[:, 2]
        scales = (focal_px(camera) / z_query) / (focal_px(map_camera) / z_map)
        usable = (scales > 1 / _MAX_SCALE) & (scales < _MAX_SCALE) & (z_query > 0)
    usable &= np.isfinite(in_query).all(axis=1) & np.isfinite(in_map).all(axis=1)
    query_from_map = (cam_from_world @ map_pose.inverse()).rotation_matrix()
    angle = math.atan2(query_from_map[1, 0], query_from_map[0, 0])
    side, displacements = 2 * _HALF_PATCH_PX + 1, []
    for row in np.flatnonzero(usable):
        cos, sin = math.cos(angle) / scales[row], -math.sin(angle) / scales[row]
        map_from_patch = np.array([[cos, -sin, 0.0], [sin, cos, 0.0]])
        middle = in_map[row] - 0.5  # in OpenCV, the centre of the first pixel is (0, 0)
        map_from_patch[:, 2] = middle - map_from_patch[:, :2].sum(axis=1) * _HALF_PATCH_PX
        patch = cv2.warpAffine(
            map_grey, map_from_patch, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        if patch.std() < _MIN_DEVIATION:
            continue
        around = cv2.getRectSubPix(
            query_grey, (side + 2 * _SEARCH_PX,) * 2, tuple((in_query[row] - 0.5).tolist())
        )
        likeness = cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED)
        y, x = np.unravel_index(int(np.argmax(likeness)), likeness.shape)
        if likeness[y, x] >= _MIN_CORRELATION:
            at = (_peak(likeness[y], int(x)), _peak(likeness[:, x], int(y)))
            displacements.append(math.hypot(at[0] - _SEARCH_PX, at[1] - _SEARCH_PX))
    return displacements


def _peak(values: NDArray[Any], at: int) -> float:
    """Return the position of a maximum between samples, by fitting a parabola."""
    if not 0 < at < len(values) - 1:
        return float(at)
    before, here, after = (float(value) for value in values[at - 1 : at + 2])
    curvature = before - 2 * here + after
    return at + 0.5 * (before - after) / curvature if curvature < 0 else float(at)
