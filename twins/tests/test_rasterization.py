from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from megloc_twins.frames import reduced
from megloc_twins.options import SyntheticWorldOptions, stream
from megloc_twins.rasterization import (
    NO_SURFACE,
    depth_map,
    project,
    sample_colour,
    sample_grid,
    visible_surfaces,
)
from megloc_twins.surfaces import SurfaceBuilder, Surfaces, build_atlas
from megloc_twins.viewpoints import query_camera

from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap import normalized_from_px, px_from_cam
from megloc_kapture.values import Camera, RigidTransform

CAMERAS = [
    Camera("SIMPLE_PINHOLE", 80, 60, (70.0, 40.0, 30.0)),
    Camera("PINHOLE", 80, 60, (70.0, 66.0, 43.0, 28.5)),
    Camera("SIMPLE_RADIAL", 80, 60, (70.0, 41.0, 29.0, -0.09)),
    Camera("SIMPLE_RADIAL", 80, 60, (70.0, 41.0, 29.0, 0.05)),
]


def rectangle(
    center: tuple[float, float, float], width: float, height: float, *, tilt: float = 0.0
) -> Surfaces:
    """A rectangle in the camera's frame that faces it, turned about the vertical by ``tilt``."""
    builder = SurfaceBuilder()
    right = np.array([np.cos(tilt), 0.0, np.sin(tilt)])
    down = np.array([0.0, 1.0, 0.0])
    corner = np.array(center) - width / 2 * right - height / 2 * down
    builder.add(corner, width * right, height * down, 0)
    return builder.build()


