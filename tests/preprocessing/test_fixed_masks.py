"""Masks that are drawn: shares of the height, polygons, and which images they are for."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.path import Path as Outline
from pydantic import ValidationError

from megloc_kapture.preprocessing.fixed_masks import FixedMask, outside_polygon


@pytest.mark.parametrize(
    ("share", "height", "used"), [(0.25, 8, 6), (0.2, 5, 4), (0.001, 4, 4), (0.5, 5, 2)]
)
def test_the_bottom_share_is_ignored(share: float, height: int, used: int) -> None:
    mask = FixedMask(camera="rear", bottom_share=share).drawn(3, height)
    assert mask.shape == (height, 3)
    assert mask[:used].all() and not mask[used:].any()


@pytest.mark.parametrize("seed", range(5))
def test_a_polygon_is_what_another_library_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 7))
    radius = rng.uniform(0.1, 0.5, 7)
    corners = 0.5 + radius[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    width, height = 61, 307
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    inside = Outline(corners * [width, height]).contains_points(
        np.stack([x.ravel(), y.ravel()], axis=1)
    )
    found = outside_polygon(corners, width, height)
    np.testing.assert_array_equal(~found.ravel(), inside)
    assert 0 < inside.mean() < 1


def test_a_polygon_to_the_edges_covers_its_half() -> None:
    half = FixedMask(camera="c", polygon=((0, 0.5), (1, 0.5), (1, 1), (0, 1))).drawn(10, 6)
    assert half[:3].all() and not half[3:].any()


def test_it_is_for_a_sensor_or_a_pattern_of_images() -> None:
    by_id = FixedMask(camera="rear", bottom_share=0.1)
    assert by_id.is_for("rear", "left/1.jpg") and not by_id.is_for("left", "rear/1.jpg")
    by_name = FixedMask(camera="*/rear/*.jpg", bottom_share=0.1)
    assert by_name.is_for("c0", "day/rear/1.jpg")
    assert not by_name.is_for("c0", "day/left/1.jpg")
    assert not by_name.is_for("c0", "day/REAR/1.jpg")


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
def test_what_is_no_fixed_mask(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        FixedMask.model_validate({"camera": "c", **values})


def test_a_file_is_not_drawn() -> None:
    with pytest.raises(ValueError, match="is a file"):
        FixedMask.model_validate({"camera": "c", "file": "a.png"}).drawn(4, 4)
