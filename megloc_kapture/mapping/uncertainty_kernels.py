"""Compiled loops of the points' uncertainty. Imported only when needed: numba is slow to import."""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import math

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.geometry.projection import PINHOLES, distorted

# information whose pivots are this far apart does not determine its point
_MIN_RATIO = 1e-13
_MAX_SWEEPS = 16
_SMALL = 2.3e-16


@compiled_loop
def covariances_of_points(
    first, last, starts, image_ids, xyz, rotations, translations, models, params, out
):
    """Covariances of the points ``first`` to ``last``, rows of ``out`` (N, 6)."""
    for i in range(first, last):
        xx = xy = xz = yy = yz = zz = 0.0
        px, py, pz = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        for o in range(starts[i], starts[i + 1]):
            k = image_ids[o]
            r00, r01, r02 = rotations[k, 0, 0], rotations[k, 0, 1], rotations[k, 0, 2]
            r10, r11, r12 = rotations[k, 1, 0], rotations[k, 1, 1], rotations[k, 1, 2]
            r20, r21, r22 = rotations[k, 2, 0], rotations[k, 2, 1], rotations[k, 2, 2]
            x = r00 * px + r01 * py + r02 * pz + translations[k, 0]
            y = r10 * px + r11 * py + r12 * pz + translations[k, 1]
            z = r20 * px + r21 * py + r22 * pz + translations[k, 2]
            if not z > 0.0:
                continue  # behind the camera: such an observation says nothing
            inverse = 1.0 / z
            u, v = x * inverse, y * inverse
            au, av, bu, bv = 1.0, 0.0, 0.0, 1.0
            if models[k] > PINHOLES:  # to ask a pinhole too makes its loop twice as slow
                _, _, au, av, bu, bv = distorted(models[k], params[k], u, v)
            fx, fy = params[k, 0] * inverse, params[k, 1] * inverse
            # z times the derivatives of u and v by the point in the world
            u0, u1, u2 = r00 - u * r20, r01 - u * r21, r02 - u * r22
            v0, v1, v2 = r10 - v * r20, r11 - v * r21, r12 - v * r22
            a, b, c = fx * (au * u0 + av * v0), fx * (au * u1 + av * v1), fx * (au * u2 + av * v2)
            d, e, f = fy * (bu * u0 + bv * v0), fy * (bu * u1 + bv * v1), fy * (bu * u2 + bv * v2)
            xx += a * a + d * d
            xy += a * b + d * e
            xz += a * c + d * f
            yy += b * b + e * e
            yz += b * c + e * f
            zz += c * c + f * f
        # M = L D L^T, and its inverse from that
        least = _MIN_RATIO * (xx + yy + zz)
        determined = xx > least and xx < math.inf
        if determined:
            l10, l20 = xy / xx, xz / xx
            d1 = yy - l10 * xy
            determined = d1 > least
        if determined:
            l21 = (yz - l20 * xy) / d1
            d2 = zz - l20 * xz - l21 * l21 * d1
            determined = d2 > least
        if not determined:
            for column in range(6):
                out[i, column] = math.nan
            continue
        czz = 1.0 / d2
        cyz = -l21 * czz
        cyy = 1.0 / d1 - l21 * cyz
        cxz = -l10 * cyz - l20 * czz
        cxy = -l10 * cyy - l20 * cyz
        out[i, 0] = 1.0 / xx - l10 * cxy - l20 * cxz
        out[i, 1], out[i, 2], out[i, 3], out[i, 4], out[i, 5] = cxy, cxz, cyy, cyz, czz


@compiled_loop
def _rotated(a, b, ab, ac, bc):
    """One Jacobi rotation of axes a and b, c the third: the new entries, the new ``ab`` is zero."""
    if ab == 0.0:
        return a, b, ab, ac, bc
    theta = (b - a) / (2.0 * ab)
    t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
    if theta < 0.0:
        t = -t
    cosine = 1.0 / math.sqrt(t * t + 1.0)
    sine = t * cosine
    return a - t * ab, b + t * ab, 0.0, cosine * ac - sine * bc, sine * ac + cosine * bc


@compiled_loop
def deviations_of_points(first, last, covariances, out):
    """Square roots of the eigenvalues of covariances (N, 6), ascending, rows of ``out`` (N, 3).

    Cyclic Jacobi: slower than the closed formula, and accurate in the small eigenvalues too, where
    that is not (Golub and van Loan, Matrix Computations, section 8.5).
    """
    for i in range(first, last):
        a, b, c = covariances[i, 0], covariances[i, 3], covariances[i, 5]
        ab, ac, bc = covariances[i, 1], covariances[i, 2], covariances[i, 4]
        for _ in range(_MAX_SWEEPS):
            # each off-diagonal entry against its own diagonal: a small eigenvalue counts as much
            if (
                ab * ab <= _SMALL * _SMALL * a * b
                and ac * ac <= _SMALL * _SMALL * a * c
                and bc * bc <= _SMALL * _SMALL * b * c
            ):
                break
            a, b, ab, ac, bc = _rotated(a, b, ab, ac, bc)
            a, c, ac, ab, bc = _rotated(a, c, ac, ab, bc)
            b, c, bc, ab, ac = _rotated(b, c, bc, ab, ac)
        low, high = min(a, b), max(a, b)
        out[i, 0] = math.sqrt(min(low, c))
        out[i, 1] = math.sqrt(max(low, min(high, c)))
        out[i, 2] = math.sqrt(max(high, c))
