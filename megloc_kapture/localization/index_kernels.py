"""Compiled loops over a map's index and a query's matches: arrays in, arrays out.

Imported where they are called, not where their module is: numba costs half a second to import.
Whatever is sorted is sorted stably by digits (least significant first), which is linear in the
number of keys and gives the same order everywhere. No loop costs more for a larger map, except the
one that builds the index.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import numpy as np

from megloc_kapture.compiling import compiled_loop

_U = np.uint64
_SIGN = _U(1 << 63)
_DIGIT = 11
_DIGITS = 1 << _DIGIT
_LOW = _U(_DIGITS - 1)


@compiled_loop
def _sorted_by(keys, order):
    """``order``, int64 indices into ``keys`` (uint64), stably sorted by them; uses ``order`` up."""
    count = len(order)
    if count == 0:
        return order
    varying = _U(0)
    for i in range(count):
        varying |= keys[order[i]] ^ keys[order[0]]
    spare = np.empty(count, np.int64)
    starts = np.empty(_DIGITS, np.int64)
    for shift in range(0, 64, _DIGIT):
        bits = _U(shift)
        if (varying >> bits) & _LOW == _U(0):
            continue
        starts[:] = 0
        for i in range(count):
            starts[np.int64((keys[order[i]] >> bits) & _LOW)] += 1
        total = 0
        for digit in range(_DIGITS):
            size = starts[digit]
            starts[digit] = total
            total += size
        for i in range(count):
            here = np.int64((keys[order[i]] >> bits) & _LOW)
            spare[starts[here]] = order[i]
            starts[here] += 1
        order, spare = spare, order
    return order


@compiled_loop
def _sorted_from_bit(keys, lowest):
    """``keys``, int64 and not negative, stably sorted by the bits from ``lowest`` on; used up."""
    varying = np.int64(0)
    for key in keys:
        varying |= key ^ keys[0]
    spare = np.empty_like(keys)
    starts = np.empty(_DIGITS, np.int64)
    for shift in range(lowest, 63, _DIGIT):
        if (varying >> shift) & (_DIGITS - 1) == 0:
            continue
        starts[:] = 0
        for key in keys:
            starts[(key >> shift) & (_DIGITS - 1)] += 1
        total = 0
        for digit in range(_DIGITS):
            size = starts[digit]
            starts[digit] = total
            total += size
        for key in keys:
            here = (key >> shift) & (_DIGITS - 1)
            spare[starts[here]] = key
            starts[here] += 1
        keys, spare = spare, keys
    return keys


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
def shared_points(offsets, point_ids, rows):
    """How many points every two of the images observe both, int64 (n, n); see ``MapIndex``."""
    total = 0
    for row in rows:
        if row >= 0:
            total += offsets[row + 1] - offsets[row]
    # a point above the image that sees it, in one number: sorted without looking anything up
    keys = np.empty(total, np.int64)
    k = 0
    for i in range(len(rows)):
        if rows[i] >= 0:
            for at in range(offsets[rows[i]], offsets[rows[i] + 1]):
                keys[k] = (np.int64(point_ids[at]) << 32) | i
                k += 1
    keys = _sorted_from_bit(keys, 32)
    shared = np.zeros((len(rows), len(rows)), np.int64)
    seeing = np.empty(len(rows), np.int64)
    begin = 0
    while begin < total:
        point = keys[begin] >> 32
        count = 0
        end = begin
        # the order is stable: the images of a point come in ascending order
        while end < total and keys[end] >> 32 == point:
            owner = keys[end] & 0xFFFFFFFF
            if count == 0 or seeing[count - 1] != owner:
                seeing[count] = owner
                count += 1
            end += 1
        for a in range(count):
            for b in range(a + 1):
                shared[seeing[a], seeing[b]] += 1
        begin = end
    for a in range(len(rows)):
        for b in range(a):
            shared[b, a] = shared[a, b]
    return shared


@compiled_loop
def resolve(keypoint_ids, point_ids, similarities, image_rows, taken):
    """One point per keypoint and one keypoint per point, of the matches with ``taken`` images.

    Returns keypoints, points and support, all int64, sorted by keypoint.
    """
    total = 0
    order = np.empty(len(keypoint_ids), np.int64)
    for i in range(len(keypoint_ids)):
        if taken[image_rows[i]]:
            order[total] = i
            total += 1
    order = _sorted_by(point_ids.view(np.uint64), order[:total])
    order = _sorted_by(keypoint_ids.view(np.uint64), order)

    # every distinct pair once, sorted by keypoint, then point
    keypoints = np.empty(total, np.int64)
    points = np.empty(total, np.int64)
    best = np.empty(total, np.float64)
    support = np.zeros(total, np.int64)
    count = 0
    for i in order:
        similarity = similarities[i] + 0.0  # of minus zero: zero
        new = count == 0 or keypoints[count - 1] != keypoint_ids[i]
        if new or points[count - 1] != point_ids[i]:
            keypoints[count] = keypoint_ids[i]
            points[count] = point_ids[i]
            best[count] = similarity
            count += 1
        elif similarity > best[count - 1]:
            best[count - 1] = similarity
        support[count - 1] += 1

    # best pair first: most support, then highest similarity, then smallest ids
    falling = best[:count].view(np.uint64)
    for i in range(count):
        if falling[i] & _SIGN == _U(0):
            falling[i] = ~(falling[i] | _SIGN)
    ranked = _sorted_by(falling, np.arange(count))
    ranked = _sorted_by(~support[:count].view(np.uint64), ranked)

    # small numbers for the points, so that what is used up can be marked in an array
    by_point = _sorted_by(points[:count].view(np.uint64), np.arange(count))
    number = np.empty(count, np.int64)
    for i in range(count):
        here = by_point[i]
        if i == 0:
            number[here] = 0
        else:
            before = by_point[i - 1]
            number[here] = number[before] + (points[here] != points[before])
    first = np.empty(count, np.int64)  # pair of the same keypoint
    for i in range(count):
        first[i] = first[i - 1] if i and keypoints[i] == keypoints[i - 1] else i

    point_used = np.zeros(count, np.bool_)
    keypoint_used = np.zeros(count, np.bool_)
    chosen = np.zeros(count, np.bool_)
    for i in ranked:
        if not keypoint_used[first[i]] and not point_used[number[i]]:
            keypoint_used[first[i]] = True
            point_used[number[i]] = True
            chosen[i] = True
    return keypoints[:count][chosen], points[:count][chosen], support[:count][chosen]
