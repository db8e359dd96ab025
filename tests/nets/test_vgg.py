"""VGG-16's convolutions against a chain of plain functions that is written from the paper."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from megloc_kapture.nets.vgg import Vgg16Features

# configuration D of the paper's table 1; P: pooling. torchvision counts convolution, ReLU, pooling
CONFIGURATION: tuple[int | str, ...] = (
    *(64, 64, "P", 128, 128, "P"),
    *(256, 256, 256, "P", 512, 512, 512, "P", 512, 512, 512, "P"),
)


@pytest.fixture(scope="module")
def trunk() -> Vgg16Features:
    torch.manual_seed(0)
    net = Vgg16Features()
    for name, value in net.state_dict().items():
        # activations stay near 1, biases count
        value.normal_(0, 0.3 if name.endswith("bias") else (2 / value[0].numel()) ** 0.5)
    return net.eval().requires_grad_(False)


@pytest.fixture(scope="module")
def image() -> torch.Tensor:
    return torch.randn(2, 3, 33, 34, generator=torch.Generator().manual_seed(1))  # odd sides


def restated(state: dict[str, torch.Tensor], image: torch.Tensor) -> list[torch.Tensor]:
    """All activations, float64; pooling as the maximum of a window's four."""
    activations: list[torch.Tensor] = []
    x = image.double()
    for word in CONFIGURATION:
        if word == "P":
            height, width = x.shape[-2] // 2, x.shape[-1] // 2
            even = x[..., : 2 * height, : 2 * width]
            x = even.reshape(*x.shape[:2], height, 2, width, 2).amax((3, 5))
            activations.append(x)
            continue
        number = len(activations)
        weight, bias = (state[f"{number}.{kind}"].double() for kind in ("weight", "bias"))
        assert len(weight) == word
        x = F.conv2d(F.pad(x, (1, 1, 1, 1)), weight) + bias[:, None, None]
        activations.append(x)
        x = x.clamp(min=0)
        activations.append(x)
    return activations


def test_keys_and_shapes_are_torchvisions() -> None:
    with torch.device("meta"):
        state = Vgg16Features().state_dict()
    channels, number = 3, 0
    expected: dict[str, tuple[int, ...]] = {}
    for word in CONFIGURATION:
        if isinstance(word, str):
            number += 1
            continue
        expected[f"{number}.weight"] = (word, channels, 3, 3)
        expected[f"{number}.bias"] = (word,)
        channels, number = word, number + 2
    assert {key: tuple(value.shape) for key, value in state.items()} == expected
    assert number == 31 and sum(v.numel() for v in state.values()) == 14_714_688


def test_every_activation_is_the_restated_one(trunk: Vgg16Features, image: torch.Tensor) -> None:
    before = image.clone()
    found = trunk.taps(image, range(31))
    expected = restated(trunk.state_dict(), image)
    assert len(expected) == len(found) == 31
    for one, other in zip(found, expected, strict=True):
        assert one.shape == other.shape and other.std() > 0.05
        torch.testing.assert_close(one.double(), other, rtol=0, atol=1e-5 * float(other.std()))
    assert torch.equal(image, before)


@pytest.mark.parametrize("last", [0, 1, 2, 28, 29, 30])
def test_a_trunk_that_ends_earlier(trunk: Vgg16Features, image: torch.Tensor, last: int) -> None:
    with torch.device("meta"):
        cut = Vgg16Features(last=last)
    assert set(cut.state_dict()) == {
        key for key in trunk.state_dict() if int(key.split(".")[0]) <= last
    }
    cut.load_state_dict(trunk.state_dict(), strict=False, assign=True)
    before = image.clone()
    assert torch.equal(cut(image), trunk.taps(image, [last])[0])
    assert torch.equal(image, before)
    assert (cut(image) < 0).any() == (last in (0, 2, 28))


def test_taps_are_in_the_order_of_their_indices_and_stay(
    trunk: Vgg16Features, image: torch.Tensor
) -> None:
    # layers that a later ReLU could spoil, asked for out of order and twice
    indices = (28, 3, 2, 29, 3)
    found = trunk.taps(image, indices)
    expected = restated(trunk.state_dict(), image)
    for number, one in zip(indices, found, strict=True):
        torch.testing.assert_close(one.double(), expected[number], rtol=0, atol=1e-4)
    assert (found[0] < 0).any() and (found[2] < 0).any()


def test_gradients_are_those_of_the_restated_chain(trunk: Vgg16Features) -> None:
    generator = torch.Generator().manual_seed(2)
    image = torch.randn(1, 3, 20, 17, generator=generator, requires_grad=True)
    (gradient,) = torch.autograd.grad(trunk.taps(image, [8, 15])[1].sum(), image)
    expected = torch.autograd.grad(restated(trunk.state_dict(), image)[15].sum(), image)[0]
    assert np.abs(expected.numpy()).max() > 0.1
    torch.testing.assert_close(gradient, expected.float(), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("indices", [[31], [-1], [3, 99], []])
def test_layers_that_are_not_there(trunk: Vgg16Features, indices: list[int]) -> None:
    with pytest.raises(ValueError, match="are not of 0 to 30"):
        trunk.taps(torch.zeros(1, 3, 16, 16), indices)
    with pytest.raises(ValueError, match="last is 31"):
        Vgg16Features(last=31)
