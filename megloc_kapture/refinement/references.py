"""Reference images of refinement by rendering: choice, preparation, and consistency of a map.

A reference serves many queries: what was made of it is kept, by the content of its pixels and
depths, so that a map that changes is never taken for what it was.

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

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import in_image, project
from megloc_kapture.geometry.poses import camera_centers, invert_quats, rotate, stack_poses
from megloc_kapture.plugins import DepthView, RankingScene
from megloc_kapture.refinement.acceptance import CHI2_OF_CHANCE
from megloc_kapture.refinement.pyramid import (
    Appearance,
    DepthPoints,
    Level,
    build_pyramid,
    lift_points,
    visibility,
)
from megloc_kapture.values import Camera, RigidTransform

_FORWARD = np.array([0.0, 0.0, 1.0])
# prepared references per process; one of 640x480 takes about 8 MB
_KEPT_REFERENCES = 32
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


class ReferenceImages:
    """Finds map images, by their ``cam_from_world``, that may show what a camera sees.

    ``names`` are those of the images, sorted.
    """

    def __init__(self, poses: Mapping[str, RigidTransform]) -> None:
        self.names = tuple(sorted(poses))
        quats, translations = stack_poses([poses[name] for name in self.names])
        self._centers = camera_centers(quats, translations)
        self._directions = rotate(invert_quats(quats), _FORWARD)

    def near(
        self,
        cam_from_world: RigidTransform,
        first: Sequence[str],
        *,
        max_references: int,
        only_first: bool = False,
        max_angle_deg: float = 60.0,
        min_distance_m: float = 0.0,
    ) -> list[str]:
        """Images that look a camera's way, nearest first; half of them, at least, of ``first``.

        Parameters
        ----------
        first : images that the pose comes from: they are known to match.
        only_first : take no other images.
        max_angle_deg : between the viewing directions; images beyond it stay out.
        min_distance_m : of the centres; images within it stay out, unit of the map.
        """
        forward = cam_from_world.rotation_matrix()[2]
        facing = self._directions @ forward >= np.cos(np.deg2rad(max_angle_deg))
        distances = np.linalg.norm(self._centers - cam_from_world.center(), axis=1)
        usable = facing & (distances >= min_distance_m)
        order = [int(at) for at in np.argsort(distances, kind="stable") if usable[at]]
        known = set(first)
        chosen = [at for at in order if self.names[at] in known]
        if only_first:
            return [self.names[at] for at in chosen[:max_references]]
        chosen = chosen[: (max_references + 1) // 2]
        chosen += [at for at in order if at not in set(chosen)][: max_references - len(chosen)]
        return [self.names[at] for at in chosen]


@dataclass(frozen=True, eq=False)
class RenderingQuery:
    """The image whose pose is refined: RGB uint8 (H, W, 3); of the mask True means use."""

    image: NDArray[np.uint8]
    camera: Camera
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class RenderingReference:
    """An image of the map, as of :class:`RenderingQuery`, that is warped into the query.

    ``depth`` was taken with it, maybe by another camera.
    """

    image: NDArray[np.uint8]
    camera: Camera
    cam_from_world: RigidTransform
    depth: DepthView
    mask: NDArray[np.bool_] | None = None


def reference_of(name: str, scene: RankingScene) -> RenderingReference | None:
    """A map image as a reference; None where it has no depth; raises DataError."""
    depth = scene.map_depth(name)
    if depth is None:
        return None
    image, camera = scene.map_image(name), scene.map_camera(name)
    return RenderingReference(image, camera, scene.map_pose(name), depth, scene.map_mask(name))


@dataclass(frozen=True)
class PyramidKind:
    """Options of :func:`~.pyramid.build_pyramid`."""

    levels: int
    max_side_px: int
    appearance: Appearance


@dataclass(frozen=True, eq=False)
class PreparedReference:
    """A reference's pyramid, finest first, and its points in the world."""

    pyramid: list[Level]
    points: DepthPoints


