"""Compiled loops for stereo: plane-sweep costs, semi-global paths, consistency between views.

Import only when needed: numba takes half a second to load. Brightness images are float32 (H, W),
NaN where invalid; inverse depth is float32 (H, W), 0 where unknown.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import math

import numpy as np

from megloc_kapture.compiling import compiled_loop

_FAR = np.float32(1e9)
_FLAT = np.float32(1e-6)


@compiled_loop
def window_sums(image, other, radius, row, columns, sums):
    """Sum image, image^2 and image * other over the windows of a row, into ``sums`` (3, W)."""
    height, width = image.shape
    for x in range(width):
        columns[0, x] = columns[1, x] = columns[2, x] = np.float32(0)
    for y in range(row - radius, row + radius + 1):
        if y < 0 or y >= height:
            for x in range(width):
                columns[0, x] = np.float32(np.nan)
            break
        for x in range(width):
            value = image[y, x]
            columns[0, x] += value
            columns[1, x] += value * value
            columns[2, x] += value * other[y, x]
    for k in range(3):
        for x in range(width):
            sums[k, x] = np.float32(np.nan)
        for x in range(radius, width - radius):
            sums[k, x] = columns[k, x - radius]
        for step in range(1 - radius, radius + 1):
            for x in range(radius, width - radius):
                sums[k, x] += columns[k, x + step]


@compiled_loop
def correlate(reference, warped, radius, costs):
    """Compute the matching cost for one plane, from the mean ZNCC of the two best sources.

    ``warped`` float32 (S, H, W) are the sources warped by the plane. ``costs`` uint8 (H, W) is
    filled with 255 (1 - mean), limited to 255. Pixels that no source sees also have the cost 255.
    """
    height, width = reference.shape
    num_sources = len(warped)
    area = np.float32((2 * radius + 1) ** 2)
    columns, sums = np.empty((3, width), np.float32), np.empty((3, width), np.float32)
    reference_sums = np.empty((3, width), np.float32)
    first, second = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(height):
        window_sums(reference, reference, radius, y, columns, reference_sums)
        for x in range(width):
            first[x] = second[x] = np.float32(-2)
        for s in range(num_sources):
            window_sums(warped[s], reference, radius, y, columns, sums)
            for x in range(width):
                above = sums[2, x] - sums[0, x] * reference_sums[0, x] / area
                spread = (sums[1, x] - sums[0, x] * sums[0, x] / area) * (
                    reference_sums[1, x] - reference_sums[0, x] * reference_sums[0, x] / area
                )
                score = above / np.float32(math.sqrt(max(spread, _FLAT)))
                score = score if score == score else np.float32(-2)
                second[x] = max(second[x], min(first[x], score))
                first[x] = max(first[x], score)
        for x in range(width):
            score = first[x]
            if second[x] > np.float32(-1.5):
                score = np.float32(0.5) * (first[x] + second[x])
            costs[y, x] = np.uint8(
                min(max(np.float32(255) * (np.float32(1) - score), 0), np.float32(255))
            )


@compiled_loop
def add_path(cost, grey, p1, p2, edge, dy, dx, total):
    """Add the costs of the best paths along one direction to ``total``.

    Equation 13 of Hirschmueller, PAMI 2008:
    ``L(p, d) = C(p, d) + min(L(q, d), L(q, d +- 1) + p1, min_k L(q, k) + p2') - min_k L(q, k)``
    with q = p - (dy, dx); here ``p2' = max(p1, floor(p2 edge / (edge + |I(p) - I(q)|)))``.
    """
    height, width, depth = cost.shape
    before = np.full((width, depth + 2), _FAR, np.float32)
    after = np.full((width, depth + 2), _FAR, np.float32)
    least_before, least_after = np.zeros(width, np.float32), np.zeros(width, np.float32)
    p1 = np.float32(p1)
    for i in range(height):
        y = i if dy >= 0 else height - 1 - i
        for j in range(width):
            x = j if dx >= 0 else width - 1 - j
            at = x - dx
            inside = 0 <= at < width and 0 <= y - dy < height
            here = after[x]
            least = _FAR
            if inside:
                last = after[at] if dy == 0 else before[at]
                low = least_after[at] if dy == 0 else least_before[at]
                step = abs(grey[y, x] - grey[y - dy, at])
                jump = np.float32(max(p1, math.floor(p2 * edge / (edge + step))))
                for d in range(depth):
                    best = min(last[d + 1], low + jump)
                    best = min(best, min(last[d], last[d + 2]) + p1)
                    value = np.float32(cost[y, x, d]) + best - low
                    here[d + 1] = value
                    total[y, x, d] += np.uint16(value)
            else:
                for d in range(depth):
                    value = np.float32(cost[y, x, d])
                    here[d + 1] = value
                    total[y, x, d] += np.uint16(value)
            for d in range(depth):
                least = min(least, here[d + 1])
            least_after[x] = least
        if dy != 0:
            before, after = after, before
            least_before, least_after = least_after, least_before


@compiled_loop
def best_labels(total, labels):
    """Fill ``labels`` (H, W) with the labels of least total, refined by fitting a parabola."""
    height, width, depth = total.shape
    for y in range(height):
        for x in range(width):
            costs = total[y, x]
            best = 0
            for d in range(1, depth):
                if costs[d] < costs[best]:
                    best = d
            offset = 0.0
            if 0 < best < depth - 1:
                low, middle, high = float(costs[best - 1]), float(costs[best]), costs[best + 1]
                bend = low - 2.0 * middle + high
                if bend > 0:
                    offset = min(max(0.5 * (low - high) / bend, -0.5), 0.5)
            labels[y, x] = best + offset


@compiled_loop
def count_agreeing(
    inverse, other, infinity, baseline, back_infinity, back_baseline, max_px, max_share, counts
):
    """Increment ``counts`` (H, W) where ``inverse`` agrees with another view after a round trip.

    The homography ``infinity`` (of points at infinity) and ``baseline`` project into the other
    view, ``back_infinity`` and ``back_baseline`` back into this one. ``max_px`` limits the
    round-trip error, ``max_share`` the relative depth difference.
    """
    height, width = inverse.shape
    rows, columns = other.shape
    h, b, g, c = infinity, baseline, back_infinity, back_baseline
    for y in range(height):
        for x in range(width):
            w = float(inverse[y, x])
            if w <= 0.0:
                continue
            pz = h[2, 0] * x + h[2, 1] * y + h[2, 2] + b[2] * w
            if pz <= 1e-9:
                continue
            u = (h[0, 0] * x + h[0, 1] * y + h[0, 2] + b[0] * w) / pz
            v = (h[1, 0] * x + h[1, 1] * y + h[1, 2] + b[1] * w) / pz
            column, row = int(math.floor(u + 0.5)), int(math.floor(v + 0.5))
            if column < 0 or row < 0 or column >= columns or row >= rows:
                continue
            other_inverse = float(other[row, column])
            if other_inverse <= 0.0:
                continue
            # extrapolate the other view's inverse depth linearly to the projection
            if 0 < column < columns - 1 and 0 < row < rows - 1:
                left, right = other[row, column - 1], other[row, column + 1]
                top, bottom = other[row - 1, column], other[row + 1, column]
                across, down = 0.5 * (right - left), 0.5 * (bottom - top)
                limit = 0.05 * other_inverse
                if left > 0 and right > 0 and abs(across) < limit:
                    other_inverse += across * (u - column)
                if top > 0 and bottom > 0 and abs(down) < limit:
                    other_inverse += down * (v - row)
            qz = g[2, 0] * u + g[2, 1] * v + g[2, 2] + c[2] * other_inverse
            if qz <= 1e-9:
                continue
            back_x = (g[0, 0] * u + g[0, 1] * v + g[0, 2] + c[0] * other_inverse) / qz
            back_y = (g[1, 0] * u + g[1, 1] * v + g[1, 2] + c[1] * other_inverse) / qz
            # (back_x, back_y, 1) qz = K X / z', X the point in this view, z' its depth in the other
            depth = qz / other_inverse
            if (back_x - x) ** 2 + (back_y - y) ** 2 > max_px * max_px:
                continue
            if abs(depth * w - 1.0) <= max_share:
                counts[y, x] += 1
