"""Compiled loop over a map's observations; import only where called: numba loads slowly."""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import math

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.geometry.projection import PINHOLES, distorted

# a point is undetermined if a pivot of its information matrix is at most this share of the trace
_MIN_RATIO = 1e-13


@compiled_loop
def covariances_of_points(
    first, last, starts, image_ids, xyz, rotations, translations, models, params, out
):
    """Compute covariances of the points ``first`` to ``last``, rows of ``out`` (N, 6)."""
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
                continue  # behind the camera
            inverse = 1.0 / z
            u, v = x * inverse, y * inverse
            au, av, bu, bv = 1.0, 0.0, 0.0, 1.0
            if models[k] > PINHOLES:  # skipping it for pinholes halves the time
                _, _, au, av, bu, bv = distorted(models[k], params[k], u, v)
            fx, fy = params[k, 0] * inverse, params[k, 1] * inverse
            # z times the derivatives of u and v with respect to the point in the world
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
        # factorize M = L D L^T, and compute the inverse from the factors
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
