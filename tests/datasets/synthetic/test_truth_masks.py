"""The true masks of the car's twin: bonnet, people and cars, and no feature on the bonnet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from megloc_kapture.datasets.synthetic.places import build_place
from megloc_kapture.datasets.synthetic.robotcar_shots import (
    RobotCarTwinOptions,
    build_robotcar_moments,
)
from megloc_kapture.datasets.synthetic.shots import Shot
from megloc_kapture.datasets.synthetic.truth_masks import on_bonnet, on_movers, stands_still
from megloc_kapture.datasets.synthetic.views import PlacePainter
from megloc_kapture.features.rootsift import RootSift
from megloc_kapture.preprocessing.masks import with_margin

OPTIONS = RobotCarTwinOptions(num_locations=1, moments_per_condition=2, size_px=256)
SEED = OPTIONS.world().seed


@pytest.fixture(scope="module")
def shots() -> list[Shot]:
    return build_robotcar_moments(OPTIONS).query_shots()


@pytest.fixture(scope="module")
def painter() -> PlacePainter:
    return PlacePainter(build_place(OPTIONS.world(), 0), seed=SEED, supersampling=1)


def test_only_the_rear_camera_sees_the_car_always_at_the_same_place(shots: list[Shot]) -> None:
    rear = [shot for shot in shots if shot.sensor_id == "rear"]
    places = [on_bonnet(shot, SEED) for shot in rear]
    assert len(rear) == 12 and all((place == places[0]).all() for place in places)
    assert 0.05 < places[0].mean() < 0.25
    assert places[0][-1].all() and not places[0][: OPTIONS.size_px // 2].any()
    assert not any(on_bonnet(shot, SEED).any() for shot in shots if shot.sensor_id != "rear")


def test_movers_are_where_the_image_changes_without_them(
    shots: list[Shot], painter: PlacePainter
) -> None:
    place = build_place(OPTIONS.world(), 0)
    shot = max(shots, key=lambda one: on_movers(one, place).mean())
    hidden = on_movers(shot, place)
    assert 0.02 < hidden.mean() < 0.6
    # without sun: a shadow is no mover
    shot = replace(shot, look=replace(shot.look, sun=(0.0, 0.0, 0.0)), bonnet=False)
    there = painter.draw(shot, depth=True).depth_m
    gone = painter.draw(replace(shot, movers=()), depth=True).depth_m
    assert there is not None and gone is not None
    assert np.array_equal(there != gone, hidden)
    assert not on_movers(replace(shot, movers=()), place).any()


def test_no_feature_is_left_on_the_bonnet_or_on_a_mover(
    shots: list[Shot], painter: PlacePainter
) -> None:
    place = build_place(OPTIONS.world(), 0)
    extractor = RootSift()
    without = 0
    for shot in (one for one in shots if one.sensor_id == "rear"):
        image, mask = painter.draw(shot).image, stands_still(shot, place, SEED)
        found = extractor.extract(image, with_margin(mask, 3.0)).keypoints_px
        column, row = np.floor(found[:, :2]).astype(int).T
        assert len(found) and mask[row, column].all()
        column, row = np.floor(extractor.extract(image).keypoints_px[:, :2]).astype(int).T
        without += int(on_bonnet(shot, SEED)[row, column].sum())
    assert without > 50  # what there is to be removed
