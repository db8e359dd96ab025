"""Rejection of points of a map and of their observations.

Reprojection error, triangulation angle and track length as COLMAP's ``ObservationManager`` has
them, and the uncertainty of the points. Arrays in, masks out; nothing is moved.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.geometry.robust import deviation_by_median
from megloc_kapture.values import Camera, Options, RigidTransform

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class ConsistencyOptions(Options):
    """Options: limits on reprojection errors, angles and tracks; none: no limit."""

    max_reprojection_error_px: float | None = Field(
        default=None, gt=0, description="an observation farther from its keypoint is dropped"
    )
    min_angle_deg: float | None = Field(
        default=None,
        ge=0,
        le=90,
        description="a point that no two images see at this angle is dropped, unless only one "
        "image sees it",
    )
    min_track_length: int | None = Field(
        default=None, ge=1, description="a point with fewer observations is dropped"
    )


class UncertaintyOptions(Options):
    """Options: limits on the points' uncertainty; none: no limit.

    The deviation of a point is the largest of its three, for a noise of 1 px in the images. Points
    whose uncertainty is not known (lifted ones, which a single image sees) stay.
    """

    max_deviation: float | None = Field(default=None, gt=0, description="in the map's unit")
    max_relative_deviation: float | None = Field(
        default=None, gt=0, description="share of the point's mean depth in its images"
    )
    keep_quantile: float | None = Field(
        default=None, gt=0, le=1, description="share of the points that stays, the surest ones"
    )
    max_robust_sigmas: float | None = Field(
        default=None,
        gt=0,
        description="how far the logarithm of a point's share of its depth may lie above the "
        "map's median, in standard deviations estimated from the median absolute deviation",
    )

    def needs_deviations(self) -> bool:
        """True if any point can be rejected."""
        return any(limit is not None for limit in self.model_dump().values())


@dataclass(frozen=True, eq=False)
class ObservedPoints:
    """Points and the images that observe them.

    Parameters
    ----------
    xyz : float64 (N, 3).
    point_ids : int64 (O,), rows of ``xyz``, ascending.
    image_ids : int32 (O,), indices into ``cameras`` and ``cams_from_world``.
    """

    xyz: Floats
    point_ids: NDArray[np.int64]
    image_ids: NDArray[np.int32]
    cameras: Sequence[Camera]
    cams_from_world: Sequence[RigidTransform]

    def starts(self) -> NDArray[np.int64]:
        """First observation of each point, and the end of the last one's; int64 (N + 1,)."""
        starts = np.zeros(len(self.xyz) + 1, dtype=np.int64)
        np.cumsum(track_lengths(self), out=starts[1:])
        return starts

    def rotations_and_translations(self) -> tuple[Floats, Floats]:
        """Of ``cams_from_world``, (I, 3, 3) and (I, 3)."""
        poses = self.cams_from_world
        rotations = np.array([pose.rotation_matrix() for pose in poses]).reshape(-1, 3, 3)
        return rotations, np.array([pose.translation for pose in poses]).reshape(-1, 3)

    def by_image(self) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """Every image that observes something, and the rows of its observations, ascending."""
        ids = self.image_ids
        # numpy sorts integers of 16 bits in linear time
        narrow = ids.astype(np.uint16) if len(self.cameras) < 1 << 16 else ids
        order = np.argsort(narrow, kind="stable")
        begin = 0
        ends = np.cumsum(np.bincount(ids, minlength=len(self.cameras)))
        for image, end in enumerate(ends.tolist()):
            if end > begin:
                yield image, order[begin:end]
            begin = end


def reprojection_errors_px(
    observed: ObservedPoints, keypoints_px: NDArray[np.floating[Any]]
) -> Floats:
    """Distance (O,) of each observation's keypoint (O, 2) from its point; infinite behind."""
    from megloc_kapture.geometry.projection import packed_views
    from megloc_kapture.mapping import kernels

    errors = np.empty(len(observed.point_ids))
    if len(errors):
        kernels.reprojection_errors(
            observed.point_ids,
            observed.image_ids,
            np.ascontiguousarray(keypoints_px, dtype=np.float64),
            observed.xyz,
            *packed_views(observed.cameras, observed.cams_from_world),
            errors,
        )
    return errors


def mean_depths(observed: ObservedPoints) -> Floats:
    """Mean depth (N,) of each point in the images that observe it; NaN where none does."""
    from megloc_kapture.mapping import kernels

    depths = np.empty(len(observed.xyz))
    kernels.mean_depths(
        observed.starts(),
        observed.image_ids,
        observed.xyz,
        *observed.rotations_and_translations(),
        depths,
    )
    return depths


def track_lengths(observed: ObservedPoints) -> NDArray[np.int64]:
    """Number of observations (N,) of each point."""
    return np.bincount(observed.point_ids, minlength=len(observed.xyz))


def seen_at_angle(observed: ObservedPoints, min_angle_deg: float) -> Mask:
    """Mask (N,) of the points that two images see at this angle or a wider one.

    The angle is COLMAP's: that between the rays, or between one and the other turned round, where
    that is less.
    """
    from megloc_kapture.mapping import kernels

    wide = np.empty(len(observed.xyz), dtype=bool)
    centers = np.array([pose.center() for pose in observed.cams_from_world]).reshape(-1, 3)
    max_cosine = np.cos(np.radians(min_angle_deg))
    kernels.seen_at_angle(
        observed.starts(), observed.image_ids, observed.xyz, centers, max_cosine, wide
    )
    return wide


def too_uncertain(deviations: Floats, depths: Floats, options: UncertaintyOptions) -> Mask:
    """Mask (N,) of the points to reject by their uncertainty.

    Parameters
    ----------
    deviations : float64 (N,), the largest of each point, in the map's unit; NaN where unknown.
    depths : float64 (N,), see :func:`mean_depths`.
    """
    rejected = np.zeros(len(deviations), dtype=bool)
    with np.errstate(invalid="ignore"):  # comparisons with NaN are false, as they should be
        if options.max_deviation is not None:
            rejected |= deviations > options.max_deviation
        if options.max_relative_deviation is not None:
            rejected |= deviations > options.max_relative_deviation * depths
        if options.keep_quantile is not None:
            known = np.sort(deviations[~np.isnan(deviations)])
            if len(known):
                kept = max(1, round(options.keep_quantile * len(known)))
                rejected |= deviations > known[kept - 1]
        if options.max_robust_sigmas is not None:
            relative = deviations / depths
            usual = relative[np.isfinite(relative) & (relative > 0)]
            if len(usual):
                limit = robust_limit(np.log(usual), options.max_robust_sigmas)
                rejected |= relative > np.exp(limit)
    return rejected


def robust_limit(values: Floats, num_sigmas: float) -> float:
    """The median of ``values`` (N,), N > 0, and so many of their standard deviations more."""
    median = float(np.median(values))
    return median + num_sigmas * float(deviation_by_median(values - median))


def left_with_too_few(
    point_ids: NDArray[np.int64], dropped: Mask, num_points: int, min_observations: int
) -> Mask:
    """Points (N,) that lost an observation and have fewer than ``min_observations`` left.

    Who has lost nothing stays, however few there were: a lifted point has a single one.

    Parameters
    ----------
    point_ids, dropped : (O,).
    """
    lost = np.bincount(point_ids[dropped], minlength=num_points)
    left = np.bincount(point_ids[~dropped], minlength=num_points)
    return (lost > 0) & (left < min_observations)
