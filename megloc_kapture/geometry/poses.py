"""Pose algebra on arrays, and alignment of maps.

Quaternions (..., 4), ordered w x y z, and translations (..., 3) are float64. As in
:class:`megloc_kapture.values.RigidTransform`, ``a_from_b`` maps ``x_a = R x_b + t``, transforms
compose right to left, and ``q`` and ``-q`` are one rotation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.values import RigidTransform

Floats = NDArray[np.float64]
GeoPosition = tuple[float, float, float]
"""Latitude and longitude in degrees, height in metres above the ellipsoid."""

# standard deviation of normal values divided by their median magnitude: 1 / (3/4 quantile)
_DEVIATION_OF_MEDIAN = 1.482602218505602
# WGS84 ellipsoid
_SEMI_MAJOR_M = 6378137.0
_FLATTENING = 1 / 298.257223563
_ECCENTRICITY_SQUARED = _FLATTENING * (2 - _FLATTENING)
_LATITUDE_ROUNDS = 8
_ALIGNING_ROUNDS = 50
_ALIGNING_PAIRS = 200  # enough: if half of the poses are correct, so is a quarter of the pairs
# largest angle between agreeing poses; one of 30,000 random rotations agrees by chance
_AGREEMENT_DEG = 5.0
# largest distance between agreeing centres, relative to the target centres' spread
_AGREEMENT_OF_SPREAD = 0.1
# smallest spread of the positions along their second principal axis, as a multiple of the residual,
# that determines the scale and the axes
_MIN_SPREAD = 3.0
# smallest assumed error of GPS positions: phone receivers claim no better, and the residuals of
# three positions may be smaller by chance
_MIN_RESIDUAL_M = 1.0


def stack_poses(poses: Iterable[RigidTransform]) -> tuple[Floats, Floats]:
    """Stack transforms into quaternions (N, 4) and translations (N, 3)."""
    listed = list(poses)
    quats = np.array([p.quat_wxyz for p in listed], dtype=np.float64).reshape(-1, 4)
    translations = np.array([p.translation for p in listed], dtype=np.float64).reshape(-1, 3)
    return quats, translations


def unstack_poses(quats_wxyz: Floats, translations: Floats) -> list[RigidTransform]:
    """Build transforms from quaternions (N, 4) and translations (N, 3)."""
    return [
        RigidTransform((w, x, y, z), (tx, ty, tz))
        for (w, x, y, z), (tx, ty, tz) in zip(
            quats_wxyz.tolist(), translations.tolist(), strict=True
        )
    ]


def normalize_quats(quats_wxyz: Floats) -> Floats:
    with np.errstate(invalid="ignore", divide="ignore"):
        return quats_wxyz / np.linalg.norm(quats_wxyz, axis=-1, keepdims=True)


def invert_quats(quats_wxyz: Floats) -> Floats:
    """Return the inverses ``conj(q) / |q|^2`` of quaternions (..., 4)."""
    return _conjugate(quats_wxyz) / _squared_length(quats_wxyz)[..., None]


def multiply_quats(first: Floats, second: Floats) -> Floats:
    """Return Hamilton products ``first * second`` of quaternions (..., 4); shapes broadcast."""
    w1, x1, y1, z1 = np.moveaxis(np.asarray(first), -1, 0)
    w2, x2, y2, z2 = np.moveaxis(np.asarray(second), -1, 0)
    return np.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        axis=-1,
    )


def rotation_matrices(quats_wxyz: Floats) -> Floats:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4) of any length."""
    quats = np.asarray(quats_wxyz, dtype=np.float64)
    w, x, y, z = np.moveaxis(quats, -1, 0)
    squared = _squared_length(quats)
    # dividing by a length that is 1 up to rounding would only add rounding
    s = 2.0 / np.where(np.abs(squared - 1.0) < 1e-14, 1.0, squared)
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotate(quats_wxyz: Floats, vectors: Floats) -> Floats:
    """Rotate vectors (..., 3) by quaternions (..., 4); shapes broadcast."""
    return np.matmul(rotation_matrices(quats_wxyz), vectors[..., None])[..., 0]


def compose(
    quats_ab: Floats, translations_ab: Floats, quats_bc: Floats, translations_bc: Floats
) -> tuple[Floats, Floats]:
    """Return ``a_from_c`` of ``a_from_b`` and ``b_from_c``, with unit quaternions (..., 4)."""
    quats = normalize_quats(multiply_quats(quats_ab, quats_bc))
    return quats, rotate(quats_ab, translations_bc) + translations_ab


