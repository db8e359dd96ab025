"""The variant with batch normalisation: its keys, and the official network as its special case."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch.nn import functional

from megloc_kapture.errors import DataError
from megloc_kapture.nets.superpoint import SuperPointNet
from megloc_kapture.nets.superpoint_batchnorm import (
    SuperPointBatchNormNet,
    is_superpoint_batchnorm,
    superpoint_batchnorm,
)

KEYS = Path(__file__).parent / "keys" / "superpoint-batchnorm.txt"
LAYERS = {
    **{
        f"conv{block + 1}{letter}": f"backbone.{block}.{index}"
        for block in range(4)
        for index, letter in enumerate("ab")
    },
    "convPa": "detector.0",
    "convPb": "detector.1",
    "convDa": "descriptor.0",
    "convDb": "descriptor.1",
}


def random_weights(seed: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    found = {}
    for row in KEYS.read_text().splitlines():
        key, shape = row.split()
        sizes = [] if shape == "scalar" else [int(size) for size in shape.split("x")]
        fan_in = sizes[1] * sizes[2] * sizes[3] if len(sizes) == 4 else 10
        found[key] = torch.randn(sizes, generator=generator) * (2 / fan_in) ** 0.5
        if key.endswith(("bn.weight", "running_var")):
            found[key] = 0.5 + torch.rand(sizes, generator=generator)
    return found


def gray() -> torch.Tensor:
    return torch.rand((1, 1, 61, 74), generator=torch.Generator().manual_seed(0))


def test_keys_and_shapes_are_the_published_ones() -> None:
    state = SuperPointBatchNormNet().state_dict()
    rows = [row.split() for row in KEYS.read_text().splitlines()]
    shapes = {
        key: "x".join(map(str, value.shape)) if value.ndim else "scalar"
        for key, value in state.items()
    }
    assert shapes == dict(rows)


@torch.inference_mode()
def test_without_normalisation_it_is_the_official_network() -> None:
    weights = random_weights(0)
    for key, value in weights.items():
        if key.endswith(("bn.bias", "running_mean")):
            value.zero_()
        elif key.endswith("bn.weight"):
            value.fill_(1.0)
        elif key.endswith("running_var"):
            value.fill_(1 - 1e-3)  # with the epsilon it is one
    official = SuperPointNet().eval()
    official.load_state_dict(
        {
            f"{layer}.{kind}": weights[f"{block}.conv.{kind}"]
            for layer, block in LAYERS.items()
            for kind in ("weight", "bias")
        }
    )
    found = superpoint_batchnorm(weights, "w.pth").eval()(gray())
    for ours, expected in zip(found, official(gray()), strict=True):
        torch.testing.assert_close(ours, expected, rtol=0, atol=1e-5)


@torch.inference_mode()
def test_the_normalisation_follows_the_activation() -> None:
    weights = random_weights(1)

    def block(x: torch.Tensor, name: str, *, relu: bool = True) -> torch.Tensor:
        kernel = weights[f"{name}.conv.weight"]
        x = functional.conv2d(
            x, kernel, weights[f"{name}.conv.bias"], padding=kernel.shape[-1] // 2
        )
        x = x.clamp(min=0) if relu else x
        mean, var, gain, bias = (
            weights[f"{name}.bn.{kind}"][:, None, None]
            for kind in ("running_mean", "running_var", "weight", "bias")
        )
        return (x - mean) / (var + 1e-3).sqrt() * gain + bias

    x = gray()
    for stage in range(4):
        x = block(block(x, f"backbone.{stage}.0"), f"backbone.{stage}.1")
        x = functional.max_pool2d(x, 2) if stage < 3 else x
    logits = block(block(x, "detector.0"), "detector.1", relu=False)
    described = block(block(x, "descriptor.0"), "descriptor.1", relu=False)
    scores, descriptors = superpoint_batchnorm(weights, "w.pth").eval()(gray())
    probabilities = logits.softmax(dim=1)[0, :64].view(8, 8, 7, 9)
    expected = probabilities.permute(2, 0, 3, 1).reshape(56, 72)
    torch.testing.assert_close(scores[0], expected, rtol=0, atol=1e-5)
    expected = described / described.norm(dim=1, keepdim=True)
    torch.testing.assert_close(descriptors, expected, rtol=0, atol=1e-5)


def test_it_is_known_by_its_keys_and_refused_by_them() -> None:
    weights = random_weights(2)
    assert is_superpoint_batchnorm(weights)
    assert not is_superpoint_batchnorm(SuperPointNet().state_dict())
    # older files of torch have no counters
    counted = {k: v for k, v in weights.items() if not k.endswith("num_batches_tracked")}
    superpoint_batchnorm(counted, "w.pth")
    del counted["detector.1.bn.running_var"]
    with pytest.raises(DataError, match=r"w\.pth: .*detector\.1\.bn\.running_var"):
        superpoint_batchnorm(counted, "w.pth")
