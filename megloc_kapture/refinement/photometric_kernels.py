"""Compiled loops of photometric alignment; import only when needed, as numba loads slowly.

A residual is ``gain I(px) + bias - r`` of a point with reference value r; the query level I is
interpolated bilinearly, and the derivatives are exact for that interpolation.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.geometry.cameras import normalized_from_px
from megloc_kapture.geometry.projection import PINHOLES, distorted, model_id, packed_params
from megloc_kapture.values import Camera

_ROWS = 256


def camera_of(camera: Camera) -> tuple[int, NDArray[np.float64], float]:
    """Return model, parameters and squared tangent of the largest viewing angle of a camera."""
    across, down = np.linspace(0, camera.width, 17), np.linspace(0, camera.height, 17)
    border = np.concatenate(
        [
            [(x, y) for x in across for y in down[[0, -1]]],
            [(x, y) for x in across[[0, -1]] for y in down],
        ]
    )
    reach2 = float(np.nanmax(np.square(normalized_from_px(camera, border)).sum(1)))
    return model_id(camera), packed_params(camera), reach2


@compiled_loop
def _project(camera, r, t, points, shown_at):
    """Project points by the pose; fill camera coordinates, px, py, and derivatives of px and py.

    The viewing angle is limited because a distortion polynomial may fold back into the image.
    """
    model, p, reach2 = camera
    for k in range(len(points)):
        a, b, c = points[k, 0], points[k, 1], points[k, 2]
        x = r[0, 0] * a + r[0, 1] * b + r[0, 2] * c + t[0]
        y = r[1, 0] * a + r[1, 1] * b + r[1, 2] * c + t[1]
        z = r[2, 0] * a + r[2, 1] * b + r[2, 2] * c + t[2]
        shown = (z > 0.0) & (x * x + y * y <= reach2 * z * z)
        inverse = 1.0 / z
        fx, fy = p[0] * inverse, p[1] * inverse
        shown_at[0, k], shown_at[1, k], shown_at[2, k] = x, y, z
        shown_at[3, k] = fx * x + p[2] if shown else math.nan
        shown_at[4, k] = fy * y + p[3] if shown else math.nan
        shown_at[5, k], shown_at[6, k], shown_at[7, k] = fx, 0.0, -fx * x * inverse
        shown_at[8, k], shown_at[9, k], shown_at[10, k] = 0.0, fy, -fy * y * inverse
    if model <= PINHOLES:
        return
    for k in range(len(points)):
        if math.isnan(shown_at[3, k]):
            continue
        inverse = 1.0 / shown_at[2, k]
        u, v = shown_at[0, k] * inverse, shown_at[1, k] * inverse
        a, b, au, av, bu, bv = distorted(model, p, u, v)
        fx, fy = p[0] * inverse, p[1] * inverse
        shown_at[3, k], shown_at[4, k] = p[0] * a + p[2], p[1] * b + p[3]
        shown_at[5, k], shown_at[6, k], shown_at[7, k] = fx * au, fx * av, -fx * (au * u + av * v)
        shown_at[8, k], shown_at[9, k], shown_at[10, k] = fy * bu, fy * bv, -fy * (bu * u + bv * v)


@compiled_loop
def _corner(valid, x, y):
    """Return row and column of the upper left of the four pixels around a position, and its offset.

    Row and column are -1 if any of the four is invalid.
    """
    h, w = valid.shape
    # false for NaN too
    if x >= 0.0 and y >= 0.0 and x < w - 1 and y < h - 1:
        i, j = int(y), int(x)
        if valid[i, j] and valid[i, j + 1] and valid[i + 1, j] and valid[i + 1, j + 1]:
            return i, j, x - j, y - i
    return -1, -1, 0.0, 0.0


@compiled_loop
def _read(values, row, column, a, b, c):
    v00, v01 = values[row, column, c], values[row, column + 1, c]
    v10, v11 = values[row + 1, column, c], values[row + 1, column + 1, c]
    top, low = (1.0 - a) * v00 + a * v01, (1.0 - a) * v10 + a * v11
    value = (1.0 - b) * top + b * low
    return value, (1.0 - b) * (v01 - v00) + b * (v11 - v10), low - top


@compiled_loop
def read_values(values, valid, x, y, out, readable):
    """Interpolate ``values`` (h, w, C) bilinearly at N positions into ``out`` (N, C).

    ``readable`` (N,) marks positions between valid pixels.
    """
    for k in range(len(x)):
        row, column, a, b = _corner(valid, x[k], y[k])
        readable[k] = row >= 0
        if row < 0:
            continue
        for c in range(values.shape[2]):
            out[k, c] = _read(values, row, column, a, b, c)[0]


@compiled_loop
def evaluate(chosen, query, alignment, out):
    """Evaluate residuals and derivatives per point: ``out`` float64 (N, C, 8).

    ``out``: the residual (NaN where invisible, the rest is then unset), six derivatives for a left
    perturbation of the pose (rotation first), and the query's value. ``chosen``: points (N, 3),
    values (N, C) and reference index (N,). ``query``: a level (h, w, C), its valid pixels, its
    scale (2,) and its :func:`camera_of`. ``alignment``: rotation and translation of
    ``cam_from_world``, gains and biases (G, C).
    """
    points, values, groups = chosen
    level, valid, scale_xy, camera = query
    rotation, translation, gains, biases = alignment
    channels = values.shape[1]
    shown_at = np.empty((11, min(len(points), _ROWS)))
    for start in range(0, len(points), _ROWS):
        stop = min(start + _ROWS, len(points))
        _project(camera, rotation, translation, points[start:stop], shown_at)
        for k in range(start, stop):
            n = k - start
            px, py = shown_at[3, n] * scale_xy[0] - 0.5, shown_at[4, n] * scale_xy[1] - 0.5
            row, column, a, b = _corner(valid, px, py)
            if row < 0:
                for c in range(channels):
                    out[k, c, 0] = math.nan
                continue
            x, y, z = shown_at[0, n], shown_at[1, n], shown_at[2, n]
            group = groups[k]
            for c in range(channels):
                value, by_x, by_y = _read(level, row, column, a, b, c)
                gain = gains[group, c]
                gx, gy = gain * scale_xy[0] * by_x, gain * scale_xy[1] * by_y
                d0 = gx * shown_at[5, n] + gy * shown_at[8, n]
                d1 = gx * shown_at[6, n] + gy * shown_at[9, n]
                d2 = gx * shown_at[7, n] + gy * shown_at[10, n]
                out[k, c, 0] = gain * value + biases[group, c] - values[k, c]
                out[k, c, 1] = y * d2 - z * d1
                out[k, c, 2] = z * d0 - x * d2
                out[k, c, 3] = x * d1 - y * d0
                out[k, c, 4] = d0
                out[k, c, 5] = d1
                out[k, c, 6] = d2
                out[k, c, 7] = value


@compiled_loop
def normal_equations(rows, groups, squared_scale, sums):
    """Add up the robust normal equations of :func:`evaluate`; return cost sum and point count.

    A point's ``e^2`` is the mean of its squared residuals over channels, and its cost is Geman and
    McClure's ``s^2 / 2  e^2 / (s^2 + e^2)``; an infinite s^2 gives least squares. The results are
    added to ``sums``: the matrix of the pose (6, 6), upper half; pose with gain and bias (G, C, 6,
    2); entries (gain, gain), (gain, bias) and (bias, bias) (G, C, 3); gradients for the pose (6,)
    and for gain and bias (G, C, 2).
    """
    pose, mixed, blocks, pose_gradient, own_gradient = sums
    channels = rows.shape[1]
    cost = 0.0
    count = 0
    for k in range(len(rows)):
        if math.isnan(rows[k, 0, 0]):
            continue
        e2 = 0.0
        for c in range(channels):
            e2 += rows[k, c, 0] * rows[k, c, 0]
        e2 /= channels
        shrink = 1.0 / (1.0 + e2 / squared_scale)
        weight = shrink * shrink / channels
        cost += 0.5 * e2 * shrink
        count += 1
        group = groups[k]
        for c in range(channels):
            residual = weight * rows[k, c, 0]
            value = rows[k, c, 7]
            blocks[group, c, 0] += weight * value * value
            blocks[group, c, 1] += weight * value
            blocks[group, c, 2] += weight
            own_gradient[group, c, 0] += residual * value
            own_gradient[group, c, 1] += residual
            for i in range(6):
                d = rows[k, c, 1 + i]
                pose_gradient[i] += residual * d
                d *= weight
                mixed[group, c, i, 0] += d * value
                mixed[group, c, i, 1] += d
                for j in range(i, 6):
                    pose[i, j] += d * rows[k, c, 1 + j]
    return cost, count


@compiled_loop
def evaluated_equations(chosen, query, alignment, squared_scale, sums):
    """Add :func:`normal_equations` of :func:`evaluate`, in blocks that fit the cache."""
    points, values, groups = chosen
    rows = np.empty((min(len(points), _ROWS), values.shape[1], 8))
    cost = 0.0
    count = 0
    for start in range(0, len(points), _ROWS):
        stop = min(start + _ROWS, len(points))
        some = rows[: stop - start]
        part = points[start:stop], values[start:stop], groups[start:stop]
        evaluate(part, query, alignment, some)
        more, seen = normal_equations(some, groups[start:stop], squared_scale, sums)
        cost += more
        count += seen
    return cost, count


@compiled_loop
def splat_depths(points, camera, size_xy, cell_px, r, t, nearest, cells, depths):
    """Assign points (N, 3) to cells of an image; keep each cell's smallest depth in ``nearest``.

    Fills ``cells`` (N,) with flat cell indices, -1 outside the image, and ``depths`` (N,).
    """
    columns = nearest.shape[1]
    shown_at = np.empty((11, min(len(points), _ROWS)))
    for start in range(0, len(points), _ROWS):
        stop = min(start + _ROWS, len(points))
        _project(camera, r, t, points[start:stop], shown_at)
        for k in range(start, stop):
            z, px, py = shown_at[2, k - start], shown_at[3, k - start], shown_at[4, k - start]
            cells[k] = -1
            depths[k] = z
            if not (px >= 0.0 and py >= 0.0 and px < size_xy[0] and py < size_xy[1]):
                continue
            # a quotient may round up to the next cell
            row = min(int(py / cell_px), nearest.shape[0] - 1)
            column = min(int(px / cell_px), columns - 1)
            cells[k] = row * columns + column
            nearest[row, column] = min(nearest[row, column], z)


@compiled_loop
def strongest_per_cell(x, y, energy, wanted, cell_px, best):
    """Find the point with the largest ``energy`` (h, w) in each cell of a level.

    ``x`` and ``y`` (N,) are pixels of the level. ``best`` is filled with point indices, -1 for
    cells without a wanted point of positive energy.
    """
    best[:] = -1
    h, w = energy.shape
    top = np.zeros(best.shape, np.float32)
    for k in range(len(x)):
        if not wanted[k] or not (x[k] >= 0.0 and y[k] >= 0.0 and x[k] < w and y[k] < h):
            continue
        value = energy[int(y[k]), int(x[k])]
        row = min(int(y[k] / cell_px), best.shape[0] - 1)
        column = min(int(x[k] / cell_px), best.shape[1] - 1)
        if value > top[row, column]:
            top[row, column] = value
            best[row, column] = k