def invert(quats_wxyz: Floats, translations: Floats) -> tuple[Floats, Floats]:
    """Return ``b_from_a`` of ``a_from_b``: quaternions (..., 4), translations (..., 3)."""
    inverse = invert_quats(quats_wxyz)
    return inverse, -rotate(inverse, translations)


def camera_centers(quats_wxyz: Floats, translations: Floats) -> Floats:
    """Return camera centres ``-R^T t`` in the world (..., 3) of ``cam_from_world`` transforms."""
    return -rotate(invert_quats(quats_wxyz), translations)


def rotation_angles_deg(quats_a: Floats, quats_b: Floats) -> Floats:
    """Return angles (...) in degrees, 0 to 180, of rotations ``a b^-1`` of quaternions (..., 4).

    The half angle is ``atan2(|v|, |w|)``: unlike arccos of the scalar part or the trace, it keeps
    full precision near 0 and 180 degrees. Quaternions need not have unit length.
    """
    relative = multiply_quats(quats_a, _conjugate(quats_b))
    relative = relative / _squared_length(quats_b)[..., None]
    vector = relative[..., 1:]
    sine = np.linalg.norm(vector, axis=-1)
    half = np.arctan2(sine, np.abs(relative[..., 0]))
    scale = half / np.where(sine > 0, sine, 1.0)
    return np.rad2deg(2.0 * np.linalg.norm(scale[..., None] * vector, axis=-1))


def movement(old: RigidTransform, new: RigidTransform) -> tuple[float, float]:
    """Return the motion of a camera between two ``cam_from_world``: metres and degrees."""
    moved_m = float(np.linalg.norm(new.center() - old.center()))
    turned_deg = rotation_angles_deg(np.array(new.quat_wxyz), np.array(old.quat_wxyz))
    return moved_m, float(turned_deg)


