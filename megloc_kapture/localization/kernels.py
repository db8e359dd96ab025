"""Compiled loops over a map's index and a query's matches.

Imported where they are called, not where their module is: numba costs half a second to import. No
loop costs more for a larger map, except the one that builds the index.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import numpy as np

from megloc_kapture.compiling import compiled_loop


@compiled_loop
def group_by_image(image_ids, keypoint_ids, point_ids, offsets, keypoints, points):
    """Fill ``keypoints`` and ``points`` (O,) image by image, sorted by keypoint, then point."""
    keys = np.empty(len(image_ids), np.int64)
    ends = offsets[:-1].copy()
    for i in range(len(image_ids)):
        image = image_ids[i]
        keys[ends[image]] = (np.int64(keypoint_ids[i]) << 32) | np.int64(point_ids[i])
        ends[image] += 1
    for image in range(len(offsets) - 1):
        keys[offsets[image] : offsets[image + 1]].sort()
    for i in range(len(keys)):
        keypoints[i] = keys[i] >> 32
        points[i] = keys[i] & 0xFFFFFFFF


@compiled_loop
def _first_of(keypoint_ids, first, last, wanted):
    """First row of a keypoint between two rows, where they ascend; -1 where it is not there."""
    count = last - first
    if count == 0:
        return -1
    while count > 1:  # without a branch that nobody could predict
        half = count >> 1
        first += half * (keypoint_ids[first + half - 1] < wanted)
        count -= half
    return first if keypoint_ids[first] == wanted else -1


@compiled_loop
def observed(offsets, keypoint_ids, point_ids, rows, starts, pairs, scores):
    """The matches (T, 2) with a map keypoint that observes a point.

    Matches ``starts[i]`` to ``starts[i + 1]`` are with image ``rows[i]``, -1 where it is unknown.
    Returns keypoints, points, scores and ``i``, each (M,).
    """
    keypoints = np.empty(len(pairs), np.int64)
    points = np.empty(len(pairs), np.int64)
    similarities = np.empty(len(pairs), np.float64)
    images = np.empty(len(pairs), np.int64)
    count = 0
    for i in range(len(rows)):
        if rows[i] < 0:
            continue
        first = offsets[rows[i]]
        last = offsets[rows[i] + 1]
        for k in range(starts[i], starts[i + 1]):
            at = _first_of(keypoint_ids, first, last, pairs[k, 1])
            if at >= 0:
                keypoints[count] = pairs[k, 0]
                points[count] = point_ids[at]
                similarities[count] = scores[k]
                images[count] = i
                count += 1
    return keypoints[:count], points[:count], similarities[:count], images[:count]


@compiled_loop
def sightings(offsets, point_ids, rows):
    """Every observation of the images ``rows`` (n,) as one number: its point above its image."""
    total = 0
    for row in rows:
        if row >= 0:
            total += offsets[row + 1] - offsets[row]
    keys = np.empty(total, np.int64)
    k = 0
    for i in range(len(rows)):
        if rows[i] >= 0:
            for at in range(offsets[rows[i]], offsets[rows[i] + 1]):
                keys[k] = (np.int64(point_ids[at]) << 32) | i
                k += 1
    return keys


@compiled_loop
def count_shared(keys, shared):
    """Add to ``shared`` (n, n) the points that two images see, of sorted :func:`sightings`."""
    seeing = np.empty(len(shared), np.int64)
    begin = 0
    while begin < len(keys):
        point = keys[begin] >> 32
        count = 0
        end = begin
        while end < len(keys) and keys[end] >> 32 == point:
            owner = keys[end] & 0xFFFFFFFF
            if count == 0 or seeing[count - 1] != owner:
                seeing[count] = owner
                count += 1
            end += 1
        for a in range(count):
            for b in range(a + 1):
                shared[seeing[a], seeing[b]] += 1
        begin = end
    for a in range(len(shared)):
        for b in range(a):
            shared[b, a] = shared[a, b]


@compiled_loop
def choose(ranked, keypoints, points):
    """Mask of the pairs that are taken in the order ``ranked``, each keypoint and point once.

    ``keypoints`` and ``points`` count from 0 without gaps.
    """
    keypoint_used = np.zeros(len(ranked), np.bool_)
    point_used = np.zeros(len(ranked), np.bool_)
    chosen = np.zeros(len(ranked), np.bool_)
    for i in ranked:
        if not keypoint_used[keypoints[i]] and not point_used[points[i]]:
            keypoint_used[keypoints[i]] = True
            point_used[points[i]] = True
            chosen[i] = True
    return chosen
