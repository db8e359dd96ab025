"""The bonnet is found where there is one, and nowhere else."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.datasets.synthetic.places import build_place
from megloc_kapture.datasets.synthetic.robotcar_shots import (
    RobotCarTwinOptions,
    build_robotcar_moments,
)
from megloc_kapture.datasets.synthetic.views import PlacePainter
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.preprocessing.unchanging_region import (
    MIN_IMAGES,
    UnchangingRegion,
    edge_directions,
    find_unchanging_region,
)

Image = NDArray[np.uint8]


@pytest.fixture(scope="module")
def drive() -> dict[str, list[tuple[Image, NDArray[np.bool_]]]]:
    """Images and true masks of two cameras of a rendered car; the rear one sees the boot."""
    options = RobotCarTwinOptions(
        num_locations=1, stops_per_location=12, moments_per_condition=2, size_px=192
    )
    world = options.world()
    painter = PlacePainter(build_place(world, 0), seed=world.seed, supersampling=1)
    drawn: dict[str, list[tuple[Image, NDArray[np.bool_]]]] = {"rear": [], "right": []}
    for moment in build_robotcar_moments(options).reference:
        for shot in moment.shots:
            camera = shot.name.split("/")[-2]
            if camera in drawn:
                view = painter.draw(shot)
                drawn[camera].append((view.image, view.mask))
    return drawn


def region_of(images: list[Image]) -> UnchangingRegion:
    return find_unchanging_region(edge_directions(image) for image in images)


def test_the_bonnet_is_found(drive: dict[str, list[tuple[Image, NDArray[np.bool_]]]]) -> None:
    images = [image for image, _ in drive["rear"]]
    truth = drive["rear"][0][1]
    assert 0.05 < (~truth).mean() < 0.2
    region = region_of(images)
    assert region
    mask = region.mask(192, 192)
    assert not mask[~truth].any()
    # a margin of a few of its pixels above it
    above = cv2.dilate((~truth).astype(np.uint8), np.ones((2 * 8 + 1, 1), np.uint8)) == 1
    assert mask[~above].all()


def test_changing_light_does_not_hide_it(
    drive: dict[str, list[tuple[Image, NDArray[np.bool_]]]],
) -> None:
    gains = np.linspace(0.35, 1.15, len(drive["rear"]))
    images = [
        np.clip(image * gain, 0, 255).astype(np.uint8)
        for (image, _), gain in zip(drive["rear"], gains, strict=True)
    ]
    truth = drive["rear"][0][1]
    assert (~region_of(images).mask(192, 192))[~truth].mean() > 0.97


def test_a_camera_beside_it_sees_none(
    drive: dict[str, list[tuple[Image, NDArray[np.bool_]]]],
) -> None:
    region = region_of([image for image, _ in drive["right"]])
    assert not region and "nothing stays the same" in region.reason
    assert region.mask(30, 20).all()


@pytest.mark.parametrize("every", [1, 4])
def test_a_hand_held_camera_sees_none(shared_data: Path, every: int) -> None:
    folder = shared_data / "scenes" / "redkitchen_rgbd" / "mapping" / "sensors" / "records_data"
    paths = sorted(folder.rglob("*.jpg"))[: 30 * every : every]
    assert len(paths) == 30
    assert not region_of([read_image_rgb(path) for path in paths])


@pytest.mark.parametrize("scene", ["herzjesu_p25", "fountain_p11"])
def test_photographs_of_one_facade_have_none(shared_data: Path, scene: str) -> None:
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


def test_a_dirty_spot_in_the_middle_is_no_bonnet() -> None:
    images = []
    for seed in range(16):
        image = noise(seed)
        cv2.circle(image, (100, 40), 18, (20, 20, 20), -1)
        images.append(image)
    assert not region_of(images)


def test_a_smooth_road_is_no_bonnet() -> None:
    """Its brightness hardly varies; but it has no edge against what is above that stays."""
    images = []
    for seed in range(16):
        image = noise(seed)
        rng = np.random.default_rng(1000 + seed)
        top = int(rng.integers(60, 90))
        image[top:] = 90 + rng.normal(0, 2, image[top:].shape)
        images.append(image)
    assert not region_of(images)


def test_a_plain_bonnet_without_texture_is_found_by_its_edge() -> None:
    images = []
    for seed in range(16):
        image = noise(seed)
        cv2.ellipse(image, (100, 130), (130, 40), 0, 0, 360, (60, 70, 80), -1)
        images.append(image)
    mask = region_of(images).mask(200, 120)
    plain = (image == (60, 70, 80)).all(axis=2)
    assert (~mask)[plain].mean() > 0.99
    assert (~mask)[~plain].mean() < 0.08


def test_a_camera_that_stands_still_is_said_so() -> None:
    region = region_of([noise(0)] * MIN_IMAGES)
    assert not region and "hardly moves" in region.reason


def test_too_few_images_are_refused() -> None:
    with pytest.raises(ValueError, match=f"at least {MIN_IMAGES}"):
        region_of([noise(k) for k in range(MIN_IMAGES - 1)])


def test_the_mask_is_below_the_frontier() -> None:
    mask = UnchangingRegion((0.5, 1.0)).mask(6, 4)
    np.testing.assert_array_equal(mask[:, 0], [True, True, False, False])
    np.testing.assert_array_equal(mask.all(axis=0), [False, False, False, True, True, True])
