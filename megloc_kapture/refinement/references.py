"""Reference images for refinement by rendering: selection, preparation, map consistency.

Consistency is tested by leave-one-out refinement of map images (Stone, JRSS B 1974) against images
from other viewpoints. An image contradicts the map if its displacement is significant by the
estimated covariance and exceeds the resolution of alignment. Errors that all images share are not
detected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import in_image, project
from megloc_kapture.geometry.poses import camera_centers, invert_quats, rotate, stack_poses
from megloc_kapture.geometry.warping import PosedImage, image_with_depth
from megloc_kapture.plugins import RankingScene
from megloc_kapture.refinement.acceptance import CHI2_OF_CHANCE
from megloc_kapture.refinement.pyramid import (
    DepthPoints,
    lift_points,
    visibility,
)
from megloc_kapture.values import RigidTransform

_FORWARD = np.array([0.0, 0.0, 1.0])
_MAX_ANGLE_DEG = 60.0  # between the viewing directions of a query and of its references
MAX_TRIED = 96  # largest number of images that are held out
# smallest ratio of baseline to surface distance: an angle of about 6 deg between views
_MIN_PARALLAX = 0.1
# candidate references: an upper bound on the overlap is computed for the nearest images, and the
# overlap itself for those with the largest bounds
_NEAREST, _BEST = 200, 6
_ASKED_POINTS = 300
_MIN_SHARED = 0.1
DISPLACEMENT = (
    *("moved_m", "turned_deg", "moved_px"),
    *("claimed_m", "claimed_deg", "squared_distance"),
)
"""Measures of a refinement that tell how far it moved a map image, whose pose is presumed correct.

``claimed_m`` and ``claimed_deg`` are standard deviations of the refined pose by its estimated
covariance; ``squared_distance`` is the squared Mahalanobis distance.
"""
# smallest displacement that alignment resolves, in pixels of the finest level: it converges to
# 0.01 px, and images with exact poses move by up to 0.02 px
_RESOLVED_PX = 0.05


class ReferenceImages:
    """Index of map images by ``cam_from_world``, to find those that may overlap with a camera."""

    def __init__(self, poses: Mapping[str, RigidTransform]) -> None:
        self.names = tuple(sorted(poses))
        quats, translations = stack_poses([poses[name] for name in self.names])
        self._centers = camera_centers(quats, translations)
        self._directions = rotate(invert_quats(quats), _FORWARD)

    def near(
        self,
        cam_from_world: RigidTransform,
        among: Sequence[str],
        *,
        max_references: int,
        min_distance_m: float = 0.0,
    ) -> list[str]:
        """Return images with a similar viewing direction, nearest first.

        Candidates are the images ``among``, which have matches, or all images if there are none.
        """
        forward = cam_from_world.rotation_matrix()[2]
        facing = self._directions @ forward >= np.cos(np.deg2rad(_MAX_ANGLE_DEG))
        distances = np.linalg.norm(self._centers - cam_from_world.center(), axis=1)
        usable = facing & (distances >= min_distance_m)
        order = [self.names[row] for row in np.argsort(distances, kind="stable") if usable[row]]
        candidates = set(among or self.names)
        return [name for name in order if name in candidates][:max_references]


def spread_names(names: Sequence[str]) -> list[str]:
    """Return at most ``MAX_TRIED`` names in van der Corput order: every prefix is spread evenly."""
    names = sorted(names)
    bits = max(len(names) - 1, 1).bit_length()
    order = (int(f"{k:0{bits}b}"[::-1], 2) for k in range(1 << bits))
    return [names[row] for row in order if row < len(names)][:MAX_TRIED]


def contradicts(displacement: Mapping[str, float]) -> bool:
    return (
        displacement["squared_distance"] > CHI2_OF_CHANCE
        and displacement["moved_px"] > _RESOLVED_PX
    )


def references_elsewhere(
    view: PosedImage, images: ReferenceImages, scene: RankingScene
) -> list[PosedImage]:
    """Return overlapping map images from other viewpoints, largest overlap first."""
    surface = lift_points(view)
    points = surface.points[:: max(1, len(surface.points) // _ASKED_POINTS)]
    if len(points) == 0:
        return []
    distance_m = float(np.median(view.cam_from_world.apply(points)[:, 2]))
    neighbours = images.near(
        view.cam_from_world, (), max_references=_NEAREST, min_distance_m=_MIN_PARALLAX * distance_m
    )
    best = sorted(neighbours, key=lambda name: -_share_inside(points, name, scene))[:_BEST]
    candidates = [each for name in best if (each := image_with_depth(name, scene)) is not None]
    shared = [_share_seen(view, surface, each) for each in candidates]
    order = np.argsort(-np.array(shared), kind="stable")
    return [candidates[k] for k in order if shared[k] >= _MIN_SHARED]


def _share_inside(points: NDArray[np.float64], name: str, scene: RankingScene) -> float:
    camera, pose = scene.map_camera(name), scene.map_pose(name)
    ahead = points[pose.apply(points)[:, 2] > 0]
    return float(in_image(camera, project(camera, pose, ahead)).sum() / len(points))


def _share_seen(view: PosedImage, surface: DepthPoints, other: PosedImage) -> float:
    points = lift_points(other)
    (_, visible), _ = visibility([surface, points], view.camera, view.cam_from_world)
    unoccluded = DepthPoints(points.points[visible], points.px[visible])
    _, covered = visibility([unoccluded], view.camera, view.cam_from_world)
    return float(covered.mean())
