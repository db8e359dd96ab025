"""Checkpoints of all networks: the published keys, shapes and files, and files that do not fit."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from published import published_shapes, shapes_of
from torch import nn

from megloc_kapture.errors import DataError
from megloc_kapture.features.aliked import aliked_from
from megloc_kapture.features.r2d2 import R2D2Network, load_r2d2
from megloc_kapture.features.superpoint import (
    SuperPointBatchNormNet,
    SuperPointNet,
    superpoint_from,
)
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.nets.global_descriptors import (
    ApGemNet,
    VggNetVlad,
    apgem_from,
    openibl,
)
from megloc_kapture.nets.megaloc import MegaLocNet, megaloc_from
from megloc_kapture.nets.runtime import load_strictly
from megloc_kapture.nets.superglue import SuperGlueNet, superglue
from megloc_kapture.preprocessing.deeplab import DeepLabV3Plus

Load = Callable[[Mapping[str, torch.Tensor], str], nn.Module]


def openibl_net() -> VggNetVlad:
    return VggNetVlad(order="kd", mean_rgb=(0.0, 0.0, 0.0))


def deeplab_mobilenet(tensors: Mapping[str, torch.Tensor], where: str) -> nn.Module:
    return load_strictly(DeepLabV3Plus("mobilenet", num_classes=19), tensors, where)


# the network, and its published number of parameters
NETWORKS: dict[str, tuple[Callable[[], nn.Module], int]] = {
    "apgem-resnet101": (ApGemNet, 46_696_513),
    "deeplabv3plus-resnet101": (lambda: DeepLabV3Plus("resnet101", num_classes=19), 58_753_459),
    "deeplabv3plus-mobilenet": (lambda: DeepLabV3Plus("mobilenet", num_classes=19), 5_225_203),
    "megaloc": (MegaLocNet, 228_639_553),
    "openibl": (openibl_net, 149_002_048),
    "superglue": (SuperGlueNet, 12_023_297),
    "superpoint": (SuperPointNet, 1_300_865),
}
# the same of all that a file holds
STORED: dict[str, tuple[Callable[[], nn.Module], int | None]] = {
    "r2d2_WASF_N16": (R2D2Network, 485_803),
    "r2d2_WASF_N8_big": (lambda: R2D2Network(48), 1_041_019),
    "superpoint-batchnorm": (SuperPointBatchNormNet, None),
}
# its loader, a key, and whether counters of batch normalisation may lack
LOADERS: dict[str, tuple[Load, str, bool]] = {
    "aliked-t16": (aliked_from, "block3.conv1.offset_conv.bias", False),
    "apgem-resnet101": (apgem_from, "fc.bias", True),
    "deeplabv3plus-mobilenet": (deeplab_mobilenet, "classifier.aspp.convs.4.1.weight", False),
    "megaloc": (megaloc_from, "aggregator.agg.dust_bin", False),
    "openibl": (openibl, "net_vlad.conv.weight", False),
    "r2d2_WASF_N16": (load_r2d2, "ops.12.bias", False),
    "superglue": (superglue, "gnn.layers.7.mlp.1.running_mean", False),
    "superpoint": (superpoint_from, "convDb.bias", False),
    "superpoint-batchnorm": (superpoint_from, "detector.1.bn.running_var", True),
}
ALIKED = {
    "aliked-t16": (192_588, 64),
    "aliked-n16": (678_324, 128),
    "aliked-n16rot": (678_324, 128),
    "aliked-n32": (980_468, 128),
}
R2D2_WIDTHS = {"r2d2_WAF_N16": 32, "r2d2_WASF_N16": 32, "r2d2_WASF_N8_big": 48}


def zeros(name: str) -> dict[str, torch.Tensor]:
    """Of the published shapes; numbers are many, and one is seen as all of them."""
    return {key: torch.zeros(()).expand(shape) for key, shape in published_shapes(name).items()}


@pytest.mark.parametrize("name", [*NETWORKS, *STORED])
def test_keys_and_shapes_are_the_published_ones(name: str) -> None:
    make, number = (NETWORKS | STORED)[name]
    with torch.device("meta"):
        network = make()
    shapes, published = shapes_of(network), published_shapes(name)
    assert shapes == published
    counted = shapes if name in STORED else dict(network.named_parameters())
    assert number in (None, sum(math.prod(published[key]) for key in counted))


@pytest.mark.parametrize("name", LOADERS)
def test_a_file_that_lacks_a_key_is_refused(name: str) -> None:
    load, key, may_lack_counters = LOADERS[name]
    tensors = zeros(name)
    del tensors[key]
    with pytest.raises(DataError, match=rf"^w\.pth: .*1 missing keys: {re.escape(key)}$"):
        load(tensors, "w.pth")
    counted = {k: v for k, v in zeros(name).items() if not k.endswith("num_batches_tracked")}
    if may_lack_counters:
        load(counted, "w.pth")
    elif len(counted) < len(tensors):
        with pytest.raises(DataError, match="missing keys: .*num_batches_tracked"):
            load(counted, "w.pth")


@pytest.mark.parametrize("name", [*ALIKED, *R2D2_WIDTHS])
def test_the_published_files_load_strictly(shared_data: Path, name: str) -> None:
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
