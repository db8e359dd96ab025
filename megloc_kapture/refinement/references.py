"""Images of refinement by rendering: the options, the choice of references, and their preparation.

A reference serves many queries: what was made of it is kept, by the content of its pixels and
depths, so that a map that changes is never taken for what it was.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.poses import camera_centers, invert_quats, rotate, stack_poses
from megloc_kapture.plugins import DepthView, RankingScene
from megloc_kapture.refinement.depth_points import DepthPoints, lift_points
from megloc_kapture.refinement.photometric import MIN_POINTS
from megloc_kapture.refinement.pyramid import (
    Appearance,
    FeatureMaps,
    Level,
    build_pyramid,
)
from megloc_kapture.values import Camera, Options, RigidTransform

_FORWARD = np.array([0.0, 0.0, 1.0])
# of prepared references per process; one of 640x480 takes about 7 MB
_KEPT_BYTES = 256 * 2**20


class ReferenceImages:
    """Finds map images that may show what a camera sees.

    Parameters
    ----------
    poses : ``cam_from_world`` of the map's images.

    Attributes
    ----------
    names : of the images, sorted.
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
        max_angle_deg: float = 60.0,
        min_distance_m: float = 0.0,
    ) -> list[str]:
        """Images that look a camera's way, nearest first; half of them, at least, of ``first``.

        Parameters
        ----------
        first : images that the pose comes from: they are known to match.
        max_angle_deg : between the viewing directions; images beyond it stay out.
        min_distance_m : of the centres; images within it stay out, unit of the map.
        """
        forward = cam_from_world.rotation_matrix()[2]
        facing = self._directions @ forward >= np.cos(np.deg2rad(max_angle_deg))
        distances = np.linalg.norm(self._centers - cam_from_world.center(), axis=1)
        usable = facing & (distances >= min_distance_m)
        order = [int(at) for at in np.argsort(distances, kind="stable") if usable[at]]
        known = set(first)
        chosen = [at for at in order if self.names[at] in known][: (max_references + 1) // 2]
        chosen += [at for at in order if at not in set(chosen)][: max_references - len(chosen)]
        return [self.names[at] for at in chosen]


class RenderingOptions(Options):
    """Options of the refinement by rendering."""

    appearance: Appearance = Field(
        default="normalised",
        description="what is compared: brightness of locally normalised contrast (day and night), "
        "the same of each colour (colours), plain brightness (intensity), or magnitudes of its "
        "gradient (gradients)",
    )
    max_references: int = Field(
        default=4,
        gt=0,
        description="reference images with depth that are used, best first",
    )
    max_points: int = Field(
        default=12000,
        ge=MIN_POINTS,
        description="points of a reference and level of its pyramid",
    )
    max_side_px: int = Field(
        default=640,
        ge=64,
        description="longer side of the finest level; larger images are reduced",
    )
    levels: int = Field(
        default=3,
        ge=1,
        description="of the pyramids, each of half the size; begin at the coarsest",
    )
    search_deg: float = Field(
        default=4.0,
        ge=0,
        description="turns of the camera that are tried at the coarsest level",
    )
    max_translation_m: float = Field(
        default=0.5,
        gt=0,
        description="a pose whose centre moves further is not accepted",
    )
    max_rotation_deg: float = Field(
        default=5.0, gt=0, description="a pose that turns further is not accepted"
    )
    require_consistent_map: bool = Field(
        default=True,
        description="refine only where the map's own images, held out, would stay where they are",
    )
    min_significance: float = Field(
        default=2.5,
        ge=0,
        description="by how many of its standard errors the robust cost must fall, parts of the "
        "query being the observations",
    )
    min_correlation: float = Field(
        default=0.12,
        ge=-1,
        le=1,
        description="of the query with the warped references, below which a pose is not accepted",
    )
    min_overlap: float = Field(
        default=0.2,
        ge=0,
        le=1,
        description="share of the query that references must cover",
    )
    max_overlap_loss: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="share of that overlap that a new pose may lose",
    )


