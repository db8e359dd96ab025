"""Covariances of the points of a map, from the images that observe them.

MegLoc, section "Mapping": a point's uncertainty from its observations, poses and cameras fixed.
With ``p_c = R_cw p_w + t_cw`` and the camera's projection ``pi``, an observation has the Jacobian

    J = d pi(p_c) / d p_w = d pi / d p_c  R_cw,

for a pinhole ``[f_x / z, 0, -f_x x / z^2; 0, f_y / z, -f_y y / z^2] R_cw``. (The equation as
printed has a malformed middle term, and ``R_wc`` where the rotation from world to camera is meant.)
For independent noise of one pixel the information about the point is ``sum J^T J`` over its
observations, its inverse the point's covariance, and the roots of the covariance's eigenvalues are
the deviations along three orthogonal axes. ``d pi / d p_c`` is that of the camera's own model,
distortion included.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.values import Camera, RigidTransform

Floats = NDArray[np.float64]

_CHUNK = 1 << 14  # points; each is worked out by itself, so that chunks change nothing


def point_covariances(
    xyz: Floats,
    point_ids: NDArray[np.integer],
    image_ids: NDArray[np.integer],
    cameras: Sequence[Camera],
    cams_from_world: Sequence[RigidTransform],
) -> Floats:
    """Covariances of points for a noise of 1 px in their images, poses and cameras exact.

    Parameters
    ----------
    xyz : float64 (N, 3) in the world.
    point_ids, image_ids : (O,), rows of ``xyz`` and of ``cameras``; in any order, faster where the
        points ascend.

    Returns
    -------
    float64 (N, 6): xx, xy, xz, yy, yz, zz in the map's unit squared; NaN where the observations do
    not determine the point (a single view, no parallax). A point behind a camera is not observed
    by it.

    Raises
    ------
    DataError : ids that are no rows, or not as many poses as cameras.
    """
    from megloc_kapture.geometry.projection import packed_views
    from megloc_kapture.mapping import kernels

    if len(cameras) != len(cams_from_world):
        raise DataError(f"{len(cameras)} cameras and {len(cams_from_world)} poses, not as many")
    out = np.full((len(xyz), 6), np.nan)
    starts, image_ids = _by_point(point_ids, image_ids, len(xyz), len(cameras))
    if len(image_ids) == 0:
        return out
    arguments = (
        starts,
        image_ids,
        np.ascontiguousarray(xyz, dtype=np.float64),
        *packed_views(cameras, cams_from_world),
        out,
    )
    kernels.in_chunks(
        len(xyz), _CHUNK, lambda a, b: kernels.covariances_of_points(a, b, *arguments)
    )
    return out


def point_deviations(covariances: Floats) -> Floats:
    """Standard deviations of points along their three principal axes.

    Parameters
    ----------
    covariances : float64 (N, 6), see :func:`point_covariances`.

    Returns
    -------
    float64 (N, 3) in the map's unit for a noise of 1 px, ascending; NaN where unknown.
    """
    from megloc_kapture.mapping import kernels

    out = np.full((len(covariances), 3), np.nan)
    known = np.ascontiguousarray(covariances, dtype=np.float64)
    kernels.in_chunks(
        len(covariances), _CHUNK, lambda a, b: kernels.deviations_of_points(a, b, known, out)
    )
    return out


def _by_point(
    point_ids: NDArray[np.integer],
    image_ids: NDArray[np.integer],
    num_points: int,
    num_images: int,
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """First observation of each point (N + 1,), and the images (O,) in that order.

    The compiled loops check no bounds: ids that are no rows end here.
    """
    point_ids, image_ids = np.asarray(point_ids), np.asarray(image_ids)
    if point_ids.shape != image_ids.shape or point_ids.ndim != 1:
        raise DataError(f"ids of points {point_ids.shape} and of images {image_ids.shape} differ")
    for name, ids, count in (("point", point_ids, num_points), ("image", image_ids, num_images)):
        if len(ids) and not (ids.min() >= 0 and ids.max() < count):
            raise DataError(
                f"observations of {name} {ids.min()} to {ids.max()}, but there are {count}"
            )
    if (point_ids[1:] < point_ids[:-1]).any():
        order = np.argsort(point_ids, kind="stable")
        point_ids, image_ids = point_ids[order], image_ids[order]
    starts = np.zeros(num_points + 1, dtype=np.int64)
    np.cumsum(np.bincount(point_ids, minlength=num_points), out=starts[1:])
    return starts, np.ascontiguousarray(image_ids, dtype=np.int32)
