"""How much of what one image observes stands in the view of another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import bearing_rays, px_from_cam
from megloc_kapture.mapping.chunks import in_chunks
from megloc_kapture.mapping.pairs import each_once
from megloc_kapture.values import Camera, RigidTransform

_CHUNK = 1024  # pairs; each is worked out by itself, so that chunks change nothing


# pixels looked at, across and down; depths, in distances of the two centres
_GRID = (9, 7)
_DEPTHS = 2.0 ** np.arange(-2, 8, 0.5)


def views_can_overlap(
    first: Camera,
    first_from_world: RigidTransform,
    second: Camera,
    second_from_world: RigidTransform,
) -> bool:
    """Whether some place in the view of one camera is in that of the other, whatever stands there.

    Looked for along the rays of a grid of pixels, from a quarter of the distance between the
    cameras to infinity.
    """
    between = second_from_world @ first_from_world.inverse()
    return _reaches(first, second, between) or _reaches(second, first, between.inverse())


def _reaches(first: Camera, second: Camera, second_from_first: RigidTransform) -> bool:
    x, y = np.meshgrid(
        *(np.linspace(0, size, n) for size, n in zip(_size(first), _GRID, strict=True))
    )
    rays = bearing_rays(first, np.stack([x.ravel(), y.ravel()], axis=1))
    turned = rays @ second_from_first.rotation_matrix().T
    offset = np.asarray(second_from_first.translation)
    depths = _DEPTHS * np.linalg.norm(offset)
    # without a distance between them, and at infinity, only the turn counts
    points = [turned, *(turned * depth + offset for depth in depths[depths > 0])]
    with np.errstate(invalid="ignore"):
        seen = px_from_cam(second, np.concatenate(points))
        inside = ((seen >= 0) & (seen <= _size(second))).all(axis=1)
    return bool(inside.any())


def _size(camera: Camera) -> tuple[int, int]:
    return camera.width, camera.height


def frustum_overlap(
    pairs: NDArray[np.int64],
    cameras: Sequence[Camera],
    cams_from_world: Sequence[RigidTransform],
    xyz: NDArray[np.float64],
    point_ids: NDArray[np.integer[Any]],
    image_ids: NDArray[np.integer[Any]],
) -> NDArray[np.float64]:
    """Share of the points an image observes that fall into the other's image, for pairs of images.

    The larger of a pair's two shares: a near view and a far one overlap though the far one sees
    much besides. Nothing is known of what hides a point.

    Parameters
    ----------
    pairs : int64 (P, 2), rows of ``cameras`` and ``cams_from_world``.
    xyz : float64 (N, 3) in the world.
    point_ids, image_ids : (O,), the observations, rows of ``xyz`` and of ``cameras``; in any order.

    Returns
    -------
    float64 (P,) from 0 to 1, NaN where neither image observes a point.
    """
    from megloc_kapture.geometry.projection import model_id, packed_params
    from megloc_kapture.mapping import pairs_kernels

    shares = np.full(len(pairs), np.nan)
    if len(pairs) == 0:
        return shares
    keys = each_once(np.asarray(image_ids, dtype=np.int64) * max(len(xyz), 1) + point_ids)
    images, points = np.divmod(keys, max(len(xyz), 1))
    arguments = (
        np.ascontiguousarray(pairs, dtype=np.int64),
        np.append(0, np.cumsum(np.bincount(images, minlength=len(cameras)))),
        points,
        np.ascontiguousarray(xyz, dtype=np.float64),
        np.stack([pose.rotation_matrix() for pose in cams_from_world]),
        np.array([pose.translation for pose in cams_from_world], dtype=np.float64),
        np.array([model_id(camera) for camera in cameras], dtype=np.int64),
        np.stack([packed_params(camera) for camera in cameras]),
        np.array([(camera.width, camera.height) for camera in cameras], dtype=np.float64),
        shares,
    )
    in_chunks(
        len(pairs), _CHUNK, lambda first, last: pairs_kernels.shares_seen(first, last, *arguments)
    )
    return shares