def prepared(reference: RenderingReference, kind: PyramidKind) -> PreparedReference:
    """The result of :func:`prepare`, kept for the references used last."""
    return _prepared(_ByContent(_content(reference), reference), kind)


@dataclass(frozen=True)
class _ByContent:
    """A reference that equals any other of the same content."""

    content: tuple[Any, ...]
    reference: RenderingReference = field(compare=False)


@lru_cache(maxsize=_KEPT_REFERENCES)
def _prepared(key: _ByContent, kind: PyramidKind) -> PreparedReference:
    return prepare(key.reference, kind)


def prepare(reference: RenderingReference, kind: PyramidKind) -> PreparedReference:
    """Pyramid and points of a reference; raises DataError for what does not fit its camera."""
    points = lift_points(reference.camera, reference.cam_from_world, reference.depth)
    return PreparedReference(pyramid_of(reference, kind), points)


def pyramid_of(view: RenderingQuery | RenderingReference, kind: PyramidKind) -> list[Level]:
    """Levels of an image, finest first; raises DataError for what does not fit the camera."""
    image, camera = view.image, view.camera
    if image.shape != (camera.height, camera.width, 3):
        raise DataError(
            f"an image of {image.shape} does not fit a camera of {camera.width}x{camera.height}"
        )
    return build_pyramid(image, view.mask, **vars(kind))


def _content(reference: RenderingReference) -> tuple[Any, ...]:
    """Key of a prepared reference: all that it depends on, arrays by their digest."""
    depth = reference.depth
    digest = hashlib.blake2b(digest_size=16)
    for array in (reference.image, depth.depth_m, reference.mask):
        if array is not None:
            digest.update(f"{array.dtype.str} {array.shape}".encode())
            digest.update(np.ascontiguousarray(array).data)
    cameras = reference.camera, reference.cam_from_world, depth.camera, depth.image_from_depth
    return digest.digest(), *cameras


@dataclass(frozen=True)
class Displacement:
    """Displacement by refinement of an image from a pose that should be right."""

    # moved_m, turned_deg: of the camera; unit of the map
    moved_m: float
    turned_deg: float
    moved_px: float  # of what it shows (median), in pixels of the finest level that is compared
    # claimed_m, claimed_deg: standard deviations by the covariance that refinement claims
    claimed_m: float
    claimed_deg: float
    squared_distance: float  # of the poses over that covariance; of six degrees of freedom

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
    """Consistency of a map by its held-out images."""

    # images, contradicting: how many were tested, and of them contradict the map
    images: int
    contradicting: int
    # medians of their displacements, each of its own; None where none was tested
    median: Displacement | None
    reason: str  # why refinement cannot be trusted in this map; empty where it can

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
    names = Displacement.__dataclass_fields__
    median = Displacement(
        *(float(np.median([getattr(each, name) for each in known])) for name in names)
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

    None where the image has no depth, or the others do not determine its pose. Raises DataError for
    an image or a depth map that cannot be read, or does not fit its camera.

    Parameters
    ----------
    images : the map's, of one coordinate frame.
    scene : has their pixels, cameras, poses and depth; nothing of queries is asked for.
    max_references : those that see most of the image, from elsewhere.
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
        view.cam_from_world, (), max_references=_NEAREST, min_distance_m=_MIN_PARALLAX * distance_m
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
    return float(in_image(camera, project(camera, pose, ahead)).sum() / len(points))


def _share_seen(view: RenderingReference, own: DepthPoints, other: RenderingReference) -> float:
    """Share of an image in which another has points that the image's own surface does not hide."""
    points = lift_points(other.camera, other.cam_from_world, other.depth)
    seen = visibility([own, points], view.camera, view.cam_from_world).seen[1]
    free = DepthPoints(points.points[seen], points.px[seen])
    return float(visibility([free], view.camera, view.cam_from_world).covered.mean())
