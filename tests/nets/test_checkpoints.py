"""Loading, keys, shapes and sizes of networks by their published checkpoints, and TF32."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from published import published_shapes, shapes_of
from torch import nn

from megloc_kapture.errors import DataError
from megloc_kapture.features.aliked import aliked_from
from megloc_kapture.features.r2d2 import R2D2Network, load_r2d2
from megloc_kapture.features.superpoint import SuperPointBatchNormNet, SuperPointNet
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.nets.global_descriptors import ApGemNet, VggNetVlad
from megloc_kapture.nets.megaloc import MegaLocNet
from megloc_kapture.nets.runtime import load_strictly, sized_tensor, without_tf32
from megloc_kapture.nets.superglue import SuperGlueNet
from megloc_kapture.preprocessing.deeplab import DeepLabV3Plus

CPU = torch.device("cpu")


def test_checkpoints_load_strictly() -> None:
    net, other = nn.Linear(3, 2), nn.Linear(3, 2)
    whole = dict(other.state_dict())
    assert load_strictly(net, whole, "w.pth") is net
    assert torch.equal(net.weight, other.weight) and torch.equal(net.bias, other.bias)
    for tensors, message in (
        ({"bias": whole["bias"]}, "1 missing keys: weight"),
        (whole | {"extra": torch.ones(1)}, "1 unexpected keys: extra"),
        (
            whole | {"bias": torch.ones(3)},
            r"1 keys with a different shape: bias is \(3,\), not \(2,\)",
        ),
    ):
        with pytest.raises(DataError, match=rf"^w\.pth: .*does not fit Linear; {message}$"):
            load_strictly(net, tensors, "w.pth")
    load_strictly(net, {"bias": torch.ones(2)}, "w.pth", may_lack={"weight"})
    assert torch.equal(net.weight, other.weight) and net.bias.tolist() == [1, 1]


@pytest.mark.parametrize(
    ("height", "width", "most", "size"),
    [(6, 9, 9, (6, 9)), (6, 9, None, (6, 9)), (150, 99, 102, (102, 67)), (3, 2000, 100, (1, 100))],
)
def test_images_are_reduced_to_the_limit(height: int, width: int, most: Any, size: Any) -> None:
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    result = sized_tensor(image, most, CPU)
    assert result.shape == (1, 3, *size) and result.dtype == torch.float32
    if size == (height, width):
        np.testing.assert_allclose(result[0].numpy() * 255, image.transpose(2, 0, 1), atol=1e-4)


def test_half_the_size_is_the_unrounded_mean_of_four_pixels() -> None:
    image = np.random.default_rng(0).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    result = sized_tensor(image, 6, CPU)[0].permute(1, 2, 0).numpy() * 255
    expected = image.reshape(4, 2, 6, 2, 3).astype(float).mean(axis=(1, 3))
    np.testing.assert_allclose(result, expected, atol=1e-3)


def test_tf32_is_off_only_during_inference() -> None:
    newer = hasattr(torch.backends.cuda.matmul, "fp32_precision")  # torch 2.9
    name, enabled, exact = (
        ("fp32_precision", "tf32", "ieee") if newer else ("allow_tf32", True, False)
    )
    setting: Any = torch.backends.cuda.matmul
    before = getattr(setting, name)
    setattr(setting, name, enabled)
    try:
        with without_tf32(torch.device("cuda")):
            assert getattr(setting, name) == exact
        assert getattr(setting, name) == enabled
    finally:
        setattr(setting, name, before)


# network and published number of parameters
NETWORKS: dict[str, tuple[Callable[[], nn.Module], int]] = {
    "apgem-resnet101": (ApGemNet, 46_696_513),
    "deeplabv3plus-resnet101": (lambda: DeepLabV3Plus("resnet101", num_classes=19), 58_753_459),
    "deeplabv3plus-mobilenet": (lambda: DeepLabV3Plus("mobilenet", num_classes=19), 5_225_203),
    "megaloc": (MegaLocNet, 228_639_553),
    "openibl": (lambda: VggNetVlad(order="kd", mean_rgb=(0, 0, 0)), 149_002_048),
    "superglue": (SuperGlueNet, 12_023_297),
    "superpoint": (SuperPointNet, 1_300_865),
}


# network and number of values in the published file
STORED: dict[str, tuple[Callable[[], nn.Module], int | None]] = {
    "r2d2_WASF_N16": (R2D2Network, 485_803),
    "r2d2_WASF_N8_big": (lambda: R2D2Network(48), 1_041_019),
    "superpoint-batchnorm": (SuperPointBatchNormNet, None),
}
ALIKED = {"aliked-t16": (192_588, 64), "aliked-n16": (678_324, 128), "aliked-n32": (980_468, 128)}
R2D2_WIDTHS = {"r2d2_WAF_N16": 32, "r2d2_WASF_N16": 32, "r2d2_WASF_N8_big": 48}


@pytest.mark.parametrize("name", [*NETWORKS, *STORED])
def test_keys_and_shapes_equal_the_published_checkpoints(name: str) -> None:
    make, number = (NETWORKS | STORED)[name]
    with torch.device("meta"):
        network = make()
    shapes, published = shapes_of(network), published_shapes(name)
    assert shapes == published
    counted = shapes if name in STORED else dict(network.named_parameters())
    assert number in (None, sum(math.prod(published[key]) for key in counted))


@pytest.mark.parametrize("name", [*ALIKED, *R2D2_WIDTHS])
def test_published_files_load_strictly(shared_data: Path, name: str) -> None:
    is_aliked = name in ALIKED
    place = f"aliked/{name}.pth" if is_aliked else f"r2d2/{name}.pt"
    tensors = read_weights(find_weights(str(shared_data / "weights" / place)))
    net: Any = aliked_from(tensors, name) if is_aliked else load_r2d2(tensors, name)
    assert not net.training
    state = net.state_dict()
    assert state.keys() == tensors.keys()
    assert all(torch.equal(state[key], tensors[key]) for key in tensors)
    if is_aliked:
        assert shapes_of(net) == published_shapes(name)
        numbers = sum(values.numel() for values in state.values())
        assert (numbers, net.descriptor_size) == ALIKED[name]
    else:
        assert net.ops[0].out_channels == R2D2_WIDTHS[name]
