"""Rendered frames: light, bonnet, moving objects, shadows, depth."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace

import numpy as np
import pytest
from megloc_twins.frames import Frame
from megloc_twins.options import SyntheticWorldOptions
from megloc_twins.render import PlaceRenderer, add_shadows, cast_shadows
from megloc_twins.robotcar import RobotCarTwinOptions, build_robotcar_frames
from megloc_twins.squares import build_place
from megloc_twins.surfaces import SurfaceBuilder, Surfaces
from megloc_twins.synthetic_kapture import SyntheticWorld, build_world
from megloc_twins.viewpoints import overlap, views_of

from megloc_kapture.io.colmap import normalized_from_px, px_from_cam

OPTIONS = SyntheticWorldOptions(
    num_places=1, stations_per_place=6, day_queries=1, night_queries=1, width=320, height=240
)


@pytest.fixture(scope="module")
def world() -> SyntheticWorld:
    return build_world(OPTIONS)


@pytest.fixture(scope="module")
def painter(world: SyntheticWorld) -> PlaceRenderer:
    return PlaceRenderer(world.places[0], seed=OPTIONS.seed, supersampling=1)


def first(world: SyntheticWorld, prefix: str) -> Frame:
    return next(frame for frame in world.frames() if frame.name.startswith(prefix))


def test_the_bonnet_stays_in_the_image_and_is_masked(
    world: SyntheticWorld, painter: PlaceRenderer
) -> None:
    frames = [s for s in world.mapping if s.sensor_id == "rig_front"][:2]
    first_view, second_view = (painter.render(frame, depth=True) for frame in frames)
    hidden = ~first_view.mask
    assert 0.05 < hidden.mean() < 0.25
    assert hidden[-1, 160] and not hidden[:120].any()
    np.testing.assert_array_equal(hidden, ~second_view.mask)
    assert first_view.depth_m is not None and (first_view.depth_m[hidden] == 0).all()
    open_road = painter.render(replace(frames[0], bonnet=False))
    assert open_road.mask.all()
    changed = np.abs(open_road.image.astype(int) - first_view.image).max(2) > 2
    assert changed[hidden].mean() > 0.8
    assert changed[~hidden].mean() < 0.05  # what blur carries over the edge


def test_depth_and_poses_of_two_views_agree(world: SyntheticWorld, painter: PlaceRenderer) -> None:
    # what one camera sees, carried over by its depth and COLMAP's cameras, is where the other
    # camera's depth puts it, and has the same colour there
    query, near = _overlapping(world)
    a = painter.render(_evenly_lit(query), depth=True)
    b = painter.render(_evenly_lit(near), depth=True)
    assert a.depth_m is not None and b.depth_m is not None
    row, column = (g.ravel() for g in np.mgrid[4:236:2, 4:316:2])
    z = a.depth_m[row, column].astype(np.float64)
    row, column, z = row[z > 0], column[z > 0], z[z > 0]
    pixels = np.stack([column + 0.5, row + 0.5], 1)
    rays = normalized_from_px(query.camera, pixels)[:, :2]
    points = np.concatenate([rays * z[:, None], z[:, None]], 1)
    in_b = near.cam_from_world.apply(query.cam_from_world.inverse().apply(points))
    ahead = in_b[:, 2] > 0.1
    there = px_from_cam(near.camera, in_b[ahead])
    inside = ((there > 1) & (there < (319, 239))).all(1)
    x, y = np.floor(there[inside]).astype(int).T
    expected = in_b[ahead][inside, 2]
    seen = b.depth_m[y, x]
    same = np.abs(seen - expected) < 0.02 * expected
    assert same.mean() > 0.5
    # the nearest pixel's centre is up to 0.7 px off, so that depth differs a little on slopes
    assert np.median(np.abs(seen - expected)[same] / expected[same]) < 2e-3
    colour_a = a.image[row, column][ahead][inside][same].astype(float)
    colour_b = b.image[y, x][same].astype(float)
    correlation = np.corrcoef(colour_a.ravel(), colour_b.ravel())[0, 1]
    scrambled = np.corrcoef(colour_a.ravel(), np.roll(colour_b, 977, axis=0).ravel())[0, 1]
    assert correlation > 0.7 > scrambled + 0.2


def _evenly_lit(frame: Frame) -> Frame:
    lighting = replace(frame.lighting, sun=(0.0, 0.0, 0.0), sky=(0.9, 0.9, 0.9), vignetting=0.0)
    return replace(frame, lighting=lighting, moving_objects=(), bonnet=False)


def _overlapping(world: SyntheticWorld) -> tuple[Frame, Frame]:
    query = first(world, "query/day")
    view, *views = views_of(world.places[0], [query, *world.mapping])
    shares = [overlap(view, other) for other in views]
    return query, world.mapping[int(np.argmax(shares))]


CAR = RobotCarTwinOptions(num_locations=1, moments_per_condition=2, size_px=128)
SEED = CAR.world().seed


@pytest.fixture(scope="module")
def car_frames() -> list[Frame]:
    _, queries = build_robotcar_frames(CAR)
    return queries


@pytest.fixture(scope="module")
def car_renderer(plain_textures: Callable[[], AbstractContextManager[None]]) -> PlaceRenderer:
    with plain_textures():
        return PlaceRenderer(build_place(CAR.world(), 0), seed=SEED, supersampling=1)


def test_movers_hide_the_place_and_only_the_rear_camera_sees_the_car(
    car_frames: list[Frame], car_renderer: PlaceRenderer
) -> None:
    assert {frame.sensor_id for frame in car_frames if frame.bonnet} == {"rear"}
    shares = []
    for frame in (frame for frame in car_frames if not frame.bonnet):
        there = car_renderer.render(frame, depth=True).depth_m
        gone = car_renderer.render(replace(frame, moving_objects=()), depth=True).depth_m
        assert there is not None and gone is not None
        changed = there != gone
        shares.append(changed.mean())
        # nearer than the place, or in front of the sky
        assert ((there < gone) | (gone == 0))[changed].all() and there[changed].all()
        assert frame.moving_objects or not changed.any()
    assert 0.02 < max(shares) < 0.6


SUN = (1 / np.sqrt(2), 0.0, 1 / np.sqrt(2))  # 45 degrees above +x: a metre of height, a metre long


def ground_and_box() -> tuple[Surfaces, Surfaces]:
    ground, box = SurfaceBuilder(), SurfaceBuilder()
    corner = np.array([-6.0, 6.0, 0.0])
    ground.add(corner, np.array([12.0, 0, 0]), np.array([0, -12.0, 0]), 0)
    box.add_box((0.0, 0.0), (1.0, 2.0, 2.0), 0.0, (0, 0, 0, 0), 0)
    return ground.build(), box.build()


def test_a_box_throws_its_shadow_away_from_the_sun() -> None:
    ground, box = ground_and_box()
    shadows = cast_shadows(ground.joined(box), SUN)
    x = np.array([[-4.0, -2.6, -2.4, -1.0, 1.0, 3.0, -1.0, -1.0]], np.float32)
    y = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.9, 1.1]], np.float32)
    lit = shadows.lit(x, y, np.zeros_like(x))
    # the box ends at x = -0.5 and is 2 m high: its shadow ends at x = -2.5
    np.testing.assert_array_equal(lit[0], [1, 1, 0, 0, 1, 1, 0, 1])


def test_a_surface_does_not_shade_itself_and_others_can_be_added() -> None:
    ground, box = ground_and_box()
    alone = cast_shadows(ground, SUN)
    grid = np.meshgrid(np.linspace(-5, 5, 50), np.linspace(-5, 5, 50))
    x, y = (a.astype(np.float32) for a in grid)
    assert alone.lit(x, y, np.zeros_like(x)).all()
    both = add_shadows(alone, box)
    assert not both.lit(x, y, np.zeros_like(x)).all()
    assert alone.lit(x, y, np.zeros_like(x)).all()  # unchanged
    together = cast_shadows(ground.joined(box), SUN).lit(x, y, np.zeros_like(x))
    assert (both.lit(x, y, np.zeros_like(x)) == together).mean() > 0.99
