"""R2D2's network: keys, sizes, and a second implementation written down as the paper's layers."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from published import published_shapes
from torch.nn import functional

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.nets.r2d2 import R2D2Network, load_r2d2, pyramid_levels

FILES = {"r2d2_WAF_N16": 32, "r2d2_WASF_N16": 32, "r2d2_WASF_N8_big": 48}


def random_tensors(name: str = "r2d2_WASF_N16", seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    tensors = {}
    for key, shape in published_shapes(name).items():
        fan_in = max(1, int(torch.tensor(shape[1:]).prod())) if len(shape) == 4 else 4
        tensors[key] = torch.randn(shape, generator=generator) / fan_in**0.5
        if key.endswith("running_var"):
            tensors[key] = tensors[key].abs() + 0.5
        elif key.endswith("num_batches_tracked"):
            tensors[key] = torch.tensor(3)
    return tensors


def published(shared_data: Path, name: str) -> dict[str, torch.Tensor]:
    return read_weights(find_weights(str(shared_data / "weights" / "r2d2" / f"{name}.pt")))


@pytest.mark.parametrize(
    ("name", "stored"), [("r2d2_WASF_N16", 485_803), ("r2d2_WASF_N8_big", 1_041_019)]
)
def test_keys_and_shapes_are_the_published_ones(name: str, stored: int) -> None:
    state = R2D2Network(FILES[name]).state_dict()
    assert {key: tuple(value.shape) for key, value in state.items()} == published_shapes(name)
    assert sum(value.numel() for value in state.values()) == stored


@pytest.mark.parametrize("name", list(FILES))
def test_the_published_files_load_strictly(shared_data: Path, name: str) -> None:
    tensors = published(shared_data, name)
    network = load_r2d2(tensors, name)
    assert not network.training
    assert network.ops[0].out_channels == FILES[name]
    state = network.state_dict()
    assert state.keys() == tensors.keys()
    assert all(torch.equal(state[key], tensors[key]) for key in tensors)


def test_what_does_not_fit_is_named() -> None:
    tensors = random_tensors()
    with pytest.raises(DataError, match=r"r\.pt: .*ops\.0\.weight"):
        load_r2d2({}, "r.pt")
    lost = tensors.pop("ops.12.bias")
    with pytest.raises(DataError, match=r"r\.pt: .*missing keys: ops\.12\.bias"):
        load_r2d2(tensors, "r.pt")
    with pytest.raises(DataError, match=r"unexpected keys: extra"):
        load_r2d2(tensors | {"ops.12.bias": lost, "extra": lost}, "r.pt")
    with pytest.raises(DataError, match=r"ops\.12\.bias is \(64,\), not \(128,\)"):
        load_r2d2(tensors | {"ops.12.bias": lost[:64]}, "r.pt")


def by_hand(
    tensors: dict[str, torch.Tensor], image: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The layers as a table: convolution, padding, dilation, whether a ReLU follows."""
    x = (image - torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)) / (
        torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1)
    )
    table = [
        (0, 1, 1, True),
        (3, 1, 1, True),
        (6, 1, 1, True),
        (9, 2, 2, True),
        (12, 2, 2, True),
        (15, 4, 4, True),
        (18, 2, 4, False),
        (20, 4, 8, False),
        (22, 8, 16, None),
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
    tensors = random_tensors(seed=1)
    image = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(2))
    with torch.inference_mode():
        found = load_r2d2(tensors, "r")(image)
        expected = by_hand(tensors, image)
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.shape[-2:] == size
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_a_pixel_sees_its_surroundings_evenly() -> None:
    # the kernels of 2 by 2 have no middle: a shift of theirs would move every keypoint
    network = load_r2d2(random_tensors(seed=3), "r").double()
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
