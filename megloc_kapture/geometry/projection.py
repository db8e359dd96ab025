"""Compiled projection of points with derivatives, and of depth maps, in COLMAP's camera models.

The models follow COLMAP's ``sensor/models.h``, including its expansions near the axis. Import this
module lazily: numba takes half a second to load.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, ONE_FOCAL_MODELS, Camera, RigidTransform

NUM_PARAMS = 12

_NUMBERS = {name: number for number, name in enumerate(CAMERA_MODEL_NUM_PARAMS)}
PINHOLES = _NUMBERS["PINHOLE"]
_SIMPLE_RADIAL, _RADIAL = _NUMBERS["SIMPLE_RADIAL"], _NUMBERS["RADIAL"]
_OPENCV, _FULL_OPENCV, _FOV = _NUMBERS["OPENCV"], _NUMBERS["FULL_OPENCV"], _NUMBERS["FOV"]
_THIN_PRISM_FISHEYE = _NUMBERS["THIN_PRISM_FISHEYE"]

_FOV_EPSILON = 1e-4  # COLMAP's
# below this radius the series expansion of the angle has double precision
_NEAR_AXIS = 1e-3
# a pixel centre on an edge belongs to both triangles despite rounding
_ON_EDGE = 1e-6


def model_id(camera: Camera) -> int:
    """Return the model number for :func:`project_point`."""
    return _NUMBERS[camera.model]


def packed_params(camera: Camera) -> NDArray[np.float64]:
    """Return parameters for :func:`project_point`: float64 (12,) fx, fy, cx, cy, others, zeros."""
    packed = np.zeros(NUM_PARAMS)
    params = camera.params
    if camera.model in ONE_FOCAL_MODELS:
        params = (params[0], *params)
    packed[: len(params)] = params
    return packed


def packed_views(
    cameras: Sequence[Camera], cams_from_world: Sequence[RigidTransform]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Return rotations (I, 3, 3), translations (I, 3), models (I,) and parameters (I, 12)."""
    return (
        np.array([pose.rotation_matrix() for pose in cams_from_world]).reshape(-1, 3, 3),
        np.array([pose.translation for pose in cams_from_world], np.float64).reshape(-1, 3),
        np.array([model_id(camera) for camera in cameras], np.int64),
        np.array([packed_params(camera) for camera in cameras]).reshape(-1, NUM_PARAMS),
    )


