"""R2D2's network against the paper's layers written down, and the levels of its pyramid."""

from __future__ import annotations

import pytest
import torch
from published import random_tensors
from torch.nn import functional

from megloc_kapture.nets.r2d2 import load_r2d2, pyramid_levels


def by_hand(
    tensors: dict[str, torch.Tensor], image: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The layers as a table: convolution, padding, dilation, whether a ReLU follows."""
    x = (image - torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)) / (
        torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1)
    )
    table = [
        *((0, 1, 1, True), (3, 1, 1, True), (6, 1, 1, True), (9, 2, 2, True), (12, 2, 2, True)),
        *((15, 4, 4, True), (18, 2, 4, False), (20, 4, 8, False), (22, 8, 16, None)),
    ]
    for index, padding, dilation, relu in table:
        weight, bias = tensors[f"ops.{index}.weight"], tensors[f"ops.{index}.bias"]
        x = functional.conv2d(x, weight, bias, padding=padding, dilation=dilation)
        if relu is None:
            break
        mean = tensors[f"ops.{index + 1}.running_mean"].view(-1, 1, 1)
        variance = tensors[f"ops.{index + 1}.running_var"].view(-1, 1, 1)
        x = (x - mean) / (variance + 1e-5).sqrt()
        x = x.clamp(min=0) if relu else x
    clf = functional.conv2d(x**2, tensors["clf.weight"], tensors["clf.bias"])
    sal = functional.conv2d(x**2, tensors["sal.weight"], tensors["sal.bias"]).exp().log1p()
    reliability = clf[:, 1:].exp() / clf.exp().sum(1, keepdim=True)
    return x, reliability, sal / (1 + sal)


@pytest.mark.parametrize("size", [(40, 56), (33, 47)])
def test_the_maps_are_those_of_the_layers_written_down(size: tuple[int, int]) -> None:
    tensors = random_tensors("r2d2_WASF_N16", 1)
    image = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(2))
    with torch.inference_mode():
        found = load_r2d2(tensors, "r")(image)
        expected = by_hand(tensors, image)
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.shape[-2:] == size
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_a_pixel_sees_its_surroundings_evenly() -> None:
    # the kernels of 2 by 2 have no middle: a shift of theirs would move every keypoint
    network = load_r2d2(random_tensors("r2d2_WASF_N16", 3), "r").double()
    image = torch.rand(1, 3, 121, 121, dtype=torch.float64).requires_grad_()
    network(image).repeatability[0, 0, 60, 60].backward()
    assert image.grad is not None
    seen = torch.nonzero(image.grad.abs().amax(dim=(0, 1)))
    radius = (60 - seen.amin(dim=0)).tolist()
    assert radius == (seen.amax(dim=0) - 60).tolist() and radius[0] == radius[1] < 60


def sizes(height: int, width: int, smallest: int, largest: int) -> list[tuple[int, int]]:
    levels = pyramid_levels(torch.zeros(1, 1, height, width), min_size=smallest, max_size=largest)
    return [(level.shape[-1], level.shape[-2]) for level in levels]


def test_four_levels_an_octave_between_two_sizes() -> None:
    found = sizes(480, 640, 256, 1024)
    assert found == [(640, 480), (538, 404), (453, 339), (381, 285), (320, 240), (269, 202)]
    # levels that are too large are made, but not given
    assert sizes(1080, 1920, 600, 1024) == [(960, 540), (807, 454), (679, 382)]
    # an image that is smaller than the smallest level is taken as it is
    assert sizes(60, 80, 256, 1024) == [(80, 60)]
    # a strip ends before it vanishes
    assert sizes(1, 400, 1, 1024)[-1][1] == 1


@pytest.mark.parametrize(("side", "count"), [(1024, 9), (1025, 9), (256, 1)])
def test_the_last_level_may_be_rounded_down(side: int, count: int) -> None:
    found = sizes(16, side, 256, 1024)
    assert len(found) == count and 255 <= found[-1][0] <= 257


def test_a_ramp_stays_in_its_place() -> None:
    # the value of a pixel is its centre's x, the first one's 0.5: so it is on every level, scaled
    width = 640
    image = (torch.arange(width) + 0.5).expand(1, 1, 480, width)
    for level in pyramid_levels(image, min_size=256, max_size=1024):
        x = (torch.arange(level.shape[-1]) + 0.5) * width / level.shape[-1]
        inner = slice(2, -2)
        torch.testing.assert_close(level[0, 0, 100, inner], x[inner], atol=0.02, rtol=0)
