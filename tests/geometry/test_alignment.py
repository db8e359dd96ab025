"""Alignment of a world without scale with positions on earth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.alignment import GeoPosition, align_to_earth
from megloc_kapture.geometry.earth import earth_from_enu, geodetic

EARTH = earth_from_enu(48.1, 11.6, 520.0)
TURN = Rotation.from_rotvec([0.3, -1.2, 0.8]).as_matrix()


def on_earth(enu: NDArray[np.float64]) -> dict[str, GeoPosition]:
    return {f"{at}": geodetic(EARTH.apply(one[None])[0]) for at, one in enumerate(enu)}


def in_map(enu: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    return {f"{at}": one @ TURN / 7.5 + 3.0 for at, one in enumerate(enu)}


def walk(number: int, width_m: float = 12.0) -> NDArray[np.float64]:
    rng = np.random.default_rng(3)
    return rng.uniform((-40, -width_m, -2), (40, width_m, 2), (number, 3))


def test_scale_and_axes_of_exact_positions() -> None:
    enu = walk(8)
    found = align_to_earth(in_map(enu), on_earth(enu))
    assert abs(found.scale / 7.5 - 1) < 1e-6 and found.residual_m < 1e-3
    aligned = np.array([found.enu_from_map.apply(found.scale * p) for p in in_map(enu).values()])
    apart = aligned - enu
    np.testing.assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=1e-3)


def test_noise_and_two_positions_far_off() -> None:
    enu = walk(20)
    noisy = enu + np.random.default_rng(5).normal(0, 1.0, enu.shape)
    noisy[4] += 60
    noisy[9] -= (200, 0, 30)
    found = align_to_earth(in_map(enu), on_earth(noisy))
    assert abs(found.scale / 7.5 - 1) < 0.03
    assert 0.5 < found.residual_m < 3.0


@pytest.mark.parametrize(
    ("enu", "known", "reason"),
    [
        (walk(8), 2, "2 photographs of the map have a GPS position"),
        (walk(8) * (1, 0.01, 0.01), 8, r"spread over 0\.\d m across"),
        (walk(8) * 0.02, 8, "tell no scale"),
        (np.ones((4, 3)), 4, "at one place"),
    ],
)
def test_positions_that_tell_no_scale(enu: NDArray[np.float64], known: int, reason: str) -> None:
    positions = dict(list(on_earth(enu).items())[:known])
    with pytest.raises(DataError, match=reason):
        align_to_earth(in_map(enu), positions)
