"""How much of what one image observes stands in the view of another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.mapping.chunks import in_chunks
from megloc_kapture.mapping.pairs import each_once
from megloc_kapture.values import Camera, RigidTransform

_CHUNK = 1024  # pairs; each is worked out by itself, so that chunks change nothing


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
