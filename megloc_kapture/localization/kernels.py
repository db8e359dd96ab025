"""Compiled loops of the pose refinement, and over a map's index and a query's matches.

Imported where they are called, not where their module is: numba costs half a second to import. The
matches of a pose problem are those of
:attr:`megloc_kapture.localization.map_index.PoseProblem.matches`. No loop costs more for a larger
map, except the one that builds the index.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import math

import numpy as np

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.geometry.projection import moved, project_point

_MAX_STEPS = 20
# squared length in standard deviations (for one pixel) of a step that is the last one
_LAST_STEP = 1e-5
# damping of steps that help, and the first of those after one that did not
_LEAST_DAMPING, _DAMPING = 1e-9, 1e-4
# of a point that a step has put behind the camera: as if it were a hundred pixels off
_BEHIND = 1e4


@compiled_loop
def _chained(rc, tc, rotation, translation, r, t):
    """``cam_from_world`` into r (3, 3) and t (3,), of ``cam_from_rig`` and ``rig_from_world``."""
    for i in range(3):
        t[i] = tc[i]
        for j in range(3):
            r[i, j] = 0.0
            t[i] += rc[i, j] * translation[j]
            for k in range(3):
                r[i, j] += rc[i, k] * rotation[k, j]


@compiled_loop
def measure(matches, usable, rotation, translation, errors, whitening, squared, depths):
    """Fill what each match is by a pose: all (N,), ``whitening`` (N, 3).

    ``errors`` are in pixels, infinite behind the camera and where not usable; the others are
    filled where the error is finite. ``squared`` are the squared lengths of the whitened
    residuals: a residual has the covariance ``sigma^2 (I + J C J^T)``, the pixel's and the
    point's, J the derivative of the pixel by the point in the world. ``whitening`` is the inverse
    of its Cholesky factor for sigma 1: the elements (0, 0), (1, 0) and (1, 1).
    """
    points_px, points, covariances, starts, rotations, translations, models, params = matches
    out = np.empty(8)
    r, t = np.empty((3, 3)), np.empty(3)
    a = np.empty((2, 3))
    for view in range(len(models)):
        _chained(rotations[view], translations[view], rotation, translation, r, t)
        model = models[view]
        packed = params[view]
        for k in range(starts[view], starts[view + 1]):
            errors[k] = np.inf
            if not usable[k]:
                continue
            x, y, z = moved(r, t, points, k)
            project_point(model, packed, x, y, z, out)
            du = out[0] - points_px[k, 0]
            dv = out[1] - points_px[k, 1]
            error2 = du * du + dv * dv
            if not error2 < np.inf:  # NaN too
                continue
            errors[k] = math.sqrt(error2)
            depths[k] = z
            squared[k] = error2
            whitening[k, 0] = 1.0
            whitening[k, 1] = 0.0
            whitening[k, 2] = 1.0
            if len(covariances) == 0:
                continue
            for i in range(2):
                d0, d1, d2 = out[2 + 3 * i], out[3 + 3 * i], out[4 + 3 * i]
                for j in range(3):
                    a[i, j] = d0 * r[0, j] + d1 * r[1, j] + d2 * r[2, j]
            s00 = 1.0 + _quadratic(covariances, k, a, 0, 0)
            s01 = _quadratic(covariances, k, a, 0, 1)
            left = 1.0 + _quadratic(covariances, k, a, 1, 1) - s01 * s01 / s00
            # not so where the covariance is unknown (not finite), or none
            if s00 > 0.0 and s00 < np.inf and left > 0.0 and left < np.inf:
                w00 = 1.0 / math.sqrt(s00)
                w11 = 1.0 / math.sqrt(left)
                w10 = -s01 / s00 * w11
                whitening[k, 0] = w00
                whitening[k, 1] = w10
                whitening[k, 2] = w11
                squared[k] = (w00 * du) ** 2 + (w10 * du + w11 * dv) ** 2


@compiled_loop
def _quadratic(c, k, a, m, n):
    """``a[m]^T C a[n]`` of point k's symmetric C, stored as xx, xy, xz, yy, yz, zz."""
    return (
        a[m, 0] * (c[k, 0] * a[n, 0] + c[k, 1] * a[n, 1] + c[k, 2] * a[n, 2])
        + a[m, 1] * (c[k, 1] * a[n, 0] + c[k, 3] * a[n, 1] + c[k, 4] * a[n, 2])
        + a[m, 2] * (c[k, 2] * a[n, 0] + c[k, 4] * a[n, 1] + c[k, 5] * a[n, 2])
    )


