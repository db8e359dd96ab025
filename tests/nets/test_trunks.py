"""ResNet against transformers, and generalized-mean pooling.

tests/preprocessing/test_deeplab.py compares MobileNetV2 and the dilated ResNet.
"""

from __future__ import annotations

import torch
from published import randomised
from transformers import ResNetConfig, ResNetModel

from megloc_kapture.nets.trunks import ResNet, generalized_mean


def resnet_names(key: str) -> str:
    """Key of our trunk -> key of transformers'."""
    parts = key.split(".")
    kind = {"c": "convolution", "b": "normalization"}
    if parts[0] in ("conv1", "bn1"):
        return f"embedder.embedder.{kind[parts[0][0]]}.{parts[-1]}"
    stage, block = int(parts[0][-1]) - 1, parts[1]
    place = f"encoder.stages.{stage}.layers.{block}"
    if parts[2] == "downsample":
        part = "convolution" if parts[3] == "0" else "normalization"
        return f"{place}.shortcut.{part}.{parts[4]}"
    return f"{place}.layer.{int(parts[2][-1]) - 1}.{kind[parts[2][0]]}.{parts[3]}"


def test_stages_equal_transformers() -> None:
    ours = randomised(ResNet(50))
    theirs = ResNetModel(ResNetConfig(depths=[3, 4, 6, 3], layer_type="bottleneck")).eval()
    renamed = {resnet_names(key): value for key, value in ours.state_dict().items()}
    theirs.load_state_dict(renamed, strict=True)
    image = torch.randn(1, 3, 65, 98)
    with torch.inference_mode():
        result = ours(image)
        expected = theirs(image, output_hidden_states=True).hidden_states[1:]
    assert [f.shape[1] for f in result] == [256, 512, 1024, 2048]
    for stage, other in zip(result, expected, strict=True):
        assert other.std() > 0.1
        torch.testing.assert_close(stage, other, rtol=1e-5, atol=1e-5 * float(other.abs().max()))


def test_the_generalized_mean_clamps_small_values_and_does_not_overflow() -> None:
    least = generalized_mean(torch.tensor([-5.0, 0.0, 1e-9]).view(1, 1, 1, 3), 3.0)
    torch.testing.assert_close(least, torch.tensor([[1e-6]]))
    # the third power of a half would overflow
    large = generalized_mean(torch.full((1, 1, 2, 2), 500.0, dtype=torch.float16), 3.0)
    assert large.dtype == torch.float32
    torch.testing.assert_close(large, torch.tensor([[500.0]]))
