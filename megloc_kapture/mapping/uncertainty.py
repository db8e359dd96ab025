"""Covariances of map points, and rejection of uncertain points.

MegLoc, section "Mapping": with ``p_c = R_cw p_w + t_cw`` and the projection ``pi``, an observation
has the Jacobian ``J = d pi / d p_c  R_cw`` with poses and cameras fixed (the equation in the paper
has a malformed middle term, and ``R_wc`` instead of ``R_cw``). For independent noise of one pixel,
a point's covariance is the inverse of ``sum J^T J``; the square roots of the covariance's
eigenvalues are standard deviations along orthogonal axes. ``d pi / d p_c`` includes the camera's
distortion.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.geometry.poses import deviation_by_median
from megloc_kapture.values import Camera, Options, RigidTransform

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CHUNK = 1 << 14  # points


def point_covariances(
    xyz: Floats,
    point_ids: NDArray[np.integer],
    image_ids: NDArray[np.integer],
    cameras: Sequence[Camera],
    cams_from_world: Sequence[RigidTransform],
) -> Floats:
    """Return covariances (N, 6) of points (N, 3) as xx, xy, xz, yy, yz, zz for a noise of 1 px.

    Observations (O,) may be in any order; those with the point behind the camera are ignored. NaN
    if the observations do not determine the point.
    """
    from numba import get_num_threads  # numba loads slowly

    from megloc_kapture.geometry.projection import packed_views
    from megloc_kapture.mapping.kernels import covariances_of_points

    out = np.full((len(xyz), 6), np.nan)
    if len(image_ids) == 0:
        return out
    by_point = np.argsort(point_ids, kind="stable")
    arguments = (
        np.append(0, np.cumsum(np.bincount(point_ids, minlength=len(xyz)))),
        image_ids[by_point].astype(np.int32),
        np.ascontiguousarray(xyz, dtype=np.float64),
        *packed_views(cameras, cams_from_world),
        out,
    )

    def compute(first: int) -> None:
        last = min(first + _CHUNK, len(xyz))
        covariances_of_points(first, last, *arguments)

    with ThreadPoolExecutor(get_num_threads()) as executor:  # one per available core
        list(executor.map(compute, range(0, len(xyz), _CHUNK)))
    return out


def point_deviations(covariances: Floats) -> Floats:
    """Return standard deviations (N, 3) along the principal axes, ascending; NaN if unknown."""
    deviations = np.full((len(covariances), 3), np.nan)
    known = np.isfinite(covariances).all(axis=1)
    matrices = covariances[known][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    # rounding may turn the smallest eigenvalue negative
    deviations[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(matrices), 0.0))
    return deviations


class UncertaintyOptions(Options):
    """Limit on the uncertainty of points.

    The uncertainty is the largest standard deviation of a point over all directions, for a keypoint
    noise of 1 px, divided by the point's mean depth. Points of unknown uncertainty, such as points
    lifted from a depth map, which have a single observation, are kept.
    """

    max_robust_sigmas: float | None = Field(
        default=None,
        gt=0,
        description="limit for a point's relative uncertainty (log of standard deviation over "
        "depth), in robust standard deviations above the map's median; none: no limit",
    )


def mean_depths(
    xyz: Floats,
    point_ids: NDArray[np.int64],
    image_ids: NDArray[np.int32],
    cams_from_world: Sequence[RigidTransform],
) -> Floats:
    """Return mean depths (N,) of points in the images that observe them; NaN if there are none."""
    axes = np.array([pose.rotation_matrix()[2] for pose in cams_from_world]).reshape(-1, 3)
    offsets = np.array([pose.translation[2] for pose in cams_from_world])
    depths = np.einsum("oi,oi->o", axes[image_ids], xyz[point_ids]) + offsets[image_ids]
    with np.errstate(invalid="ignore"):
        sums = np.bincount(point_ids, depths, minlength=len(xyz))
        return np.asarray(sums / np.bincount(point_ids, minlength=len(xyz)))


def too_uncertain(deviations: Floats, depths: Floats, max_robust_sigmas: float) -> Mask:
    """Return a mask (N,) of points to reject by their largest deviation and mean depth (N,).

    See :class:`UncertaintyOptions`.
    """
    with np.errstate(invalid="ignore"):  # comparisons with NaN are false
        relative = deviations / depths
        valid = relative[np.isfinite(relative) & (relative > 0)]
        if len(valid) == 0:
            return np.zeros(len(deviations), dtype=bool)
        logarithms = np.log(valid)
        median = float(np.median(logarithms))
        deviation = float(deviation_by_median(logarithms - median))
        return np.asarray(relative > np.exp(median + max_robust_sigmas * deviation))


def left_with_too_few(
    point_ids: NDArray[np.int64], dropped: Mask, num_points: int, min_observations: int
) -> Mask:
    """Return a mask (N,) of points that lost an observation and have too few left."""
    lost = np.bincount(point_ids[dropped], minlength=num_points)
    left = np.bincount(point_ids[~dropped], minlength=num_points)
    return (lost > 0) & (left < min_observations)