def project_with_jacobian(
    camera: Camera, points_in_cam: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Project points (N, 3) in the camera frame: pixels (N, 2), derivatives (N, 2, 3).

    The first pixel's centre is (0.5, 0.5); NaN behind the camera.
    """
    points = np.ascontiguousarray(points_in_cam, dtype=np.float64).reshape(-1, 3)
    out = np.empty((len(points), 8))
    _project_all(model_id(camera), packed_params(camera), points, out)
    return out[:, :2].copy(), out[:, 2:].reshape(-1, 2, 3).copy()


@compiled_loop
def _angle(r):
    """Return ``atan(r) / r`` and its derivative with respect to r, divided by r."""
    if r < _NEAR_AXIS:
        r2 = r * r
        return 1.0 - r2 / 3.0 + r2 * r2 / 5.0, -2.0 / 3.0 + 0.8 * r2
    theta = math.atan(r)
    return theta / r, (1.0 / (1.0 + r * r) - theta / r) / (r * r)


@compiled_loop
def _radial_factor(model, p, r):
    """Return the factor of (u, v) in radially symmetric models.

    Also return its derivative with respect to r, divided by r.
    """
    r2 = r * r
    if model in (_SIMPLE_RADIAL, _RADIAL):
        return 1.0 + r2 * (p[4] + r2 * p[5]), 2.0 * p[4] + 4.0 * p[5] * r2
    if model == _FOV:
        omega = p[4]
        omega2 = omega * omega
        if omega2 < _FOV_EPSILON:
            return omega2 * r2 / 3.0 - omega2 / 12.0 + 1.0, 2.0 * omega2 / 3.0
        tan_half = math.tan(omega / 2.0)
        if r2 < _FOV_EPSILON:
            factor = -2.0 * tan_half * (4.0 * r2 * tan_half * tan_half - 3.0) / (3.0 * omega)
            return factor, -16.0 * tan_half**3 / (3.0 * omega)
        scaled = 2.0 * r * tan_half
        angle = math.atan(scaled)
        slope = 2.0 * tan_half / (1.0 + scaled * scaled)
        return angle / (r * omega), (slope - angle / r) / (r2 * omega)
    # fisheye models: theta (1 + k1 theta^2 + ...) / r
    per_r, slope = _angle(r)
    theta = per_r * r
    t2 = theta * theta
    k1, k2, k3, k4 = p[4], p[5], p[6], p[7]
    scale = 1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
    scale_slope = 2.0 * k1 + t2 * (4.0 * k2 + t2 * (6.0 * k3 + t2 * 8.0 * k4))
    # d theta / d r = 1 / (1 + r^2)
    return per_r * scale, slope * scale + per_r * scale_slope * per_r / (1.0 + r * r)


@compiled_loop
def _not_radial(model, p, u, v):
    """Return distorted (x, y) in models without radial symmetry, and the four derivatives."""
    u2, v2, uv = u * u, v * v, u * v
    r2 = u2 + v2
    if model == _OPENCV:
        radial, slope = 1.0 + r2 * (p[4] + r2 * p[5]), p[4] + 2.0 * p[5] * r2
        p1, p2, s1, s2 = p[6], p[7], 0.0, 0.0
    elif model == _FULL_OPENCV:
        above = 1.0 + r2 * (p[4] + r2 * (p[5] + r2 * p[8]))
        below = 1.0 + r2 * (p[9] + r2 * (p[10] + r2 * p[11]))
        above_slope = p[4] + r2 * (2.0 * p[5] + r2 * 3.0 * p[8])
        below_slope = p[9] + r2 * (2.0 * p[10] + r2 * 3.0 * p[11])
        radial = above / below
        slope = (above_slope - radial * below_slope) / below
        p1, p2, s1, s2 = p[6], p[7], 0.0, 0.0
    else:  # THIN_PRISM_FISHEYE, where u and v are angles
        radial = 1.0 + r2 * (p[4] + r2 * (p[5] + r2 * (p[8] + r2 * p[9])))
        slope = p[4] + r2 * (2.0 * p[5] + r2 * (3.0 * p[8] + r2 * 4.0 * p[9]))
        p1, p2, s1, s2 = p[6], p[7], p[10], p[11]
    x = u * radial + 2.0 * p1 * uv + p2 * (r2 + 2.0 * u2) + s1 * r2
    y = v * radial + 2.0 * p2 * uv + p1 * (r2 + 2.0 * v2) + s2 * r2
    # slope is the derivative with respect to r^2, whose derivatives are 2u and 2v
    cross = 2.0 * uv * slope
    xu = radial + 2.0 * u2 * slope + 2.0 * p1 * v + 6.0 * p2 * u + 2.0 * s1 * u
    xv = cross + 2.0 * p1 * u + 2.0 * p2 * v + 2.0 * s1 * v
    yu = cross + 2.0 * p2 * v + 2.0 * p1 * u + 2.0 * s2 * u
    yv = radial + 2.0 * v2 * slope + 2.0 * p2 * u + 6.0 * p1 * v + 2.0 * s2 * v
    return x, y, xu, xv, yu, yv


@compiled_loop
def distorted(model, p, u, v):
    """Distort normalised coordinates ``u = x / z``, ``v = y / z`` to a, b.

    Returns a, b, da/du, da/dv, db/du, db/dv; the pixel is ``(p[0] a + p[2], p[1] b + p[3])``.
    ``model`` and ``p`` are :func:`model_id` and :func:`packed_params`.
    """
    if model <= PINHOLES:
        return u, v, 1.0, 0.0, 0.0, 1.0
    if model in (_OPENCV, _FULL_OPENCV):
        return _not_radial(model, p, u, v)
    if model == _THIN_PRISM_FISHEYE:
        factor, slope = _angle(math.sqrt(u * u + v * v))
        a, b, ds, dt, es, et = _not_radial(model, p, u * factor, v * factor)
        su, sv, tv = factor + slope * u * u, slope * u * v, factor + slope * v * v
        return a, b, ds * su + dt * sv, ds * sv + dt * tv, es * su + et * sv, es * sv + et * tv
    factor, slope = _radial_factor(model, p, math.sqrt(u * u + v * v))
    cross = slope * u * v
    return u * factor, v * factor, factor + slope * u * u, cross, cross, factor + slope * v * v


@compiled_loop
def project_point(model, p, x, y, z, out):
    """Write pixel x, y and their derivatives to ``out`` (8,); NaN behind the camera.

    ``model`` and ``p`` are :func:`model_id` and :func:`packed_params`.
    """
    if not z > 0.0:
        for i in range(8):
            out[i] = math.nan
        return
    inverse = 1.0 / z
    u, v = x * inverse, y * inverse
    a, b, au, av, bu, bv = distorted(model, p, u, v)
    fx, fy = p[0] * inverse, p[1] * inverse
    out[0], out[1] = p[0] * a + p[2], p[1] * b + p[3]
    out[2], out[3], out[4] = fx * au, fx * av, -fx * (au * u + av * v)
    out[5], out[6], out[7] = fy * bu, fy * bv, -fy * (bu * u + bv * v)


@compiled_loop
def _project_all(model, p, points, out):
    for i in range(len(points)):
        project_point(model, p, points[i, 0], points[i, 1], points[i, 2], out[i])


def draw_depth_surface(
    depth_m: NDArray[np.float32],
    rays: NDArray[np.float64],
    view_from_depth: RigidTransform,
    view: Camera,
    *,
    max_jump: float,
    near_m: float,
    field: float,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Render a depth map as a surface of small triangles into another view's depth buffer.

    The triangles join neighbouring pixels and leave no holes at any zoom; jumps in depth cut the
    surface. Inverse depth is interpolated: for a plane it is linear in undistorted pixels.
    Returns depth (H, W), infinite without a surface, and a mask (H, W) of front faces.

    Parameters
    ----------
    depth_m : float32 (R, C); 0, negative or not finite where unknown.
    rays : (R * C, 3) through the pixel centres of the depth map, z = 1, in its camera's frame.
    max_jump : largest difference between neighbouring depths, as a share of the nearer.
    near_m : smallest depth in the view.
    field : largest tangent of the angle between a ray and the optical axis of the view.
    """
    rows, columns = depth_m.shape
    depth = np.ascontiguousarray(depth_m, np.float64)
    px, z = np.empty((rows, columns, 2)), np.empty((rows, columns))
    pose = view_from_depth.rotation_matrix(), np.array(view_from_depth.translation)
    camera = model_id(view), packed_params(view)
    _project(depth, rays.reshape(rows, columns, 3), *pose, *camera, near_m, field, px, z)
    inverse = np.zeros((view.height, view.width))
    front = np.zeros((view.height, view.width), np.bool_)
    _draw(depth, px, z, max_jump, inverse, front)
    with np.errstate(divide="ignore"):
        return 1.0 / inverse, front


@compiled_loop
def _project(depth, rays, rotation, translation, model, params, near_m, field, px, z):
    """Project the points of a depth map into the view; NaN for points outside its field."""
    rows, columns = depth.shape
    out = np.empty(8)
    for r in range(rows):
        for c in range(columns):
            d = depth[r, c]
            px[r, c, 0] = px[r, c, 1] = z[r, c] = math.nan
            if not (d > 0.0 and d < math.inf):
                continue
            x0, y0, z0 = rays[r, c, 0] * d, rays[r, c, 1] * d, rays[r, c, 2] * d
            at = (
                rotation[0, 0] * x0 + rotation[0, 1] * y0 + rotation[0, 2] * z0 + translation[0],
                rotation[1, 0] * x0 + rotation[1, 1] * y0 + rotation[1, 2] * z0 + translation[1],
                rotation[2, 0] * x0 + rotation[2, 1] * y0 + rotation[2, 2] * z0 + translation[2],
            )
            if at[2] > near_m and math.hypot(at[0], at[1]) <= field * at[2]:
                project_point(model, params, at[0], at[1], at[2], out)
                px[r, c, 0], px[r, c, 1], z[r, c] = out[0], out[1], at[2]


@compiled_loop
def _joined(a, b, max_jump):
    return abs(a - b) <= max_jump * min(a, b)


@compiled_loop
def _triangle(px, z, ar, ac, br, bc, cr, cc, inverse, front):
    """Draw one triangle, whose corners are clockwise in the depth map (y down)."""
    ax, ay = px[ar, ac, 0], px[ar, ac, 1]
    bx, by = px[br, bc, 0], px[br, bc, 1]
    cx, cy = px[cr, cc, 0], px[cr, cc, 1]
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if not abs(area) > 1e-12:  # seen edge on, or NaN
        return
    height, width = inverse.shape
    left = max(0, math.ceil(min(ax, bx, cx) - 0.5 - _ON_EDGE))
    right = min(width - 1, math.floor(max(ax, bx, cx) - 0.5 + _ON_EDGE))
    top = max(0, math.ceil(min(ay, by, cy) - 0.5 - _ON_EDGE))
    bottom = min(height - 1, math.floor(max(ay, by, cy) - 0.5 + _ON_EDGE))
    a_inverse, b_inverse, c_inverse = 1.0 / z[ar, ac], 1.0 / z[br, bc], 1.0 / z[cr, cc]
    for row in range(top, bottom + 1):
        y = row + 0.5
        for column in range(left, right + 1):
            x = column + 0.5
            b = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
            c = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
            a = 1.0 - b - c
            if a < -_ON_EDGE or b < -_ON_EDGE or c < -_ON_EDGE:
                continue
            value = a * a_inverse + b * b_inverse + c * c_inverse
            if value > inverse[row, column]:
                inverse[row, column] = value
                front[row, column] = area > 0.0


@compiled_loop
def _draw(depth, px, z, max_jump, inverse, front):
    rows, columns = depth.shape
    visible = np.zeros((rows, columns), np.bool_)
    for r in range(rows):
        for c in range(columns):
            visible[r, c] = math.isfinite(px[r, c, 0] + px[r, c, 1])
    for r in range(rows - 1):
        for c in range(columns - 1):
            # split along a diagonal with visible ends, preferably the one of smaller depth step
            falling = abs(depth[r, c] - depth[r + 1, c + 1])
            rising = abs(depth[r, c + 1] - depth[r + 1, c])
            whole = visible[r, c] and visible[r + 1, c + 1]
            if whole and not (visible[r, c + 1] and visible[r + 1, c] and rising < falling):
                corners = ((0, 0, 0, 1, 1, 1), (0, 0, 1, 1, 1, 0))
            else:
                corners = ((0, 0, 0, 1, 1, 0), (0, 1, 1, 1, 1, 0))
            for k in range(2):
                corner = corners[k]
                ar, ac = r + corner[0], c + corner[1]
                br, bc = r + corner[2], c + corner[3]
                cr, cc = r + corner[4], c + corner[5]
                if not (visible[ar, ac] and visible[br, bc] and visible[cr, cc]):
                    continue
                if (
                    _joined(depth[ar, ac], depth[br, bc], max_jump)
                    and _joined(depth[br, bc], depth[cr, cc], max_jump)
                    and _joined(depth[cr, cc], depth[ar, ac], max_jump)
                ):
                    _triangle(px, z, ar, ac, br, bc, cr, cc, inverse, front)
