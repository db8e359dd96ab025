"""Exact rasterization of textured parallelograms: surface, depth and colour of each sample.

A sample's ray is ``(x_n, y_n, 1)`` in the camera frame. On a plane, inverse depth and the texture
coordinates divided by depth are linear in the ray. So each surface needs three linear forms and a
few comparisons within its bounding box. Depth is z along the optical axis, metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.errors import DataError
from megloc_kapture.values import Camera, RigidTransform
from megloc_twins.portable import Bools, Float32, Float64, log2
from megloc_twins.surfaces import NUM_LEVELS, Atlas, Surfaces

NEAR_M = 0.05
NO_SURFACE = -1


@dataclass(frozen=True, eq=False)
class SampleGrid:
    """The rays of a camera's samples, at the centres of ``supersampling``² cells per pixel."""

    camera: Camera
    supersampling: int
    # normalised coordinates, broadcast to (H * supersampling, W * supersampling); without
    # distortion their shapes are (1, columns) and (rows, 1)
    x: Float64
    y: Float64

    @property
    def shape(self) -> tuple[int, int]:
        return self.camera.height * self.supersampling, self.camera.width * self.supersampling

    def rays(self) -> Float64:
        """Return (x, y, 1) of each sample, float64 (rows, columns, 3)."""
        return np.stack(np.broadcast_arrays(self.x, self.y, 1.0), axis=-1)


@dataclass(frozen=True, eq=False)
class Visibility:
    """The nearest surface along each sample's ray."""

    grid: SampleGrid
    surface: NDArray[np.int16]  # (rows, columns), its index or NO_SURFACE
    inverse_depth: Float32  # (rows, columns), 1/m, 0 without a surface
    # (N, 3, 3), linear forms in the ray (x_n, y_n, 1) per surface: 1/z, and the two surface
    # coordinates (0..1 inside the surface) divided by z
    planes: Float64


def intrinsics(camera: Camera) -> tuple[float, float, float, float, float]:
    """Return (fx, fy, cx, cy, k) of a camera; k is SIMPLE_RADIAL's distortion, else 0."""
    if camera.model not in ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL"):
        raise DataError(f"the renderer has no camera model {camera.model}")
    p = camera.params
    fx, fy, cx, cy = p if camera.model == "PINHOLE" else (p[0], *p[:3])
    return fx, fy, cx, cy, p[3] if camera.model == "SIMPLE_RADIAL" else 0.0


def sample_grid(camera: Camera, supersampling: int) -> SampleGrid:
    """Return the rays of all samples of a camera; the centre of the first pixel is (0.5, 0.5)."""
    fx, fy, cx, cy, k = intrinsics(camera)
    columns = (np.arange(camera.width * supersampling) + 0.5) / supersampling
    rows = (np.arange(camera.height * supersampling) + 0.5) / supersampling
    x, y = ((columns - cx) / fx)[None], ((rows - cy) / fy)[:, None]
    if k:
        squared = x * x + y * y
        # undistortion depends on the radius only: solve r (1 + k r^2) = r_d on a fine table, then
        # interpolate (error below 1e-9)
        table = np.linspace(0.0, float(squared.max()) * (1 + 1e-9), 8193)
        factor = np.ones_like(table)
        for _ in range(30):
            value = factor * (1 + k * factor**2 * table) - 1
            factor -= value / (1 + 3 * k * factor**2 * table)
        factor_of = np.interp(squared.ravel(), table, factor).reshape(squared.shape)
        x, y = x * factor_of, y * factor_of
    return SampleGrid(camera, supersampling, x, y)


def project(camera: Camera, points: Float64) -> Float64:
    """Project points (N, 3), in the camera's frame and in front of it, to pixels (N, 2)."""
    fx, fy, cx, cy, k = intrinsics(camera)
    xy = points[:, :2] / points[:, 2:]
    xy = xy * (1 + k * (xy**2).sum(1, keepdims=True))
    return xy * (fx, fy) + (cx, cy)


def visible_surfaces(
    surfaces: Surfaces, cam_from_world: RigidTransform, grid: SampleGrid
) -> Visibility:
    rotation = cam_from_world.rotation_matrix()
    seen_from = surfaces.moved(rotation, np.array(cam_from_world.translation))
    origin, edge_u, edge_v = seen_from.origin, seen_from.edge_u, seen_from.edge_v
    planes, facing = _planes(origin, edge_u, edge_v)
    boxes = _bounding_boxes(seen_from.corners(), grid)
    nearest = np.zeros(grid.shape, np.float32)
    surface = np.full(grid.shape, NO_SURFACE, np.int16)
    x, y = (np.broadcast_to(of.astype(np.float32), grid.shape) for of in (grid.x, grid.y))
    candidates = np.flatnonzero(facing & (boxes[:, 0] < boxes[:, 1]) & (boxes[:, 2] < boxes[:, 3]))
    _cover(candidates, boxes, planes.astype(np.float32), x, y, nearest, surface)
    return Visibility(grid, surface, nearest, planes)


