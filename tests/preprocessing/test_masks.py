"""Fixed masks, margins, and regions that never change."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.path import Path as Outline
from megloc_twins.render import PlaceRenderer
from megloc_twins.robotcar import RobotCarTwinOptions, build_robotcar_frames
from megloc_twins.squares import build_place
from numpy.typing import NDArray
from pydantic import ValidationError

from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.preprocessing.masks import (
    MIN_IMAGES,
    FixedMask,
    UnchangingRegion,
    edge_directions,
    find_unchanging_region,
    outside_polygon,
    with_margin,
)

MASKS = arrays(np.bool_, st.tuples(st.integers(1, 12), st.integers(1, 12)))
Image = NDArray[np.uint8]


@pytest.mark.parametrize(
    ("share", "height", "used"), [(0.25, 8, 6), (0.2, 5, 4), (0.001, 4, 4), (0.5, 5, 2)]
)
def test_the_bottom_share_is_ignored(share: float, height: int, used: int) -> None:
    mask = FixedMask(camera="rear", bottom_share=share).drawn(3, height)
    assert mask.shape == (height, 3)
    assert mask[:used].all() and not mask[used:].any()


@pytest.mark.parametrize("seed", range(5))
def test_polygons_equal_matplotlib(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 7))
    radius = rng.uniform(0.1, 0.5, 7)
    corners = 0.5 + radius[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    width, height = 61, 307
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    inside = Outline(corners * [width, height]).contains_points(
        np.stack([x.ravel(), y.ravel()], axis=1)
    )
    result = outside_polygon(corners, width, height)
    np.testing.assert_array_equal(~result.ravel(), inside)
    assert 0 < inside.mean() < 1


def test_a_polygon_to_the_edges_covers_its_half() -> None:
    half = FixedMask(camera="c", polygon=((0, 0.5), (1, 0.5), (1, 1), (0, 1))).drawn(10, 6)
    assert half[:3].all() and not half[3:].any()


def test_it_is_for_a_sensor_or_a_pattern_of_images() -> None:
    by_id = FixedMask(camera="rear", bottom_share=0.1)
    assert by_id.is_for("rear", "left/1.jpg") and not by_id.is_for("left", "rear/1.jpg")
    by_name = FixedMask(camera="*/rear/*.jpg", bottom_share=0.1)
    names = ("day/rear/1.jpg", "day/left/1.jpg", "day/REAR/1.jpg")
    assert [by_name.is_for("c0", name) for name in names] == [True, False, False]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "one of file, polygon and bottom_share"),
        ({"bottom_share": 0.2, "file": "a.png"}, "one of file, polygon and bottom_share"),
        ({"bottom_share": 1.0}, "less than 1"),
        ({"polygon": [(0, 0), (1, 1)]}, "at least 3"),
        ({"polygon": [(0, 0), (1, 1), (0, 1.2)]}, "between 0 and 1"),
        ({"camera": "", "bottom_share": 0.2}, "at least 1 character"),
    ],
)
def test_invalid_fixed_masks(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        FixedMask.model_validate({"camera": "c", **values})


@given(MASKS, st.floats(-1, 6))
def test_pixels_within_the_margin_of_an_ignored_one_go(mask: np.ndarray, margin_px: float) -> None:
    y, x = np.indices(mask.shape)
    # the border of the image is no edge of the mask, and without a margin it stays
    expected = mask.copy()
    for row, column in np.argwhere(~mask):
        # the library's distances are float32
        expected &= np.float32(np.hypot(y - row, x - column)) > np.float32(margin_px)
    result = with_margin(mask, margin_px)
    assert result.dtype == np.bool_
    np.testing.assert_array_equal(result, expected if margin_px > 0 else mask)
    assert with_margin(np.ones_like(mask), margin_px).all()


Drive = dict[str, list[tuple[Image, NDArray[np.bool_]]]]


@pytest.fixture(scope="module")
def drive() -> Drive:
    """Images and true masks of two cameras of a rendered car; the rear one sees the boot."""
    options = RobotCarTwinOptions(
        num_locations=1, stops_per_location=12, moments_per_condition=2, size_px=192
    )
    world = options.world()
    painter = PlaceRenderer(build_place(world, 0), seed=world.seed, supersampling=1)
    drawn: Drive = {"rear": [], "right": []}
    for shot in build_robotcar_frames(options).mapping:
        if shot.sensor_id in drawn:
            view = painter.render(shot)
            drawn[shot.sensor_id].append((view.image, view.mask))
    return drawn


def region_of(images: list[Image]) -> UnchangingRegion:
    return find_unchanging_region(edge_directions(image) for image in images)


def test_the_bonnet_is_found(drive: Drive) -> None:
    images, truth = [image for image, _ in drive["rear"]], drive["rear"][0][1]
    assert 0.05 < (~truth).mean() < 0.2
    mask = region_of(images).mask(192, 192)
    assert not mask[~truth].any()
    # a margin of a few of its pixels above it
    above = cv2.dilate((~truth).astype(np.uint8), np.ones((2 * 8 + 1, 1), np.uint8)) == 1
    assert mask[~above].all()
    # changing light does not hide it
    gains = np.linspace(0.35, 1.15, len(images))
    lit = [np.clip(i * g, 0, 255).astype(np.uint8) for i, g in zip(images, gains, strict=True)]
    assert (~region_of(lit).mask(192, 192))[~truth].mean() > 0.97


def test_another_camera_of_the_car_has_no_static_region(drive: Drive) -> None:
    region = region_of([image for image, _ in drive["right"]])
    assert not region and "no static region" in region.reason
    assert region.mask(30, 20).all()


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 4])
def test_a_hand_held_camera_has_no_static_region(shared_data: Path, every: int) -> None:
    folder = shared_data / "scenes" / "redkitchen_rgbd" / "mapping" / "sensors" / "records_data"
    paths = sorted(folder.rglob("*.jpg"))[: 30 * every : every]
    assert len(paths) == 30
    assert not region_of([read_image_rgb(path) for path in paths])


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["herzjesu_p25", "fountain_p11"])
def test_photographs_of_one_facade_have_no_static_region(shared_data: Path, scene: str) -> None:
    folder = shared_data / "scenes" / scene
    paths = sorted(folder.glob("*/sensors/records_data/**/*.jpg"))[:14]
    assert len(paths) >= MIN_IMAGES
    small = [
        cv2.resize(read_image_rgb(path), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
        for path in paths
    ]
    assert not region_of(small)


def noise(seed: int) -> Image:
    """A picture of nothing in particular."""
    rough = np.random.default_rng(seed).normal(size=(120, 200, 3))
    smooth = cv2.GaussianBlur(rough, (0, 0), 2.0)
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def spot(image: Image, seed: int) -> None:
    cv2.circle(image, (100, 40), 18, (20, 20, 20), -1)


def road(image: Image, seed: int) -> None:
    """Its brightness hardly varies; but it has no edge against what is above that stays."""
    rng = np.random.default_rng(1000 + seed)
    top = int(rng.integers(60, 90))
    image[top:] = 90 + rng.normal(0, 2, image[top:].shape)


@pytest.mark.parametrize("draw", [spot, road])
def test_scenes_without_a_bonnet(draw: Callable[[Image, int], None]) -> None:
    images = [noise(seed) for seed in range(16)]
    for seed, image in enumerate(images):
        draw(image, seed)
    assert not region_of(images)


def test_a_plain_bonnet_without_texture_is_found_by_its_edge() -> None:
    images = [noise(seed) for seed in range(16)]
    for image in images:
        cv2.ellipse(image, (100, 130), (130, 40), 0, 0, 360, (60, 70, 80), -1)
    mask = region_of(images).mask(200, 120)
    plain = (images[0] == (60, 70, 80)).all(axis=2)
    assert (~mask)[plain].mean() > 0.99
    assert (~mask)[~plain].mean() < 0.08


def test_a_still_camera_is_reported() -> None:
    region = region_of([noise(0)] * MIN_IMAGES)
    assert not region and "hardly moves" in region.reason


def test_the_mask_is_below_the_frontier() -> None:
    mask = UnchangingRegion((0.5, 1.0)).mask(6, 4)
    np.testing.assert_array_equal(mask[:, 0], [True, True, False, False])
    np.testing.assert_array_equal(mask.all(axis=0), [False, False, False, True, True, True])