def colmaps_rays(camera: Camera) -> np.ndarray:
    """Of all pixels' centres, (height * width, 2)."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return normalized_from_px(camera, np.stack([x, y], axis=-1).reshape(-1, 2))[:, :2]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_rays_and_projection_are_colmaps(camera: Camera) -> None:
    grid = sample_grid(camera, 1)
    ours = np.stack(np.broadcast_arrays(grid.x, grid.y), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(ours, colmaps_rays(camera), atol=1e-8)
    points = np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 8), (50, 3))
    np.testing.assert_allclose(project(camera, points), px_from_cam(camera, points), atol=1e-9)


def test_samples_are_the_centres_of_equal_cells() -> None:
    camera = CAMERAS[0]
    fine, coarse = sample_grid(camera, 3), sample_grid(camera, 1)
    assert fine.shape == (180, 240)
    np.testing.assert_allclose(fine.x[0].reshape(-1, 3).mean(1), coarse.x[0], atol=1e-12)
    np.testing.assert_allclose(np.diff(fine.x[0]), 1 / 3 / 70, atol=1e-12)
    with pytest.raises(DataError, match="OPENCV"):
        sample_grid(Camera("OPENCV", 80, 60, (70, 70, 40, 30, 0, 0, 0, 0)), 1)
    # a reduced camera sees the same
    camera = query_camera(SyntheticWorldOptions(), stream(0, "test"))
    assert camera.model == "SIMPLE_RADIAL"
    point = np.array([[0.4, -0.3, 2.0]])
    np.testing.assert_allclose(project(reduced(camera, 8), point), project(camera, point) / 8)


@settings(max_examples=10)
@given(seed=st.integers(0, 10**6), camera=st.sampled_from(CAMERAS))
def test_visibility_equals_a_search_over_all_surfaces_and_samples(
    seed: int, camera: Camera
) -> None:
    # surfaces next to, behind and around the camera: bounding boxes and clipping must not lose any
    rng = np.random.default_rng(seed)
    builder = SurfaceBuilder()
    for _ in range(6):
        builder.add(rng.normal(0, 3, 3), rng.normal(0, 3, 3), rng.normal(0, 3, 3), 0)
    surfaces = builder.build()
    grid = sample_grid(camera, 1)
    seen = visible_surfaces(surfaces, RigidTransform.identity(), grid)

    x, y = np.broadcast_arrays(grid.x, grid.y)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    best = np.full(grid.shape, np.inf)
    nearest = np.full(grid.shape, NO_SURFACE)
    doubtful = np.zeros(grid.shape, bool)
    for index in range(len(surfaces)):
        o, u, v = surfaces.origin[index], surfaces.edge_u[index], surfaces.edge_v[index]
        # z ray = o + a u + b v, so that (u, v, -ray) (a, b, z) = -o
        columns = [np.broadcast_to(u, rays.shape), np.broadcast_to(v, rays.shape), -rays]
        right = np.broadcast_to(-o, rays.shape)[..., None]
        a, b, z = np.moveaxis(np.linalg.solve(np.stack(columns, -1), right)[..., 0], -1, 0)
        if np.dot(np.cross(u, v), o) <= 0:
            continue
        margin = np.minimum(np.minimum(a, 1 - a), np.minimum(b, 1 - b))
        tie = (np.abs(margin) < 1e-4) | (np.abs(z - best) < 1e-4 * np.abs(z))
        clipped = (z > 0) & (z < 0.06)  # the renderer cuts at 0.05
        doubtful |= (tie | clipped) & (margin > -1e-3)
        closer = (margin >= 0) & (z > 0) & (z < best)
        best[closer], nearest[closer] = z[closer], index
    clear = ~doubtful
    assume(clear.mean() > 0.5)
    np.testing.assert_array_equal(seen.surface[clear], nearest[clear])
    hit = clear & (nearest != NO_SURFACE)
    np.testing.assert_allclose(depth_map(seen)[hit], best[hit], rtol=1e-4)


def checkerboard(squares: int, size: int) -> np.ndarray:
    dark = np.indices((squares, squares)).sum(0) % 2 == 0
    board = np.where(dark, 30, 220).astype(np.uint8).repeat(size, 0).repeat(size, 1)
    return np.repeat(board[..., None], 3, axis=2)


@pytest.mark.parametrize(
    "camera",
    [
        Camera("PINHOLE", 640, 480, (500.0, 503.0, 322.3, 238.8)),
        Camera("SIMPLE_RADIAL", 640, 480, (500.0, 318.2, 241.4, -0.08)),
    ],
    ids=lambda c: c.model,
)
def test_corners_appear_where_colmap_projects_them(camera: Camera) -> None:
    # a board of 8 x 8 squares, 2 m wide, seen at an angle; OpenCV finds its inner corners with
    # the first pixel's centre at (0, 0)
    surfaces = rectangle((0.1, 0.05, 3.0), 2.0, 2.0, tilt=0.5)
    atlas = build_atlas([checkerboard(8, 32)])
    # composed, it has unit length
    pose = RigidTransform.identity() @ RigidTransform(
        (0.999, 0.02, -0.03, 0.0275), (0.05, -0.03, 0.1)
    )
    seen = visible_surfaces(surfaces, pose, sample_grid(camera, 2))
    fine = sample_colour(seen, surfaces, atlas)
    colour = cv2.resize(fine, (640, 480), interpolation=cv2.INTER_AREA)
    gray = np.clip(colour[..., 0] + 0.5, 0, 255).astype(np.uint8)
    gray = cv2.GaussianBlur(gray, (0, 0), 1.0)  # corners of a sharp picture are found less well
    a, b = (each.reshape(-1, 1) / 8 for each in np.mgrid[1:8, 1:8])
    corners = surfaces.origin[0] + a * surfaces.edge_u[0] + b * surfaces.edge_v[0]
    expected = px_from_cam(camera, pose.apply(corners))
    start = (expected - 0.5).astype(np.float32)[:, None]
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    result = cv2.cornerSubPix(gray, start.copy(), (5, 5), (-1, -1), criteria)[:, 0] + 0.5
    assert np.abs((result - expected).mean(0)).max() < 0.01
    assert np.linalg.norm(result - expected, axis=1).max() < 0.1


def test_far_textures_are_averaged_not_sampled() -> None:
    # squares far smaller than a sample must give their mean, without moire
    surfaces = rectangle((0, 0, 40.0), 60.0, 60.0)
    atlas = build_atlas([checkerboard(512, 2)])
    seen = visible_surfaces(surfaces, RigidTransform.identity(), sample_grid(CAMERAS[0], 2))
    colour = sample_colour(seen, surfaces, atlas)[20:-20, 20:-20, 0]
    assert colour.std() < 12
    assert abs(colour.mean() - 125) < 3


def test_a_part_of_a_texture_is_shown() -> None:
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[32:, 32:] = (10, 200, 60)
    builder = SurfaceBuilder()
    corner, along, across = np.array([[-5.0, -5.0, 4.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
    builder.add(corner, along, across, 0, uv=(0.55, 0.55, 0.95, 0.95))
    surfaces = builder.build()
    seen = visible_surfaces(surfaces, RigidTransform.identity(), sample_grid(CAMERAS[0], 1))
    colour = sample_colour(seen, surfaces, build_atlas([texture]))
    np.testing.assert_allclose(colour, np.broadcast_to((10.0, 200.0, 60.0), colour.shape), atol=1)
