"""The images that refinement by rendering compares, and what is prepared of each.

A reference serves many queries: what was made of it is kept, by the content of its pixels and
depths, so that a map that changes is never taken for what it was.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.plugins import DepthView
from megloc_kapture.refinement.photometric_points import DepthPoints, lift_points
from megloc_kapture.refinement.photometric_pyramid import (
    Appearance,
    FeatureMaps,
    Level,
    build_pyramid,
)
from megloc_kapture.values import Camera, RigidTransform

# of prepared references per process; one of 640x480 takes about 7 MB
_KEPT_BYTES = 256 * 2**20


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


@dataclass(frozen=True)
class PyramidKind:
    """How images are compared; see :func:`~.photometric_pyramid.build_pyramid`."""

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
        """What :func:`prepare` gives, made only if it is not kept.

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
    """What a prepared reference depends on, arrays by their digest."""
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
