"""Compiled loops of multi-view stereo: PatchMatch with slanted planes, and depth uncertainty.

A plane is stored as (w, wx, wy): its inverse depth at pixel offset (dx, dy) is
``w + wx dx + wy dy``, which is exact in a pinhole image.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import math

import numpy as np

from megloc_kapture.compiling import compiled_loop

_FLAT = np.float32(1e-6)  # a window with a smaller variance has no texture


@compiled_loop
def _part_score(values, weights, reach, source, u, v, ux, uy, vx, vy):
    """Return the weighted ZNCC over the part of a window that lies inside a source image.

    The result is -2 if that part has less than half of the weight, or no texture.
    """
    height, width = source.shape
    total, r, r2, s, s2, sr = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    k = 0
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            weight, template = weights[k], values[k]
            k += 1
            right, below = u + ux * j + uy * i, v + vx * j + vy * i
            if weight <= 0 or not (
                right >= 0 and below >= 0 and right < width - 1 and below < height - 1
            ):
                continue
            left, top = int(right), int(below)
            across, down = right - left, below - top
            upper = source[top, left] + across * (source[top, left + 1] - source[top, left])
            lower = source[top + 1, left]
            lower += across * (source[top + 1, left + 1] - source[top + 1, left])
            value = upper + down * (lower - upper)
            total += weight
            r += weight * template
            r2 += weight * template * template
            s += weight * value
            s2 += weight * value * value
            sr += weight * template * value
    if not total >= 0.5:
        return np.float32(-2)
    template_variance = r2 / total - (r / total) ** 2
    variance = s2 / total - (s / total) ** 2
    if not (template_variance > _FLAT and variance > _FLAT):
        return np.float32(-2)
    score = (sr / total - r * s / total**2) / math.sqrt(template_variance * variance)
    return np.float32(score)


@compiled_loop
def _plane_score(values, weights, reach, y, x, plane, source, infinity, baseline):
    """Return a window's ZNCC with a source image; -2 if mostly outside or without texture there.

    ``infinity`` (3, 3) is the homography of the plane at infinity, ``baseline`` (3,) the projected
    translation. The homography of ``plane`` is linearised at the window's centre.
    """
    w, wx, wy = plane[0], plane[1], plane[2]
    h = infinity
    px = h[0, 0] * x + h[0, 1] * y + h[0, 2] + baseline[0] * w
    py = h[1, 0] * x + h[1, 1] * y + h[1, 2] + baseline[1] * w
    pz = h[2, 0] * x + h[2, 1] * y + h[2, 2] + baseline[2] * w
    if not pz > 1e-6:
        return np.float32(-2)
    inverse = 1.0 / pz
    u, v = px * inverse, py * inverse
    down_x, down_y = h[2, 0] + baseline[2] * wx, h[2, 1] + baseline[2] * wy
    ux = (h[0, 0] + baseline[0] * wx - u * down_x) * inverse
    uy = (h[0, 1] + baseline[0] * wy - u * down_y) * inverse
    vx = (h[1, 0] + baseline[1] * wx - v * down_x) * inverse
    vy = (h[1, 1] + baseline[1] * wy - v * down_y) * inverse
    height, width = source.shape
    wide, high = reach * (abs(ux) + abs(uy)), reach * (abs(vx) + abs(vy))
    if not (u >= 0 and v >= 0 and u < width - 1 and v < height - 1):
        return np.float32(-2)
    if not (u >= wide and v >= high and u + wide < width - 1 and v + high < height - 1):
        return _part_score(values, weights, reach, source, u, v, ux, uy, vx, vy)
    ux, uy, vx, vy = np.float32(ux), np.float32(uy), np.float32(vx), np.float32(vy)
    s, s2, sr = np.float32(0), np.float32(0), np.float32(0)
    k = 0
    for i in range(-reach, reach + 1):
        at_x = np.float32(u) + uy * np.float32(i) - ux * np.float32(reach)
        at_y = np.float32(v) + vy * np.float32(i) - vx * np.float32(reach)
        for j in range(2 * reach + 1):
            right, below = at_x + ux * np.float32(j), at_y + vx * np.float32(j)
            left, top = int(right), int(below)
            across, down = right - np.float32(left), below - np.float32(top)
            upper, lower = source[top, left], source[top + 1, left]
            upper += across * (source[top, left + 1] - upper)
            lower += across * (source[top + 1, left + 1] - lower)
            value = upper + down * (lower - upper)
            weighted = weights[k] * value
            s += weighted
            s2 += weighted * value
            sr += weighted * values[k]
            k += 1
    variance = s2 - s * s
    if not variance > _FLAT:
        return np.float32(-2)
    return sr / np.float32(math.sqrt(variance))


@compiled_loop
def _plane_cost(values, weights, reach, y, x, plane, sources, infinities, baselines):
    """Return 1 - mean of the two best scores over the sources; 2 if no source sees the window."""
    first, second = np.float32(-2), np.float32(-2)
    for s in range(len(sources)):
        score = _plane_score(
            values, weights, reach, y, x, plane, sources[s], infinities[s], baselines[s]
        )
        second = max(second, min(first, score))
        first = max(first, score)
    if first < np.float32(-1.5):
        return np.float32(2)
    if second > np.float32(-1.5):
        return np.float32(1) - np.float32(0.5) * (first + second)
    return np.float32(1) - first


@compiled_loop
def _window(reference, reach, y, x, tone, values, weights):
    """Fill ``values`` and bilateral ``weights`` of a window; return False if it has no texture.

    Values have weighted mean 0 and standard deviation 1. ``tone`` is the scale of the brightness
    differences in the weights.
    """
    height, width = reference.shape
    centre = reference[y, x]
    k, total = 0, np.float32(0)
    scale = np.float32(0.5) / np.float32(reach * reach)
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            value, weight = centre, np.float32(0)
            if 0 <= y + i < height and 0 <= x + j < width:
                value = reference[y + i, x + j]
                weight = np.float32(
                    math.exp(-abs(value - centre) / tone - scale * np.float32(i * i + j * j))
                )
            values[k], weights[k] = value, weight
            total += weight
            k += 1
    mean = np.float32(0)
    for n in range(k):
        weights[n] /= total
        mean += weights[n] * values[n]
    variance = np.float32(0)
    for n in range(k):
        values[n] -= mean
        variance += weights[n] * values[n] * values[n]
    if not variance > _FLAT:
        return False
    spread = np.float32(math.sqrt(variance))
    for n in range(k):
        values[n] /= spread
    return True


@compiled_loop
def _noise(y, x, number, k):
    state = np.uint32(y * 73856093) ^ np.uint32(x * 19349663) ^ np.uint32(number * 83492791 + k)
    state = np.uint32((state ^ (state >> np.uint32(16))) * np.uint32(0x7FEB352D))
    state = np.uint32((state ^ (state >> np.uint32(15))) * np.uint32(0x846CA68B))
    state = np.uint32(state ^ (state >> np.uint32(16)))
    return float(state) / 2147483648.0 - 1.0


@compiled_loop
def refine_planes(
    reference, sources, infinities, baselines, planes, costs, reach, tone, number, step, limits
):
    """Update planes (H, W, 3) and costs (H, W) in place by pass ``number`` of PatchMatch.

    Passes alternate in direction (Bleyer et al., BMVC 2011). The candidates of a pixel are the
    planes of its two neighbours visited before, and three random perturbations of its plane: of
    inverse depth, of slope, and of both by half as much. Pass 0 also computes the initial costs.
    ``step`` is the largest perturbation of inverse depth in pass 0; it moves a projection by about
    a pixel, and each pass halves it. ``limits`` are the smallest and largest inverse depth.
    """
    height, width = reference.shape
    count = (2 * reach + 1) ** 2
    values, weights = np.empty(count, np.float32), np.empty(count, np.float32)
    candidate = np.empty(3, np.float64)
    direction = 1 if number % 2 == 0 else -1
    size = step * 0.5**number
    for i in range(height):
        y = i if direction > 0 else height - 1 - i
        for j in range(width):
            x = j if direction > 0 else width - 1 - j
            current = planes[y, x]
            if not _window(reference, reach, y, x, tone, values, weights):
                costs[y, x] = np.float32(2)
                continue
            if number == 0:
                costs[y, x] = _plane_cost(
                    values, weights, reach, y, x, current, sources, infinities, baselines
                )
            for k in range(5):
                if k == 0 or k == 1:
                    from_y, from_x = (y - direction, x) if k == 0 else (y, x - direction)
                    if from_y < 0 or from_y >= height or from_x < 0 or from_x >= width:
                        continue
                    other = planes[from_y, from_x]
                    candidate[1], candidate[2] = other[1], other[2]
                    candidate[0] = other[0] + direction * (other[2] if k == 0 else other[1])
                else:
                    scale = size if k < 4 else 0.5 * size
                    candidate[0], candidate[1], candidate[2] = current[0], current[1], current[2]
                    if k != 3:
                        candidate[0] += scale * _noise(y, x, number, 3 * k)
                    if k != 2:
                        candidate[1] += scale / reach * _noise(y, x, number, 3 * k + 1)
                        candidate[2] += scale / reach * _noise(y, x, number, 3 * k + 2)
                if candidate[0] < limits[0] or candidate[0] > limits[1]:
                    continue
                cost = _plane_cost(
                    values, weights, reach, y, x, candidate, sources, infinities, baselines
                )
                if cost < costs[y, x]:
                    costs[y, x] = cost
                    current[0], current[1], current[2] = candidate[0], candidate[1], candidate[2]


@compiled_loop
def plane_deviations(
    reference, sources, infinities, baselines, planes, reach, tone, calibration, out
):
    """Write the standard deviation of each pixel's inverse depth to ``out`` (H, W), 0 if unknown.

    A window of N pixels has brightness variance V, gradient g and correlation rho with a source; m
    is its motion along the epipolar line per unit of inverse depth. The least-squares bound on
    the inverse depth's variance is ``(1 - rho^2) V / (N mean((g m)^2))``, averaged harmonically
    over the sources with rho of at least 0.3. The square root of that mean is multiplied by
    ``calibration[1]``, and a matching error of ``calibration[0]`` pixels is added in quadrature.
    """
    height, width = reference.shape
    count = (2 * reach + 1) ** 2
    values, weights = np.empty(count, np.float32), np.empty(count, np.float32)
    for y in range(height):
        for x in range(width):
            out[y, x] = np.float32(0)
            if not _window(reference, reach, y, x, tone, values, weights):
                continue
            gxx, gxy, gyy, variance, mean = 0.0, 0.0, 0.0, 0.0, 0.0
            k = 0
            for i in range(-reach, reach + 1):
                for j in range(-reach, reach + 1):
                    if weights[k] > 0:
                        mean += weights[k] * reference[y + i, x + j]
                    k += 1
            k = 0
            for i in range(-reach, reach + 1):
                for j in range(-reach, reach + 1):
                    weight, row, column = weights[k], y + i, x + j
                    k += 1
                    if weight <= 0:
                        continue
                    left, right = max(column - 1, 0), min(column + 1, width - 1)
                    top, bottom = max(row - 1, 0), min(row + 1, height - 1)
                    gx = (reference[row, right] - reference[row, left]) / (right - left)
                    gy = (reference[bottom, column] - reference[top, column]) / (bottom - top)
                    gxx += weight * gx * gx
                    gxy += weight * gx * gy
                    gyy += weight * gy * gy
                    variance += weight * (reference[row, column] - mean) ** 2
            plane = planes[y, x]
            information, motion2, num_visible = 0.0, 0.0, 0
            for s in range(len(sources)):
                rho = _plane_score(
                    values, weights, reach, y, x, plane, sources[s], infinities[s], baselines[s]
                )
                if rho < 0.3:
                    continue
                h, b = infinities[s], baselines[s]
                inverse = 1.0 / (h[2, 0] * x + h[2, 1] * y + h[2, 2] + b[2] * plane[0])
                u = (h[0, 0] * x + h[0, 1] * y + h[0, 2] + b[0] * plane[0]) * inverse
                v = (h[1, 0] * x + h[1, 1] * y + h[1, 2] + b[1] * plane[0]) * inverse
                down_x, down_y = h[2, 0] + b[2] * plane[1], h[2, 1] + b[2] * plane[2]
                ux = (h[0, 0] + b[0] * plane[1] - u * down_x) * inverse
                uy = (h[0, 1] + b[0] * plane[2] - u * down_y) * inverse
                vx = (h[1, 0] + b[1] * plane[1] - v * down_x) * inverse
                vy = (h[1, 1] + b[1] * plane[2] - v * down_y) * inverse
                du, dv = (b[0] - u * b[2]) * inverse, (b[1] - v * b[2]) * inverse
                determinant = ux * vy - uy * vx
                if abs(determinant) < 1e-9:
                    continue
                mx, my = (vy * du - uy * dv) / determinant, (ux * dv - vx * du) / determinant
                slope = gxx * mx * mx + 2.0 * gxy * mx * my + gyy * my * my
                noise = max(1.0 - float(rho) ** 2, 1e-3) * variance
                information += count * slope / noise
                num_visible += 1
                motion2 = max(motion2, du * du + dv * dv)
            if information > 0.0 and motion2 > 0.0:
                bound = (
                    calibration[1] ** 2 * num_visible / information + calibration[0] ** 2 / motion2
                )
                out[y, x] = np.float32(math.sqrt(bound))
