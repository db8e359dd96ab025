"""Drawing a depth map as a surface of small triangles into another view's depth buffer, compiled.

Imported only when needed: numba costs half a second to import.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.geometry.projection import model_id, packed_params, project_point
from megloc_kapture.values import Camera, RigidTransform

# a pixel's centre that lies on an edge belongs to both triangles, whatever rounding says
_ON_EDGE = 1e-6


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
    """The nearest surface in each pixel of a view.

    Neighbouring pixels of the depth map are joined by triangles, which makes a surface without
    holes at any zoom. It is cut where depth jumps. Inverse depth is linear in the pixels of a
    plane without distortion, so it is what is interpolated.

    Parameters
    ----------
    depth_m : float32 (R, C), the depth map; 0, less or not finite where unknown.
    rays : float64 (R * C, 3), through its pixels' centres, z = 1, in the depth camera's frame.
    view : the camera of the view, any model.
    max_jump : depths of neighbours may differ by this share of the nearer.
    near_m, field : what is nearer to the view along its axis, or farther off the axis (tangent of
        the angle), is left out.

    Returns
    -------
    depth : float64 (H, W) in the view at the pixels' centres, metres; infinite without a surface.
    front : bool (H, W), whether the surface is seen from the side that the depth map saw.
    """
    rows, columns = depth_m.shape
    depth = np.ascontiguousarray(depth_m, np.float64)
    px, z = np.empty((rows, columns, 2)), np.empty((rows, columns))
    _project(
        depth,
        rays.reshape(rows, columns, 3),
        view_from_depth.rotation_matrix(),
        np.array(view_from_depth.translation),
        model_id(view),
        packed_params(view),
        near_m,
        field,
        px,
        z,
    )
    inverse = np.zeros((view.height, view.width))
    front = np.zeros((view.height, view.width), np.bool_)
    _draw(depth, px, z, max_jump, inverse, front)
    with np.errstate(divide="ignore"):
        return 1.0 / inverse, front


@compiled_loop
def _project(depth, rays, rotation, translation, model, params, near_m, field, px, z):
    """Pixels and depths in the view of the depth map's points; NaN where it cannot see one."""
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
    """Draw one triangle whose corners run clockwise as the depth map sees them (y down)."""
    ax, ay = px[ar, ac, 0], px[ar, ac, 1]
    bx, by = px[br, bc, 0], px[br, bc, 1]
    cx, cy = px[cr, cc, 0], px[cr, cc, 1]
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if not abs(area) > 1e-12:  # seen edge on, or not at all
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
    there = np.zeros((rows, columns), np.bool_)
    for r in range(rows):
        for c in range(columns):
            there[r, c] = math.isfinite(px[r, c, 0] + px[r, c, 1])
    for r in range(rows - 1):
        for c in range(columns - 1):
            # the quad's other diagonal where this one crosses an edge or a hole
            falling = abs(depth[r, c] - depth[r + 1, c + 1])
            rising = abs(depth[r, c + 1] - depth[r + 1, c])
            whole = there[r, c] and there[r + 1, c + 1]
            if whole and not (there[r, c + 1] and there[r + 1, c] and rising < falling):
                corners = ((0, 0, 0, 1, 1, 1), (0, 0, 1, 1, 1, 0))
            else:
                corners = ((0, 0, 0, 1, 1, 0), (0, 1, 1, 1, 1, 0))
            for k in range(2):
                corner = corners[k]
                ar, ac = r + corner[0], c + corner[1]
                br, bc = r + corner[2], c + corner[3]
                cr, cc = r + corner[4], c + corner[5]
                if not (there[ar, ac] and there[br, bc] and there[cr, cc]):
                    continue
                if (
                    _joined(depth[ar, ac], depth[br, bc], max_jump)
                    and _joined(depth[br, bc], depth[cr, cc], max_jump)
                    and _joined(depth[cr, cc], depth[ar, ac], max_jump)
                ):
                    _triangle(px, z, ar, ac, br, bc, cr, cc, inverse, front)
