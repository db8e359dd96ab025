"""VGG-16 and ResNet against other implementations of them, and generalized-mean pooling.

MobileNetV2 is compared as part of the published DeepLabV3+ (test_deeplabv3plus.py).
"""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
import torch
from published import randomised
from torch.nn import functional as F
from transformers import (
    ResNetConfig,
    ResNetModel,
)

from megloc_kapture.nets.trunks import (
    Depth,
    ResNet,
    Vgg16Features,
    generalized_mean,
)

# configuration D of the paper's table 1; P: pooling. torchvision counts convolution, ReLU, pooling
CONFIGURATION: tuple[int | str, ...] = (
    *(64, 64, "P", 128, 128, "P"),
    *(256, 256, 256, "P", 512, 512, 512, "P", 512, 512, 512, "P"),
)
BLOCKS: dict[Depth, list[int]] = {50: [3, 4, 6, 3], 101: [3, 4, 23, 3]}


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


def test_every_activation_is_the_restated_one(trunk: Vgg16Features, image: torch.Tensor) -> None:
    before = image.clone()
    # float32 differs between processors by as much as the bound
    found = deepcopy(trunk).double().taps(image.double(), range(31))
    expected = restated(trunk.state_dict(), image)
    assert len(expected) == len(found) == 31
    for one, other in zip(found, expected, strict=True):
        assert one.shape == other.shape and other.std() > 0.05
        torch.testing.assert_close(one.double(), other, rtol=0, atol=1e-5 * float(other.std()))
    assert torch.equal(image, before)


@pytest.mark.parametrize("last", [0, 28, 29, 30])
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
    assert (cut(image) < 0).any() == (last in (0, 28))


def test_gradients_are_those_of_the_restated_chain(trunk: Vgg16Features) -> None:
    generator = torch.Generator().manual_seed(2)
    image = torch.randn(1, 3, 20, 17, generator=generator, requires_grad=True)
    (gradient,) = torch.autograd.grad(trunk.taps(image, [8, 15])[1].sum(), image)
    expected = torch.autograd.grad(restated(trunk.state_dict(), image)[15].sum(), image)[0]
    assert np.abs(expected.numpy()).max() > 0.1
    torch.testing.assert_close(gradient, expected.float(), rtol=1e-3, atol=1e-4)


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
    for wrong in ([31], [-1], [3, 99], []):
        with pytest.raises(ValueError, match="are not of 0 to 30"):
            trunk.taps(image, wrong)
    with pytest.raises(ValueError, match="last is 31"):
        Vgg16Features(last=31)


def resnet_names(key: str) -> str:
    """Key of our trunk -> key of transformers'."""
    parts = key.split(".")
    kind = {"c": "convolution", "b": "normalization"}
    if parts[0] in ("conv1", "bn1"):
        return f"embedder.embedder.{kind[parts[0][0]]}.{parts[-1]}"
    stage, block = int(parts[0][-1]) - 1, parts[1]
    place = f"encoder.stages.{stage}.layers.{block}"
    if parts[2] == "downsample":
        return (
            f"{place}.shortcut.{'convolution' if parts[3] == '0' else 'normalization'}.{parts[4]}"
        )
    return f"{place}.layer.{int(parts[2][-1]) - 1}.{kind[parts[2][0]]}.{parts[3]}"


@pytest.mark.parametrize(("depth", "size"), [(50, (97, 130)), (101, (64, 80))])
def test_the_stages_are_transformers_stages(depth: Depth, size: tuple[int, int]) -> None:
    ours = randomised(ResNet(depth))
    theirs = ResNetModel(ResNetConfig(depths=BLOCKS[depth], layer_type="bottleneck")).eval()
    renamed = {resnet_names(key): value for key, value in ours.state_dict().items()}
    theirs.load_state_dict(renamed, strict=True)
    image = torch.randn(2, 3, *size)
    with torch.inference_mode():
        found = ours(image)
        expected = theirs(image, output_hidden_states=True).hidden_states[1:]
    assert [f.shape[1] for f in found] == [256, 512, 1024, 2048]
    for one, other in zip(found, expected, strict=True):
        assert one.shape == other.shape
        assert other.std() > 0.1  # the comparison says something
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5 * float(other.abs().max()))


@pytest.mark.parametrize("output_stride", [8, 16])
def test_dilations_keep_what_strides_would_give(output_stride: int) -> None:
    # every place that the strided trunk has, the dilated one has too, with the same features
    strided = randomised(ResNet(50))
    dilated = ResNet(50, output_stride=output_stride).eval()
    dilated.load_state_dict(strided.state_dict(), strict=True)
    image = torch.randn(1, 3, 75, 118)
    with torch.inference_mode():
        few, many = strided(image), dilated(image)
    for one, other in zip(few, many, strict=True):
        step = -(-other.shape[-1] // one.shape[-1])
        sampled = other[:, :, ::step, ::step]
        torch.testing.assert_close(sampled, one, rtol=1e-5, atol=1e-5 * float(one.abs().max()))
    assert many[-1].shape[-2:] == (-(-75 // output_stride), -(-118 // output_stride))
    assert many[-1].shape[-1] > few[-1].shape[-1]


@pytest.mark.parametrize("power", [0.5, 1.0, 2.7, 3.0])
def test_the_generalized_mean_is_its_definition(power: float) -> None:
    features = np.random.default_rng(0).uniform(0, 3, (2, 5, 4, 7))
    expected = np.zeros((2, 5))
    for image, channel in np.ndindex(2, 5):
        places = features[image, channel].ravel()
        expected[image, channel] = (sum(x**power for x in places) / len(places)) ** (1 / power)
    for given in (power, torch.tensor([power], dtype=torch.float64)):
        found = generalized_mean(torch.from_numpy(features), given)
        np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)


def test_the_generalized_mean_of_numbers_at_the_ends_of_their_range() -> None:
    least = generalized_mean(torch.tensor([-5.0, 0.0, 1e-9]).view(1, 1, 1, 3), 3.0)
    torch.testing.assert_close(least, torch.tensor([[1e-6]]))
    # the third power of a half would overflow
    large = generalized_mean(torch.full((1, 1, 2, 2), 500.0, dtype=torch.float16), 3.0)
    assert large.dtype == torch.float32
    torch.testing.assert_close(large, torch.tensor([[500.0]]))