@dataclass(frozen=True, eq=False)
class RenderingQuery:
    """The image whose pose is refined.

    Attributes
    ----------
    image : uint8 (H, W, 3), RGB.
    camera : its intrinsics.
    mask : bool (H, W), True = use; None for all.
    """

    image: NDArray[np.uint8]
    camera: Camera
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class RenderingReference:
    """An image of the map that is warped into the query.

    Attributes
    ----------
    image : uint8 (H, W, 3), RGB.
    camera, cam_from_world : of the image.
    depth : taken with it, maybe by another camera.
    mask : bool (H, W), True = use; None for all.
    """

    image: NDArray[np.uint8]
    camera: Camera
    cam_from_world: RigidTransform
    depth: DepthView
    mask: NDArray[np.bool_] | None = None


def reference_of(name: str, scene: RankingScene) -> RenderingReference | None:
    """A map image as a reference; None where it has no depth.

    Raises
    ------
    DataError : the image, its mask or its depth map cannot be read.
    """
    depth = scene.map_depth(name)
    if depth is None:
        return None
    return RenderingReference(
        scene.map_image(name),
        scene.map_camera(name),
        scene.map_pose(name),
        depth,
        scene.map_mask(name),
    )


@dataclass(frozen=True)
class PyramidKind:
    """Options of the pyramids; see :func:`~.pyramid.build_pyramid`."""

    levels: int
    max_side_px: int
    appearance: Appearance
    features: FeatureMaps | None = None


@dataclass(frozen=True, eq=False)
class PreparedReference:
    """A reference's pyramid, finest first, and its points in the world."""

    pyramid: list[Level]
    points: DepthPoints

    @property
    def nbytes(self) -> int:
        """Memory that it takes, in bytes, gradients that are looked up later included."""
        levels = sum(
            each.values.nbytes + each.valid.nbytes + each.values[..., 0].nbytes
            for each in self.pyramid
        )
        return self.points.points.nbytes + self.points.px.nbytes + levels


class ReferenceCache:
    """The prepared references used last, up to a number of bytes; threads may share it."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._kept: OrderedDict[object, PreparedReference] = OrderedDict()
        self._nbytes = 0
        self._lock = Lock()

    def prepared(self, reference: RenderingReference, kind: PyramidKind) -> PreparedReference:
        """The result of :func:`prepare`, made only if it is not kept.

        Feature maps are not kept: they are large.
        """
        if kind.features is not None:
            return prepare(reference, kind)
        key = (_content(reference), kind)
        with self._lock:
            found = self._kept.get(key)
            if found is not None:
                self._kept.move_to_end(key)
                return found
        made = prepare(reference, kind)
        with self._lock:
            if key not in self._kept:
                self._kept[key] = made
                self._nbytes += made.nbytes
            while self._nbytes > self._max_bytes:
                self._nbytes -= self._kept.popitem(last=False)[1].nbytes
        return made

    def clear(self) -> None:
        """Keep nothing."""
        with self._lock:
            self._kept.clear()
            self._nbytes = 0


REFERENCES = ReferenceCache(_KEPT_BYTES)


def prepare(reference: RenderingReference, kind: PyramidKind) -> PreparedReference:
    """Pyramid and points of a reference.

    Raises
    ------
    DataError : image, mask, depth map or feature maps do not fit their cameras.
    """
    return PreparedReference(
        pyramid_of(reference, kind),
        lift_points(reference.camera, reference.cam_from_world, reference.depth),
    )


def pyramid_of(view: RenderingQuery | RenderingReference, kind: PyramidKind) -> list[Level]:
    """Levels of an image, finest first.

    Raises
    ------
    DataError : image, mask or feature maps do not fit the camera.
    """
    image, camera = view.image, view.camera
    if image.shape != (camera.height, camera.width, 3):
        raise DataError(
            f"an image of {image.shape} does not fit a camera of {camera.width}x{camera.height}"
        )
    return build_pyramid(
        image,
        view.mask,
        levels=kind.levels,
        max_side_px=kind.max_side_px,
        appearance=kind.appearance,
        features=kind.features,
    )


def _content(reference: RenderingReference) -> tuple[Any, ...]:
    """Key of a prepared reference: all that it depends on, arrays by their digest."""
    depth = reference.depth
    digest = hashlib.blake2b(digest_size=16)
    for array in (reference.image, depth.depth_m, reference.mask):
        if array is not None:
            digest.update(f"{array.dtype.str} {array.shape}".encode())
            digest.update(np.ascontiguousarray(array).data)
    return (
        digest.digest(),
        reference.camera,
        reference.cam_from_world,
        depth.camera,
        depth.image_from_depth,
    )
