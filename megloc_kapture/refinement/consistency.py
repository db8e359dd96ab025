"""A map's consistency with itself: where refinement would put map images whose poses are given.

Refinement by rendering finds the pose under which map images, warped by their depth, look like the
query. It is as good as they fit each other: poses that are off, or depth that is not registered to
colour, move every query by what no residual shows. So some of the map's own images are held out and
refined, from their given poses, against others that see the same from elsewhere (leave-one-out
cross-validation, Stone, JRSS B 1974). An image contradicts its map where it moves by more than the
covariance that refinement claims for it, by the limit beyond which a query's new pose is accepted
at all, and by more than alignment resolves. A map that most of its images contradict does not allow
what is claimed in it.

Images of one position share the errors of their pose, and show neither those nor wrong depth to
each other: references are taken that see the image's surfaces under another angle. An error that
all images share as one, and one finer than images see of each other, are not found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import project
from megloc_kapture.plugins import RankingScene
from megloc_kapture.refinement.acceptance import CHI2_OF_CHANCE
from megloc_kapture.refinement.depth_points import DepthPoints, lift_points, visibility
from megloc_kapture.refinement.references import (
    ReferenceImages,
    RenderingQuery,
    RenderingReference,
    reference_of,
)
from megloc_kapture.values import RigidTransform

# of a map: images whose displacement is known, after which there is no need of more; that many at
# least (all of five on the wrong side of a median is chance once in 32 times); that are tried
MAX_TESTED, MIN_TESTED, MAX_TRIED = 24, 5, 96
# distance of a reference's centre over that of the surfaces: an angle of about 6 deg between views
_MIN_PARALLAX = 0.1
# references that look the image's way, the nearest: all are asked what they may see of it, the best
# also what they do see
_NEAREST, _BEST = 200, 6
_ASKED_POINTS = 300
_MIN_SHARED = 0.1  # of the image, that a reference must see
# of the finest level: alignments are solved to steps of 0.01 px and read pixels bilinearly, and
# exact images move by up to 0.02 px, where the claims of large images are smaller still
_RESOLVED_PX = 0.05


@dataclass(frozen=True)
class Displacement:
    """Displacement by refinement of an image from a pose that should be right.

    Attributes
    ----------
    moved_m, turned_deg : of the camera; unit of the map.
    moved_px : of what it shows (median), in pixels of the finest level that is compared.
    claimed_m, claimed_deg : standard deviations by the covariance that refinement claims.
    squared_distance : of the poses over that covariance; of six degrees of freedom.
    """

    moved_m: float
    turned_deg: float
    moved_px: float
    claimed_m: float
    claimed_deg: float
    squared_distance: float

    @property
    def contradicts(self) -> bool:
        """True if it is more than the claim explains, and than alignment resolves."""
        return self.squared_distance > CHI2_OF_CHANCE and self.moved_px > _RESOLVED_PX


Displace = Callable[
    [RenderingQuery, Sequence[RenderingReference], RigidTransform], Displacement | None
]
"""Refines a pose that should be right; None where the references do not determine it."""


@dataclass(frozen=True)
class Consistency:
    """Consistency of a map by its held-out images.

    Attributes
    ----------
    images : how many were tested.
    contradicting : how many of them contradict the map.
    median : medians of their displacements, each of its own; None where none was tested.
    reason : why refinement cannot be trusted in this map; empty where it can.
    """

    images: int
    contradicting: int
    median: Displacement | None
    reason: str

    @property
    def consistent(self) -> bool:
        """True if refinement in this map is as accurate as it claims, as far as is known."""
        return not self.reason


@runtime_checkable
class HoldsOut(Protocol):
    """A pose refiner whose results are as good as the map is consistent."""

    name: str
    require_consistent_map: bool
    """If true, poses may be refined only in a map that was found consistent."""

    def hold_out(
        self, image: str, images: ReferenceImages, scene: RankingScene
    ) -> Displacement | None:
        """Displacement of a map image; None where the others do not determine it."""
        ...


def spread_names(names: Sequence[str]) -> list[str]:
    """At most ``MAX_TRIED`` names, the first of which are spread evenly over all, as all are.

    Names are taken in van der Corput's order of their ranks: neighbours in time or space, whose
    names follow each other, come far apart.
    """
    names = sorted(names)
    bits = max(len(names) - 1, 1).bit_length()
    order = (int(f"{k:0{bits}b}"[::-1], 2) for k in range(1 << bits))
    return [names[at] for at in order if at < len(names)][:MAX_TRIED]


def judge_consistency(displacements: Iterable[Displacement | None]) -> Consistency:
    """Judge a map by the displacements of :func:`refine_held_out` of :func:`spread_names`.

    No more are asked for once ``MAX_TESTED`` are known.
    """
    known: list[Displacement] = []
    for each in displacements:
        if each is not None:
            known.append(each)
            if len(known) == MAX_TESTED:
                break
    if not known:
        return Consistency(0, 0, None, "no map image with depth is seen by others from elsewhere")
    median = Displacement(
        *(
            float(np.median([getattr(each, name) for each in known]))
            for name in Displacement.__dataclass_fields__
        )
    )
    contradicting = sum(each.contradicts for each in known)
    reason = ""
    if len(known) < MIN_TESTED:
        reason = (
            f"the map's consistency is not known: {len(known)} of its images are seen by others "
            f"from elsewhere, at least {MIN_TESTED} are needed"
        )
    elif 2 * contradicting > len(known):
        reason = (
            f"the map contradicts itself: {contradicting} of {len(known)} of its own images would "
            f"move by more than is claimed, all by {median.moved_m:.3f} m, "
            f"{median.turned_deg:.2f} deg, {median.moved_px:.1f} px (medians)"
        )
    return Consistency(len(known), contradicting, median, reason)


def refine_held_out(
    image: str,
    images: ReferenceImages,
    scene: RankingScene,
    displace: Displace,
    *,
    max_references: int,
) -> Displacement | None:
    """Displacement of a map image from its given pose when it is refined against others.

    Parameters
    ----------
    images : the map's, of one coordinate frame.
    scene : has their pixels, cameras, poses and depth; nothing of queries is asked for.
    max_references : those that see most of the image, from elsewhere.

    Returns
    -------
    None where the image has no depth, or the others do not determine its pose.

    Raises
    ------
    DataError : an image or a depth map cannot be read, or does not fit its camera.
    """
    view = reference_of(image, scene)
    if view is None:
        return None
    own = lift_points(view.camera, view.cam_from_world, view.depth)
    references = _references_elsewhere(view, own, images, scene)[:max_references]
    if not references:
        return None
    query = RenderingQuery(view.image, view.camera, view.mask)
    return displace(query, references, view.cam_from_world)


def _references_elsewhere(
    view: RenderingReference, own: DepthPoints, images: ReferenceImages, scene: RankingScene
) -> list[RenderingReference]:
    """Images that see the surfaces of another under another angle, those that see most first."""
    points = own.points[:: max(1, len(own.points) // _ASKED_POINTS)]
    if len(points) == 0:
        return []
    distance_m = float(np.median(view.cam_from_world.apply(points)[:, 2]))
    near = images.near(
        view.cam_from_world,
        (),
        max_references=_NEAREST,
        min_distance_m=_MIN_PARALLAX * distance_m,
    )
    # a stable sort: of equals the nearest comes first
    best = sorted(near, key=lambda name: -_share_inside(points, name, scene))[:_BEST]
    found = [each for name in best if (each := reference_of(name, scene)) is not None]
    shared = [_share_seen(view, own, each) for each in found]
    order = np.argsort(-np.array(shared), kind="stable")
    return [found[k] for k in order if shared[k] >= _MIN_SHARED]


def _share_inside(points: NDArray[np.float64], name: str, scene: RankingScene) -> float:
    """Share of points (N, 3) that a map image would show, were nothing in front of them."""
    camera, pose = scene.map_camera(name), scene.map_pose(name)
    ahead = points[pose.apply(points)[:, 2] > 0]
    px = project(camera, pose, ahead)
    return float(((px >= 0) & (px < (camera.width, camera.height))).all(1).sum() / len(points))


def _share_seen(view: RenderingReference, own: DepthPoints, other: RenderingReference) -> float:
    """Share of an image in which another has points that the image's own surface does not hide."""
    points = lift_points(other.camera, other.cam_from_world, other.depth)
    seen = visibility([own, points], view.camera, view.cam_from_world).seen[1]
    free = DepthPoints(points.points[seen], points.px[seen])
    return float(visibility([free], view.camera, view.cam_from_world).covered.mean())
