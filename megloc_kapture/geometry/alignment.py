"""Alignment of a map's world, which has no scale, with positions on earth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.earth import earth_from_enu, geodetic
from megloc_kapture.values import RigidTransform

GeoPosition = tuple[float, float, float]
"""Latitude and longitude in degrees, height in metres above the ellipsoid."""

_ROUNDS = 50
# how far the positions have to spread in two directions, in residuals, to tell scale and axes
_MIN_SPREAD = 3.0
# receivers of phones claim no better; residuals of three positions may be smaller by chance
_MIN_RESIDUAL_M = 1.0


@dataclass(frozen=True)
class EarthAlignment:
    """Where a map lies on earth: ``enu = enu_from_map(scale * x)``.

    Attributes
    ----------
    origin : of the frame East, North, Up.
    residual_m : median distance of the aligned camera centres from their positions.
    """

    scale: float
    enu_from_map: RigidTransform
    origin: GeoPosition
    residual_m: float
    num_positions: int


def align_to_earth(
    centers: Mapping[str, NDArray[np.float64]], positions: Mapping[str, GeoPosition]
) -> EarthAlignment:
    """Scale and axes of a map by the positions of its cameras on earth.

    Least squares (Umeyama 1991), reweighted by Cauchy's weights, so that single bad positions of a
    receiver do not count.

    Parameters
    ----------
    centers : camera centres (3,) in the map, by image.
    positions : of some images.

    Raises
    ------
    DataError : of fewer than three images, or these lie too near to each other or on a line.
    """
    names = sorted(centers.keys() & positions.keys())
    if len(names) < 3:
        raise DataError(
            f"{len(names)} photographs of the map have a GPS position; the scale takes 3 or more"
        )
    on_earth = np.array([earth_from_enu(*positions[name]).translation for name in names])
    origin = geodetic(np.median(on_earth, axis=0))
    enu = earth_from_enu(*origin).inverse().apply(on_earth)
    own = np.array([centers[name] for name in names])
    weights = np.ones(len(names))
    for _ in range(_ROUNDS):
        scale, rotation, translation = _similarity(own, enu, weights)
        apart = np.linalg.norm(scale * own @ rotation.T + translation - enu, axis=1)
        weights = 1 / (1 + (apart / max(float(np.median(apart)), 1e-9)) ** 2)
    residual_m = float(np.median(apart))
    spread_m = np.linalg.svd(scale * (own - np.median(own, axis=0)), compute_uv=False)[1]
    spread_m /= np.sqrt(len(names))
    if spread_m < _MIN_SPREAD * max(residual_m, _MIN_RESIDUAL_M):
        raise DataError(
            f"the GPS positions tell no scale: the photographs spread over {spread_m:.1f} m across "
            f"their path, and the positions are good to {max(residual_m, _MIN_RESIDUAL_M):.1f} m"
        )
    return EarthAlignment(
        scale, RigidTransform.from_matrix(rotation, translation), origin, residual_m, len(names)
    )


def _similarity(
    source: NDArray[np.float64], target: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """``target = scale * rotation @ source + translation`` in weighted least squares."""
    means = [np.average(points, axis=0, weights=weights) for points in (source, target)]
    a, b = source - means[0], target - means[1]
    rotation = Rotation.align_vectors(b, a, weights=weights)[0].as_matrix()
    spread = float((weights * (a**2).sum(axis=1)).sum())
    if spread == 0:
        raise DataError("the photographs were all taken at one place: there is no scale to tell")
    scale = float((weights[:, None] * b * (a @ rotation.T)).sum()) / spread
    return scale, rotation, means[1] - scale * rotation @ means[0]
