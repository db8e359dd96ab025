"""Positions on earth: WGS84's latitude, longitude and height, and earth-centred metres (ECEF)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.values import RigidTransform

_SEMI_MAJOR_M = 6378137.0
_FLATTENING = 1 / 298.257223563
_ECCENTRICITY_SQUARED = _FLATTENING * (2 - _FLATTENING)
_ROUNDS = 8  # each gains more than two digits


def earth_from_enu(latitude_deg: float, longitude_deg: float, height_m: float) -> RigidTransform:
    """From the frame east, north, up at a position to earth-centred, earth-fixed (ECEF) metres."""
    lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    rotation = np.stack([east, np.cross(up, east), up], axis=1)
    normal = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(lat) ** 2)
    position = up * (normal + height_m)
    position[2] -= normal * _ECCENTRICITY_SQUARED * np.sin(lat)
    return RigidTransform.from_matrix(rotation, position)


def geodetic(ecef_m: NDArray[np.float64]) -> tuple[float, float, float]:
    """Latitude and longitude in degrees and height in metres of an ECEF position (3,)."""
    x, y, z = (float(value) for value in ecef_m)
    across = np.hypot(x, y)
    lat = np.arctan2(z, across * (1 - _ECCENTRICITY_SQUARED))
    for _ in range(_ROUNDS):
        normal = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(lat) ** 2)
        lat = np.arctan2(z + normal * _ECCENTRICITY_SQUARED * np.sin(lat), across)
    height = across * np.cos(lat) + z * np.sin(lat)
    height -= _SEMI_MAJOR_M * np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(lat) ** 2)
    return float(np.degrees(lat)), float(np.degrees(np.arctan2(y, x))), float(height)