@compiled_loop
def normal_equations(
    matches, inliers, whitening, rotation, translation, squared_scale, gradient, hessian
):
    """Cauchy cost of the whitened residuals, its gradient (6,) and its Hessian's upper half (6, 6).

    By a left perturbation of ``rig_from_world``, rotation first. With the loss' weight
    ``w = 1 / (1 + e^2 / c^2)`` of a residual of length e, the gradient sums ``w J^T r`` and the
    Hessian ``w^2 J^T J``, which is the expectation of the loss' own second derivative over the
    directions of r: positive, and steps by it converge faster than reweighted least squares. An
    infinite scale gives least squares, without a cost.
    """
    points_px, points, _, starts, rotations, translations, models, params = matches
    out = np.empty(8)
    r, t = np.empty((3, 3)), np.empty(3)
    first = np.empty(6)
    second = np.empty(6)
    gradient[:] = 0.0
    hessian[:] = 0.0
    logarithm = 0.0
    product = 1.0
    row = 0
    for view in range(len(models)):
        rc = rotations[view]
        _chained(rc, translations[view], rotation, translation, r, t)
        model = models[view]
        packed = params[view]
        while row < len(inliers) and inliers[row] < starts[view + 1]:
            k = inliers[row]
            x, y, z = moved(r, t, points, k)
            project_point(model, packed, x, y, z, out)
            w00, w10, w11 = whitening[k, 0], whitening[k, 1], whitening[k, 2]
            du = out[0] - points_px[k, 0]
            dv = out[1] - points_px[k, 1]
            e0 = w00 * du
            e1 = w10 * du + w11 * dv
            e2 = e0 * e0 + e1 * e1
            seen = e2 < np.inf  # not NaN
            if not seen:
                e2 = _BEHIND
            row += 1
            growth = 1.0 + e2 / squared_scale
            product *= growth
            if product > 1e200:  # one logarithm for many residuals
                logarithm += math.log(product)
                product = 1.0
            if not seen:
                continue
            weight = 1.0 / growth
            # the point in the rig, about whose origin the perturbation turns
            x, y, z = moved(rotation, translation, points, k)
            # whitened derivatives by the point in the camera, then in the rig
            a0 = w00 * out[2]
            a1 = w00 * out[3]
            a2 = w00 * out[4]
            b0 = w10 * out[2] + w11 * out[5]
            b1 = w10 * out[3] + w11 * out[6]
            b2 = w10 * out[4] + w11 * out[7]
            for j in range(3):
                first[3 + j] = a0 * rc[0, j] + a1 * rc[1, j] + a2 * rc[2, j]
                second[3 + j] = b0 * rc[0, j] + b1 * rc[1, j] + b2 * rc[2, j]
            # a^T (omega x p) = omega^T (p x a)
            first[0] = y * first[5] - z * first[4]
            first[1] = z * first[3] - x * first[5]
            first[2] = x * first[4] - y * first[3]
            second[0] = y * second[5] - z * second[4]
            second[1] = z * second[3] - x * second[5]
            second[2] = x * second[4] - y * second[3]
            w2 = weight * weight
            for i in range(6):
                gradient[i] += weight * (first[i] * e0 + second[i] * e1)
                f = w2 * first[i]
                s = w2 * second[i]
                for j in range(i, 6):
                    hessian[i, j] += f * first[j] + s * second[j]
    return 0.5 * squared_scale * (logarithm + math.log(product))


@compiled_loop
def _solve(hessian, damping, gradient, factor, step):
    """Step (6,) of ``(H + damping diag H) step = -gradient``; False where H is not positive."""
    for i in range(6):
        for j in range(i + 1):
            value = hessian[j, i]
            if i == j:
                value += damping * hessian[i, i]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                factor[i, i] = math.sqrt(value)
            else:
                factor[i, j] = value / factor[j, j]
    for i in range(6):
        value = -gradient[i]
        for k in range(i):
            value -= factor[i, k] * step[k]
        step[i] = value / factor[i, i]
    for i in range(5, -1, -1):
        value = step[i]
        for k in range(i + 1, 6):
            value -= factor[k, i] * step[k]
        step[i] = value / factor[i, i]
    return True


@compiled_loop
def _perturb(rotation, translation, step, new_rotation, new_translation):
    """``exp(omega) R`` (Rodrigues) and ``exp(omega) t + v`` of a step (omega, v)."""
    x, y, z = step[0], step[1], step[2]
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-16:
        a, b = 1.0, 0.5
    else:
        angle = math.sqrt(angle2)
        a = math.sin(angle) / angle
        b = 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    e = np.empty((3, 3))
    e[0, 0] = 1.0 - b * (y * y + z * z)
    e[1, 1] = 1.0 - b * (x * x + z * z)
    e[2, 2] = 1.0 - b * (x * x + y * y)
    e[0, 1] = b * x * y - a * z
    e[1, 0] = b * x * y + a * z
    e[0, 2] = b * x * z + a * y
    e[2, 0] = b * x * z - a * y
    e[1, 2] = b * y * z - a * x
    e[2, 1] = b * y * z + a * x
    _chained(e, step[3:], rotation, translation, new_rotation, new_translation)


@compiled_loop
def levenberg_marquardt(matches, inliers, whitening, rotation, translation, sigma, squared_scale):
    """The rotation and translation that minimise the Cauchy cost of that scale, from given ones."""
    new_rotation, new_translation = rotation.copy(), translation.copy()
    rotation, translation = rotation.copy(), translation.copy()
    gradient, new_gradient = np.empty(6), np.empty(6)
    hessian, new_hessian, factor = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    step = np.zeros(6)
    cost = np.inf
    damping = 0.1 * _LEAST_DAMPING
    for _ in range(_MAX_STEPS):
        new_cost = normal_equations(
            matches,
            inliers,
            whitening,
            new_rotation,
            new_translation,
            squared_scale,
            new_gradient,
            new_hessian,
        )
        if new_cost < cost:
            cost = new_cost
            rotation, new_rotation = new_rotation, rotation
            translation, new_translation = new_translation, translation
            gradient, new_gradient = new_gradient, gradient
            hessian, new_hessian = new_hessian, hessian
            damping = max(0.1 * damping, _LEAST_DAMPING)
        else:
            damping = max(10.0 * damping, _DAMPING)
        while not _solve(hessian, damping, gradient, factor, step):
            damping = max(10.0 * damping, _DAMPING)
            if not damping < np.inf:
                return rotation, translation
        _perturb(rotation, translation, step, new_rotation, new_translation)
        decrement = 0.0
        for i in range(6):
            decrement -= gradient[i] * step[i]
        if decrement < _LAST_STEP * sigma * sigma:
            return new_rotation, new_translation
    return rotation, translation


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
