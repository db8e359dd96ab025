"""The pyramid of images: sizes, where levels begin and end, and positions."""

from __future__ import annotations

import pytest
import torch

from megloc_kapture.nets.image_pyramid import pyramid_levels


def sizes(height: int, width: int, smallest: int, largest: int) -> list[tuple[int, int]]:
    levels = pyramid_levels(torch.zeros(1, 1, height, width), min_size=smallest, max_size=largest)
    return [(level.shape[-1], level.shape[-2]) for level in levels]


def test_four_levels_an_octave_between_two_sizes() -> None:
    assert sizes(480, 640, 256, 1024) == [
        (640, 480),
        (538, 404),
        (453, 339),
        (381, 285),
        (320, 240),
        (269, 202),
    ]
    # levels that are too large are made, but not given
    assert sizes(1080, 1920, 600, 1024) == [(960, 540), (807, 454), (679, 382)]


@pytest.mark.parametrize(("side", "count"), [(1024, 9), (1025, 9), (256, 1)])
def test_the_last_level_may_be_rounded_down(side: int, count: int) -> None:
    found = sizes(16, side, 256, 1024)
    assert len(found) == count and 255 <= found[-1][0] <= 257


def test_an_image_smaller_than_the_smallest_level_is_taken_as_it_is() -> None:
    assert sizes(60, 80, 256, 1024) == [(80, 60)]


def test_a_strip_ends_before_it_vanishes() -> None:
    assert sizes(1, 400, 1, 1024)[-1][1] == 1


def test_a_ramp_stays_in_its_place() -> None:
    # the value of a pixel is its centre's x, the first one's 0.5: so it is on every level, scaled
    width = 640
    image = (torch.arange(width) + 0.5).expand(1, 1, 480, width)
    for level in pyramid_levels(image, min_size=256, max_size=1024):
        x = (torch.arange(level.shape[-1]) + 0.5) * width / level.shape[-1]
        inner = slice(2, -2)
        torch.testing.assert_close(level[0, 0, 100, inner], x[inner], atol=0.02, rtol=0)
