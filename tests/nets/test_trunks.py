"""VGG-16 and ResNet against other implementations of them, and generalized-mean pooling.

MobileNetV2 is compared as part of the published DeepLabV3+ (tests/preprocessing/test_deeplab.py).
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from published import randomised
from transformers import (
    ResNetConfig,
    ResNetModel,
)

from megloc_kapture.nets.trunks import (
    ResNet,
    generalized_mean,
)


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


def test_the_stages_are_transformers_stages() -> None:
    ours = randomised(ResNet(50))
    theirs = ResNetModel(ResNetConfig(depths=[3, 4, 6, 3], layer_type="bottleneck")).eval()
    renamed = {resnet_names(key): value for key, value in ours.state_dict().items()}
    theirs.load_state_dict(renamed, strict=True)
    image = torch.randn(2, 3, 65, 98)
    with torch.inference_mode():
        result = ours(image)
        expected = theirs(image, output_hidden_states=True).hidden_states[1:]
    assert [f.shape[1] for f in result] == [256, 512, 1024, 2048]
    for one, other in zip(result, expected, strict=True):
        assert one.shape == other.shape
        assert other.std() > 0.1  # the comparison says something
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5 * float(other.abs().max()))


def test_dilated_features_contain_the_strided_ones() -> None:
    # every place that the strided trunk has, the dilated one has too, with the same features
    strided = randomised(ResNet(50))
    dilated = ResNet(50, dilated=True).eval()
    dilated.load_state_dict(strided.state_dict(), strict=True)
    image = torch.randn(1, 3, 75, 118)
    with torch.inference_mode():
        few, many = strided(image), dilated(image)
    for one, other in zip(few, many, strict=True):
        step = -(-other.shape[-1] // one.shape[-1])
        sampled = other[:, :, ::step, ::step]
        torch.testing.assert_close(sampled, one, rtol=1e-5, atol=1e-5 * float(one.abs().max()))
    assert many[-1].shape[-2:] == (-(-75 // 16), -(-118 // 16))
    assert many[-1].shape[-1] > few[-1].shape[-1]


@pytest.mark.parametrize("power", [0.5, 1.0, 2.7, 3.0])
def test_the_generalized_mean_is_its_definition(power: float) -> None:
    features = np.random.default_rng(0).uniform(0, 3, (2, 5, 4, 7))
    expected = np.zeros((2, 5))
    for image, channel in np.ndindex(2, 5):
        places = features[image, channel].ravel()
        expected[image, channel] = (sum(x**power for x in places) / len(places)) ** (1 / power)
    for given in (power, torch.tensor([power], dtype=torch.float64)):
        result = generalized_mean(torch.from_numpy(features), given)
        np.testing.assert_allclose(result.numpy(), expected, rtol=1e-12)


def test_the_generalized_mean_of_numbers_at_the_ends_of_their_range() -> None:
    least = generalized_mean(torch.tensor([-5.0, 0.0, 1e-9]).view(1, 1, 1, 3), 3.0)
    torch.testing.assert_close(least, torch.tensor([[1e-6]]))
    # the third power of a half would overflow
    large = generalized_mean(torch.full((1, 1, 2, 2), 500.0, dtype=torch.float16), 3.0)
    assert large.dtype == torch.float32
    torch.testing.assert_close(large, torch.tensor([[500.0]]))
