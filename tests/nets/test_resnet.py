"""ResNet trunks against transformers' on the same weights, dilations against strides."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from torch import nn
from transformers import ResNetConfig, ResNetModel

from megloc_kapture.nets.resnet import Bottleneck, Depth, ResNet, imagenet_normalised

BLOCKS: dict[Depth, list[int]] = {50: [3, 4, 6, 3], 101: [3, 4, 23, 3]}


def randomised(module: nn.Module, seed: int = 0) -> nn.Module:
    """Weights whose activations stay near 1, statistics of no layer trivial."""
    torch.manual_seed(seed)
    for part in module.modules():
        if isinstance(part, nn.Conv2d):
            nn.init.kaiming_normal_(part.weight, mode="fan_in")
        if isinstance(part, nn.BatchNorm2d):
            nn.init.uniform_(part.weight, 0.3, 0.7)
            nn.init.uniform_(part.bias, -0.3, 0.3)
            part.running_mean.uniform_(-0.2, 0.2)
            part.running_var.uniform_(0.5, 2.0)
    return module.eval()


def as_transformers_names(key: str) -> str:
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
    renamed = {as_transformers_names(key): value for key, value in ours.state_dict().items()}
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


def test_a_dilated_convolution_reaches_two_pixels_far() -> None:
    block = randomised(Bottleneck(8, 2, stride=1, dilation=2))
    x = torch.randn(1, 2, 7, 6)
    with torch.inference_mode():
        found = block.conv2(x)[0].numpy()
    weight, padded = (
        block.conv2.weight.detach().numpy(),
        np.pad(x[0].numpy(), [(0, 0)] + 2 * [(2, 2)]),
    )
    by_hand = np.zeros((2, 7, 6))
    for out, row, column in itertools.product(range(2), range(7), range(6)):
        window = padded[:, row : row + 5 : 2, column : column + 5 : 2]
        by_hand[out, row, column] = (weight[out] * window).sum()
    np.testing.assert_allclose(found, by_hand, atol=1e-5)


def test_normalised_is_zero_at_the_mean_and_one_a_deviation_above() -> None:
    mean, deviation = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    for image, expected in ((mean, 0.0), (mean + deviation, 1.0)):
        tensor = torch.tensor(image, dtype=torch.float32)[None, :, None, None].expand(1, 3, 2, 4)
        torch.testing.assert_close(imagenet_normalised(tensor), torch.full((1, 3, 2, 4), expected))
