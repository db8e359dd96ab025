"""Compiled loops of the filters on points. Imported only when needed: numba is slow to import."""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import math

import numpy as np

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.geometry.projection import project_point


@compiled_loop
def reprojection_errors(
    point_ids, image_ids, keypoints, xyz, rotations, translations, models, params, out
):
    """Distances (O,) in pixels of keypoints (O, 2) from their points; infinite behind."""
    p = np.empty(8)
    for o in range(len(point_ids)):
        k = image_ids[o]
        r = rotations[k]
        x, y, z = xyz[point_ids[o], 0], xyz[point_ids[o], 1], xyz[point_ids[o], 2]
        project_point(
            models[k],
            params[k],
            r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + translations[k, 0],
            r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + translations[k, 1],
            r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + translations[k, 2],
            p,
        )
        du, dv = p[0] - keypoints[o, 0], p[1] - keypoints[o, 1]
        error = math.sqrt(du * du + dv * dv)
        out[o] = error if error == error else math.inf


@compiled_loop
def mean_depths(starts, image_ids, xyz, rotations, translations, out):
    """Mean depths (N,) of points in their images; NaN where no image observes one."""
    for i in range(len(xyz)):
        total = 0.0
        for o in range(starts[i], starts[i + 1]):
            k = image_ids[o]
            r = rotations[k]
            total += r[2, 0] * xyz[i, 0] + r[2, 1] * xyz[i, 1] + r[2, 2] * xyz[i, 2]
            total += translations[k, 2]
        count = starts[i + 1] - starts[i]
        out[i] = total / count if count > 0 else math.nan


@compiled_loop
def seen_at_angle(starts, image_ids, xyz, centers, max_cosine, out):
    """Whether two images see a point under an angle whose cosine is at most ``max_cosine``."""
    for i in range(len(xyz)):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        wide = False
        for o in range(starts[i], starts[i + 1]):
            a = image_ids[o]
            ax, ay, az = x - centers[a, 0], y - centers[a, 1], z - centers[a, 2]
            for other in range(o + 1, starts[i + 1]):
                b = image_ids[other]
                bx, by, bz = x - centers[b, 0], y - centers[b, 1], z - centers[b, 2]
                product = ax * bx + ay * by + az * bz
                lengths = math.sqrt((ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz))
                # of a centre that is the point itself there is no angle
                if lengths > 0.0 and abs(product) <= max_cosine * lengths:
                    wide = True
                    break
            if wide:
                break
        out[i] = wide