@compiled_loop
def _cover(
    candidates: NDArray[np.int64],
    boxes: NDArray[np.int64],
    forms: Float32,
    x: Float32,
    y: Float32,
    nearest: Float32,
    surface: NDArray[np.int16],
) -> None:
    """Draw each candidate within its box where it is nearer than the current surface, in place."""
    for index in candidates:
        left, right, top, bottom = boxes[index]
        depth, along_u, along_v = forms[index]
        for row in range(top, bottom):
            for column in range(left, right):
                at_x, at_y = x[row, column], y[row, column]
                inverse = depth[0] * at_x + (depth[1] * at_y + depth[2])
                if not inverse > nearest[row, column]:
                    continue
                u = along_u[0] * at_x + (along_u[1] * at_y + along_u[2])
                v = along_v[0] * at_x + (along_v[1] * at_y + along_v[2])
                if u >= 0 and u <= inverse and v >= 0 and v <= inverse:
                    nearest[row, column] = inverse
                    surface[row, column] = index


def _planes(origin: Float64, edge_u: Float64, edge_v: Float64) -> tuple[Float64, Bools]:
    """Return forms (N, 3, 3) of 1/z, u/z, v/z, and a mask of surfaces that face the camera."""
    normal = np.cross(edge_u, edge_v)  # away from a viewer in front
    offset = np.einsum("ni,ni->n", normal, origin)
    facing = offset > 1e-9
    safe = np.where(facing, offset, 1.0)[:, None]
    inverse_depth = normal / safe
    dual_u = np.cross(edge_v, normal)
    dual_u /= np.einsum("ni,ni->n", dual_u, edge_u)[:, None]
    dual_v = np.cross(normal, edge_u)
    dual_v /= np.einsum("ni,ni->n", dual_v, edge_v)[:, None]
    u = dual_u - np.einsum("ni,ni->n", dual_u, origin)[:, None] * inverse_depth
    v = dual_v - np.einsum("ni,ni->n", dual_v, origin)[:, None] * inverse_depth
    return np.stack([inverse_depth, u, v], axis=1), facing


def _bounding_boxes(corners: Float64, grid: SampleGrid) -> NDArray[np.int64]:
    """Return bounding ranges (N, 4) of samples: left, right, top, bottom (ends exclusive)."""
    following = np.roll(corners, -1, axis=1)
    z, z_next = corners[..., 2], following[..., 2]
    crosses = (z < NEAR_M) != (z_next < NEAR_M)
    part = np.where(crosses, (NEAR_M - z) / np.where(crosses, z_next - z, 1.0), 0.0)
    crossing = corners + part[..., None] * (following - corners)
    points = np.concatenate([corners, crossing], axis=1)  # (N, 8, 3)
    valid = np.concatenate([z >= NEAR_M, crosses], axis=1)
    depth = np.where(valid, points[..., 2], 1.0)
    result = np.zeros((len(corners), 4), np.int64)
    for axis, rays in enumerate((grid.x, grid.y)):
        along = points[..., axis] / depth
        low, high = (np.where(valid, along, end).T for end in (np.inf, -np.inf))
        # ray coordinates increase along rows and columns for any distortion; one more sample on
        # each side, since rounding may exclude samples at the ends of the range
        least, most = rays.min(axis), rays.max(axis)
        first = np.searchsorted(most, low.min(0)) - 1
        last = np.searchsorted(least, high.max(0), side="right") + 1
        result[:, 2 * axis : 2 * axis + 2] = np.stack([first, last], 1).clip(0, len(least))
    result[~valid.any(1)] = 0
    return result


def depth_map(seen: Visibility) -> Float32:
    """Return depth along the optical axis, metres, float32 (rows, columns), 0 without a surface."""
    form = seen.planes[:, 0][np.maximum(seen.surface, 0)]
    inverse = form[..., 0] * seen.grid.x + form[..., 1] * seen.grid.y + form[..., 2]
    hit = seen.surface != NO_SURFACE
    return np.where(hit, 1.0 / np.where(hit, inverse, 1.0), 0.0).astype(np.float32)


