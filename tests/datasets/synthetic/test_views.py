from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from megloc_kapture.datasets.synthetic.covisibility import overlap
from megloc_kapture.datasets.synthetic.options import SyntheticWorldOptions
from megloc_kapture.datasets.synthetic.shots import Shot
from megloc_kapture.datasets.synthetic.views import PlacePainter
from megloc_kapture.datasets.synthetic.world import SyntheticWorld, build_world
from megloc_kapture.features.rootsift import RootSift
from megloc_kapture.io.colmap import normalized_from_px, px_from_cam

OPTIONS = SyntheticWorldOptions(num_places=1, stations_per_place=9, day_queries=2, night_queries=2)


@pytest.fixture(scope="module")
def world() -> SyntheticWorld:
    return build_world(OPTIONS)


def new_painter(world: SyntheticWorld) -> PlacePainter:
    return PlacePainter(world.places[0], seed=OPTIONS.seed, supersampling=OPTIONS.supersampling)


@pytest.fixture(scope="module")
def painter(world: SyntheticWorld) -> PlacePainter:
    return new_painter(world)


def first(world: SyntheticWorld, prefix: str) -> Shot:
    return next(shot for shot in world.shots() if shot.name.startswith(prefix))


def test_drawing_gives_the_same_bytes_whatever_was_drawn_before(
    world: SyntheticWorld, painter: PlacePainter
) -> None:
    shots = [first(world, p) for p in ("db/place0/front", "query/day", "query/night")]
    images = [painter.draw(shot).image for shot in shots]
    fresh = new_painter(world)
    for shot, image in reversed(list(zip(shots, images, strict=True))):
        assert image.shape == (480, 640, 3) and image.dtype == np.uint8
        np.testing.assert_array_equal(fresh.draw(shot).image, image)


def test_images_are_rich_in_features_by_day_and_poorer_at_night(
    world: SyntheticWorld, painter: PlacePainter
) -> None:
    sift = RootSift()
    strong = {}
    for prefix in ("db/place0/left", "query/day", "query/night"):
        image = painter.draw(first(world, prefix)).image
        features = sift.extract(image)
        assert len(features.scores) > 800
        strong[prefix] = int((features.scores > 0.02).sum())
    assert strong["query/night"] < 0.5 * min(strong["db/place0/left"], strong["query/day"])


def test_the_same_view_is_darker_and_noisier_at_night(
    world: SyntheticWorld, painter: PlacePainter
) -> None:
    night = first(world, "query/night")
    day = replace(night, look=first(world, "query/day").look)
    dark, bright = painter.draw(night).image, painter.draw(day).image
    assert dark.mean() < 0.5 * bright.mean()
    red, _, blue = dark.reshape(-1, 3).mean(0)
    assert red > 1.15 * blue  # the lamps' colour
    again = painter.draw(replace(night, look=replace(night.look, noise_seed=1))).image
    assert np.abs(again.astype(int) - dark).mean() > 2


def test_the_bonnet_stays_in_the_image_and_is_masked(
    world: SyntheticWorld, painter: PlacePainter
) -> None:
    shots = [s for s in world.mapping if s.sensor_id == "rig_front"][:2]
    first_view, second_view = (painter.draw(shot, depth=True) for shot in shots)
    hidden = ~first_view.mask
    assert 0.05 < hidden.mean() < 0.25
    assert hidden[-1, 320] and not hidden[: 480 // 2].any()
    np.testing.assert_array_equal(hidden, ~second_view.mask)
    assert first_view.depth_m is not None and (first_view.depth_m[hidden] == 0).all()
    open_road = painter.draw(replace(shots[0], bonnet=False))
    assert open_road.mask.all()
    changed = np.abs(open_road.image.astype(int) - first_view.image).max(2) > 2
    assert changed[hidden].mean() > 0.8
    assert changed[~hidden].mean() < 0.05  # what blur carries over the edge


def test_moving_objects_hide_what_is_behind_and_nothing_else(
    world: SyntheticWorld, painter: PlacePainter
) -> None:
    shot = first(world, "query/day")
    with_movers = painter.draw(shot, depth=True)
    without = painter.draw(replace(shot, movers=()), depth=True)
    assert with_movers.depth_m is not None and without.depth_m is not None
    changed = with_movers.depth_m != without.depth_m
    assert 0.005 < changed.mean() < 0.6
    in_front = with_movers.depth_m[changed]
    behind = without.depth_m[changed]
    assert ((in_front > 0) & ((in_front < behind) | (behind == 0))).all()


def test_depth_and_poses_of_two_views_agree(world: SyntheticWorld, painter: PlacePainter) -> None:
    # what one camera sees, carried over by its depth and COLMAP's cameras, is where the other
    # camera's depth puts it, and has the same colour there
    query, near = _overlapping(world)
    a = painter.draw(_evenly_lit(query), depth=True)
    b = painter.draw(_evenly_lit(near), depth=True)
    assert a.depth_m is not None and b.depth_m is not None
    row, column = (g.ravel() for g in np.mgrid[8:472:4, 8:632:4])
    z = a.depth_m[row, column].astype(np.float64)
    row, column, z = row[z > 0], column[z > 0], z[z > 0]
    pixels = np.stack([column + 0.5, row + 0.5], 1)
    rays = normalized_from_px(query.camera, pixels)[:, :2]
    points = np.concatenate([rays * z[:, None], z[:, None]], 1)
    in_b = near.cam_from_world.apply(query.cam_from_world.inverse().apply(points))
    ahead = in_b[:, 2] > 0.1
    there = px_from_cam(near.camera, in_b[ahead])
    inside = ((there > 1) & (there < (639, 479))).all(1)
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


def _evenly_lit(shot: Shot) -> Shot:
    look = replace(shot.look, sun=(0.0, 0.0, 0.0), sky=(0.9, 0.9, 0.9), vignetting=0.0)
    return replace(shot, look=look, movers=(), bonnet=False)


def _overlapping(world: SyntheticWorld) -> tuple[Shot, Shot]:
    views = world.coarse_views()
    query = first(world, "query/day")
    best = max(world.mapping, key=lambda m: overlap(views[query.name], views[m.name]))
    return query, best
