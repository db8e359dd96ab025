"""Compiled loops over the observations of images: arrays in, arrays out.

Imported where they are called, not where their module is: numba costs half a second to import.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import numpy as np

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.geometry.projection import project_point


@compiled_loop
def most_shared(
    first, last, starts, of_image, images, track, track_starts, window, min_shared, best
):
    """Images that share most points with each of ``first`` to ``last``, rows of ``best`` (I, K).

    Parameters
    ----------
    starts, of_image : observations of image i, ``of_image[starts[i]:starts[i + 1]]``.
    images, track : of each observation; sorted by track, then image.
    track_starts : observations of track t, from ``track_starts[t]`` to ``track_starts[t + 1]``.
    window : how far in a track an image looks before and after itself.
    """
    shared = np.zeros(len(best), np.int64)
    touched = np.empty(len(best), np.int64)
    for image in range(first, last):
        count = 0
        for k in range(starts[image], starts[image + 1]):
            own = of_image[k]
            begin = max(track_starts[track[own]], own - window)
            end = min(track_starts[track[own] + 1], own + window + 1)
            for i in range(begin, end):
                other = images[i]
                if shared[other] == 0:
                    touched[count] = other
                    count += 1
                shared[other] += 1
        enough = 0
        for k in range(count):
            other = touched[k]
            if other != image and shared[other] >= min_shared:
                # most shared first, then the first image, as one number that ascends
                touched[enough] = (-shared[other] << 32) | other
                enough += 1
            shared[other] = 0
        ranked = np.sort(touched[:enough])
        for k in range(min(enough, best.shape[1])):
            best[image, k] = ranked[k] & 0xFFFFFFFF


@compiled_loop
def shares_seen(
    first, last, pairs, starts, points, xyz, rotations, translations, models, params, sizes, shares
):
    """Share of one image's points in the other's frustum, the larger of the two; ``shares`` (P,).

    NaN where neither image has points.
    """
    out = np.empty(8)
    for pair in range(first, last):
        shares[pair] = np.nan
        for side in range(2):
            begin, end = starts[pairs[pair, side]], starts[pairs[pair, side] + 1]
            if begin == end:
                continue
            other = pairs[pair, 1 - side]
            r, t, p = rotations[other], translations[other], params[other]
            seen = 0
            for k in range(begin, end):
                x, y, z = xyz[points[k], 0], xyz[points[k], 1], xyz[points[k], 2]
                project_point(
                    models[other],
                    p,
                    r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0],
                    r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1],
                    r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2],
                    out,
                )
                inside = 0.0 <= out[0] < sizes[other, 0] and 0.0 <= out[1] < sizes[other, 1]
                if inside and out[2] * out[6] > out[3] * out[5]:
                    seen += 1
            share = seen / (end - begin)
            if not shares[pair] >= share:
                shares[pair] = share