def sample_colour(seen: Visibility, surfaces: Surfaces, atlas: Atlas) -> Float32:
    """Return the colour of each sample, (rows, columns, 3), RGB 0..255; 0 without a surface."""
    index = np.maximum(seen.surface, 0).astype(np.int32)
    hit = seen.surface != NO_SURFACE
    inverse = np.where(hit, seen.inverse_depth, np.float32(1.0))
    gx, gy = seen.grid.x.astype(np.float32), seen.grid.y.astype(np.float32)
    forms = np.ascontiguousarray(seen.planes[:, 1:].reshape(len(surfaces), 6), np.float32)
    per_sample = np.take(forms, index, axis=0)
    z = (1 / inverse).astype(np.float32)
    u, v = (
        (form[..., 0] * gx + form[..., 1] * gy + form[..., 2]) * z
        for form in (per_sample[..., :3], per_sample[..., 3:])
    )
    level = _level(seen, surfaces, atlas, index, inverse)
    low = np.minimum(level.astype(np.int32), NUM_LEVELS - 2)
    weight = (level - low.astype(np.float32))[..., None]
    # atlas pixels are x = start + u * step, y likewise; the first pixel's centre is at 0
    corner, size = atlas.corner[surfaces.texture], atlas.size[surfaces.texture]
    part, end = surfaces.uv[:, None, :2], surfaces.uv[:, None, 2:]
    start, step = corner + part * size - 0.5, (end - part) * size
    table = np.stack([start[..., 0], step[..., 0], start[..., 1], step[..., 1]], axis=-1)
    table = np.ascontiguousarray(table.reshape(-1, 4), np.float32)
    levels = []
    for row in (index * NUM_LEVELS + low, index * NUM_LEVELS + low + 1):
        affine = np.take(table, row, axis=0)
        x, y = affine[..., 0] + affine[..., 1] * u, affine[..., 2] + affine[..., 3] * v
        levels.append(bilinear(atlas.image, x, y))
    fine, coarse = levels
    colour = fine + weight * (coarse - fine)
    colour[~hit] = 0
    return np.asarray(colour, np.float32)


def _level(
    seen: Visibility, surfaces: Surfaces, atlas: Atlas, index: NDArray[np.int32], inverse: Float32
) -> Float32:
    """Return the fractional texture level (0 finest) at which a sample covers about one texel."""
    fx, fy, _, _, _ = intrinsics(seen.grid.camera)
    size = atlas.size[surfaces.texture, 0].astype(np.float64)
    part = np.abs(surfaces.uv[:, 2:] - surfaces.uv[:, :2])
    texels = (size * part).prod(1)
    # the Jacobian of a projective map is its determinant over the cube of the denominator
    determinant = (seen.planes[:, 0] * np.cross(seen.planes[:, 1], seen.planes[:, 2])).sum(1)
    scale = np.abs(determinant) * texels / (fx * fy * seen.grid.supersampling**2)
    constant = np.float32(0.5) * log2(np.maximum(scale, 1e-30))
    level = np.take(constant, index) - np.float32(1.5) * log2(inverse)
    return np.clip(level, 0, NUM_LEVELS - 1 - 1e-3)


@compiled_loop
def bilinear(image: NDArray[Any], x: Float32, y: Float32) -> Float32:
    """Interpolate an image (H, W, C) at ``x``, ``y``, float32 (R, S) each: float32 (R, S, C).

    The first pixel's centre is (0, 0). Edge pixels are repeated outside the image; NaN gives the
    first pixel. OpenCV uses fused multiply-add on some processors; this loop does not.
    """
    height, width, channels = image.shape
    rows, columns = x.shape
    result = np.empty((rows, columns, channels), np.float32)
    for row in range(rows):
        for column in range(columns):
            at_x, at_y = x[row, column], y[row, column]
            at_x = min(at_x, np.float32(width - 1)) if at_x > 0 else np.float32(0)
            at_y = min(at_y, np.float32(height - 1)) if at_y > 0 else np.float32(0)
            left, top = int(at_x), int(at_y)
            right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
            part_x, part_y = at_x - np.float32(left), at_y - np.float32(top)
            for channel in range(channels):
                upper = np.float32(image[top, left, channel])
                upper += part_x * (np.float32(image[top, right, channel]) - upper)
                lower = np.float32(image[bottom, left, channel])
                lower += part_x * (np.float32(image[bottom, right, channel]) - lower)
                result[row, column, channel] = upper + part_y * (lower - upper)
    return result