def cross_matrix(vector: Floats) -> Floats:
    """Return ``[v]_x`` (3, 3) with ``[v]_x w = v x w``."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _conjugate(quats: Floats) -> Floats:
    return quats * np.array([1.0, -1.0, -1.0, -1.0])


def _squared_length(quats: Floats) -> Floats:
    w, x, y, z = np.moveaxis(quats, -1, 0)
    return w * w + x * x + y * y + z * z


def deviation_by_median(residuals: NDArray[np.floating[Any]]) -> np.float64:
    """Estimate a standard deviation from the median magnitude (Rousseeuw and Croux, JASA 1993)."""
    return _DEVIATION_OF_MEDIAN * np.median(np.abs(residuals))


def earth_from_enu(latitude_deg: float, longitude_deg: float, height_m: float) -> RigidTransform:
    """Return the transform from east, north, up at a position to ECEF, in metres."""
    lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    rotation = np.stack([east, np.cross(up, east), up], axis=1)
    normal = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(lat) ** 2)
    position = up * (normal + height_m)
    position[2] -= normal * _ECCENTRICITY_SQUARED * np.sin(lat)
    return RigidTransform.from_matrix(rotation, position)


def geodetic(ecef_m: Floats) -> tuple[float, float, float]:
    """Return latitude and longitude in degrees and height in metres of an ECEF position (3,)."""
    x, y, z = (float(value) for value in ecef_m)
    across = np.hypot(x, y)
    lat = np.arctan2(z, across * (1 - _ECCENTRICITY_SQUARED))
    for _ in range(_LATITUDE_ROUNDS):
        normal = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(lat) ** 2)
        lat = np.arctan2(z + normal * _ECCENTRICITY_SQUARED * np.sin(lat), across)
    height = across * np.cos(lat) + z * np.sin(lat)
    height -= _SEMI_MAJOR_M * np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(lat) ** 2)
    return float(np.degrees(lat)), float(np.degrees(np.arctan2(y, x))), float(height)


@dataclass(frozen=True)
class EarthAlignment:
    """The position of a map on earth: ``enu = enu_from_map(scale * x)``, ENU axes at ``origin``.

    ``residual_m`` is the median distance of the aligned camera centres from their GPS positions.
    """

    scale: float
    enu_from_map: RigidTransform
    origin: GeoPosition
    residual_m: float
    num_positions: int


def align_to_earth(
    centers: Mapping[str, Floats], positions: Mapping[str, GeoPosition]
) -> EarthAlignment:
    """Estimate scale and axes of a map from its camera centres (3,) and their positions on earth.

    The fit is by least squares (Umeyama 1991) with Cauchy weights. Raises DataError for fewer than
    three images, or if the images are too close together or on a line.
    """
    names = sorted(centers.keys() & positions.keys())
    if len(names) < 3:
        raise DataError(
            f"{len(names)} photographs of the map have a GPS position; the scale needs 3 or more"
        )
    on_earth = np.array([earth_from_enu(*positions[name]).translation for name in names])
    origin = geodetic(np.median(on_earth, axis=0))
    enu = earth_from_enu(*origin).inverse().apply(on_earth)
    local = np.array([centers[name] for name in names])
    weights = np.ones(len(names))
    for _ in range(_ALIGNING_ROUNDS):
        scale, rotation, translation = _similarity(local, enu, weights)
        residuals_m = np.linalg.norm(scale * local @ rotation.T + translation - enu, axis=1)
        weights = 1 / (1 + (residuals_m / max(float(np.median(residuals_m)), 1e-9)) ** 2)
    residual_m = float(np.median(residuals_m))
    spread_m = np.linalg.svd(scale * (local - np.median(local, axis=0)), compute_uv=False)[1]
    spread_m /= np.sqrt(len(names))
    if spread_m < _MIN_SPREAD * max(residual_m, _MIN_RESIDUAL_M):
        raise DataError(
            "the GPS positions do not determine the scale: the photographs spread over "
            f"{spread_m:.1f} m across their path, and the positions are accurate to "
            f"{max(residual_m, _MIN_RESIDUAL_M):.1f} m"
        )
    return EarthAlignment(
        scale, RigidTransform.from_matrix(rotation, translation), origin, residual_m, len(names)
    )


@dataclass(frozen=True, eq=False)
class PoseAlignment:
    """Similarity between two estimates of the same cameras: ``target = R(scale * source) + t``.

    ``agrees`` and ``agreed_before`` (N,) mark the poses that agree with and without the similarity.
    """

    scale: float
    target_from_source: RigidTransform
    agrees: NDArray[np.bool_]
    agreed_before: NDArray[np.bool_]


def align_poses(
    source: tuple[Floats, Floats], target: tuple[Floats, Floats], *, with_scale: bool = True
) -> PoseAlignment:
    """Align ``cam_from_source`` with ``cam_from_target``: quaternions (N, 4), translations (N, 3).

    A similarity (or rigid transform) is fitted to each of many pairs of poses. The transform with
    the most inliers is refitted to its inliers.
    """
    number = len(source[0])
    if number < 3:
        raise DataError(f"{number} poses have ground truth; an alignment needs 3 or more")
    centers = camera_centers(*source), camera_centers(*target)
    axes = rotation_matrices(source[0]), rotation_matrices(target[0])
    spread = np.median(np.linalg.norm(centers[1] - np.median(centers[1], axis=0), axis=1))

    def fit(rows: NDArray[np.integer[Any]]) -> tuple[float, Floats, Floats]:
        directions = tuple(array[rows].reshape(-1, 3) for array in axes)
        a, b = (array[rows] for array in centers)
        similarity = _similarity(a, b, np.ones(len(a)), directions)
        if with_scale:
            return similarity
        return 1.0, similarity[1], b.mean(axis=0) - similarity[1] @ a.mean(axis=0)

    def agreeing(scale: float, rotation: Floats, translation: Floats) -> NDArray[np.bool_]:
        aligned = scale * centers[0] @ rotation.T + translation
        distances = np.linalg.norm(aligned - centers[1], axis=1)
        # trace of rotation^T target_from_cam cam_from_source
        cosines = (np.einsum("nij,jk,nik->n", axes[1], rotation, axes[0]) - 1) / 2
        angles_deg = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
        near = distances <= _AGREEMENT_OF_SPREAD * spread
        return near & (angles_deg <= _AGREEMENT_DEG) & (scale > 0)

    rows = np.stack(np.triu_indices(number, 1), axis=1)
    if len(rows) > _ALIGNING_PAIRS:
        rows = np.random.default_rng(0).choice(rows, _ALIGNING_PAIRS, replace=False)
    agrees = np.zeros(number, np.bool_)
    for pair in rows:
        if np.any(centers[0][pair[0]] != centers[0][pair[1]]):
            inliers = agreeing(*fit(pair))
            agrees = inliers if inliers.sum() > agrees.sum() else agrees
    best = fit(np.flatnonzero(agrees) if agrees.sum() > 1 else np.arange(number))
    for _ in range(_ALIGNING_ROUNDS):
        inliers = agreeing(*best)
        if inliers.sum() <= agrees.sum():
            break
        agrees, best = inliers, fit(np.flatnonzero(inliers))
    scale, rotation, translation = best
    return PoseAlignment(
        scale,
        RigidTransform.from_matrix(rotation, translation),
        agreeing(*best),
        agreeing(1.0, np.eye(3), np.zeros(3)),
    )


def _similarity(
    source: Floats,
    target: Floats,
    weights: Floats,
    directions: tuple[Floats, ...] = (np.zeros((0, 3)), np.zeros((0, 3))),
) -> tuple[float, Floats, Floats]:
    """Fit ``target = scale * rotation @ source + translation``.

    The rotation also aligns ``directions`` of source and target.
    """
    from scipy.spatial.transform import Rotation

    means = [np.average(points, axis=0, weights=weights) for points in (source, target)]
    a, b = source - means[0], target - means[1]
    spread = float((weights * (a**2).sum(axis=1)).sum())
    if spread == 0:
        raise DataError(
            "all photographs were taken at one place, which does not determine the scale"
        )
    sizes = [np.sqrt((points**2).sum() / len(points)) or 1.0 for points in (a, b)]
    rotation = Rotation.align_vectors(
        np.concatenate([b / sizes[1], directions[1]]),
        np.concatenate([a / sizes[0], directions[0]]),
        weights=np.concatenate([weights, np.ones(len(directions[0]))]),
    )[0].as_matrix()
    scale = float((weights[:, None] * b * (a @ rotation.T)).sum()) / spread
    return scale, rotation, means[1] - scale * rotation @ means[0]


def perturbed(cam_from_world: RigidTransform, step: NDArray[np.float64]) -> RigidTransform:
    """Return ``exp(omega) R`` and ``exp(omega) t + v`` for a step (omega, v), omega in radians."""
    angle = float(np.linalg.norm(step[:3]))
    # sin(x / 2) / x, also at 0
    half_sinc = 0.5 * float(np.sinc(0.5 * angle / np.pi))
    x, y, z = (half_sinc * step[:3]).tolist()
    tx, ty, tz = step[3:].tolist()
    return RigidTransform((float(np.cos(0.5 * angle)), x, y, z), (tx, ty, tz)) @ cam_from_world


_COLMAP_FROM_OPENGL = RigidTransform((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
# a convention must explain this share of the data, and this much more than the poses as given
_MIN_SHARE, _MIN_GAIN = 0.4, 0.25
_TIE = 0.05  # conventions within this share of the best are named too


def _quaternion_last(pose: RigidTransform) -> RigidTransform:
    x, y, z, w = pose.quat_wxyz
    return RigidTransform((w, x, y, z), pose.translation)


def _center_given(pose: RigidTransform) -> RigidTransform:
    x, y, z = (-pose.rotation_matrix() @ pose.translation).tolist()
    return RigidTransform(pose.quat_wxyz, (x, y, z))


CONVENTIONS: Mapping[str, Callable[[RigidTransform], RigidTransform]] = {
    "poses inverted (camera-to-world, world_from_cam)": RigidTransform.inverse,
    "poses read with OpenGL's axes (y up, z back)": lambda pose: _COLMAP_FROM_OPENGL @ pose,
    "poses inverted and with OpenGL's axes (camera-to-world, y up, z back)": (
        lambda pose: _COLMAP_FROM_OPENGL @ pose.inverse()
    ),
    "translations read as camera centres": _center_given,
    "quaternions read as x, y, z, w": _quaternion_last,
}
"""Name of a convention -> function that converts a pose given in it to COLMAP's convention."""

READINGS: Sequence[Callable[[RigidTransform], RigidTransform]] = (
    lambda pose: pose,
    *CONVENTIONS.values(),
)
"""Functions that read a pose as given, then in each of :data:`CONVENTIONS`."""


def better_conventions(shares: Sequence[float]) -> list[str]:
    """Return the names of the conventions that explain far more than the poses as given.

    ``shares`` are the shares of data that each of :data:`READINGS` explains.
    """
    given, *others = shares
    best = max(others)
    if best < max(_MIN_SHARE, given + _MIN_GAIN):
        return []
    return [name for name, share in zip(CONVENTIONS, others, strict=True) if share >= best - _TIE]
