"""Keys, shapes and sizes of all networks against their published checkpoints."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from published import published_shapes, shapes_of
from torch import nn

from megloc_kapture.features.aliked import aliked_from
from megloc_kapture.features.r2d2 import R2D2Network, load_r2d2
from megloc_kapture.features.superpoint import SuperPointBatchNormNet, SuperPointNet
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.nets.global_descriptors import ApGemNet, VggNetVlad
from megloc_kapture.nets.megaloc import MegaLocNet
from megloc_kapture.nets.superglue import SuperGlueNet
from megloc_kapture.preprocessing.deeplab import DeepLabV3Plus


def openibl_net() -> VggNetVlad:
    return VggNetVlad(order="kd", mean_rgb=(0.0, 0.0, 0.0))


# network and published number of parameters
NETWORKS: dict[str, tuple[Callable[[], nn.Module], int]] = {
    "apgem-resnet101": (ApGemNet, 46_696_513),
    "deeplabv3plus-resnet101": (lambda: DeepLabV3Plus("resnet101", num_classes=19), 58_753_459),
    "deeplabv3plus-mobilenet": (lambda: DeepLabV3Plus("mobilenet", num_classes=19), 5_225_203),
    "megaloc": (MegaLocNet, 228_639_553),
    "openibl": (openibl_net, 149_002_048),
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
