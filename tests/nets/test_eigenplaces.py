"""EigenPlaces: its keys, its layers written out, and checkpoints of other sizes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from megloc_kapture.errors import DataError
from megloc_kapture.nets.global_descriptors import EigenPlacesNet, eigenplaces_from
from megloc_kapture.nets.trunks import Depth, ResNet

KEYS = Path(__file__).parent / "keys" / "eigenplaces.txt"
# place in the published sequence -> torchvision's name
NAMES = {"0": "conv1", "1": "bn1", "4": "layer1", "5": "layer2", "6": "layer3", "7": "layer4"}


def frozen_keys() -> dict[str, tuple[int, ...]]:
    pairs = (row.split() for row in KEYS.read_text().splitlines())
    return {key: () if s == "scalar" else tuple(map(int, s.split("x"))) for key, s in pairs}


@pytest.fixture(scope="module")
def network() -> EigenPlacesNet:
    """Random weights of ResNet-50, no statistics trivial."""
    torch.manual_seed(0)
    net = EigenPlacesNet(50, 12)
    with torch.no_grad():
        for part in net.modules():
            if isinstance(part, nn.BatchNorm2d):
                part.weight.uniform_(0.3, 0.7)
                part.bias.uniform_(-0.3, 0.3)
                part.running_mean.uniform_(-0.2, 0.2)
                part.running_var.uniform_(0.5, 2.0)
        net.aggregation["1"].p.fill_(2.6)
    return net.eval()


def test_keys_and_shapes_are_the_published_ones() -> None:
    with torch.device("meta"):
        network = EigenPlacesNet()
    found = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    assert found == frozen_keys()
    # torchvision's ResNet-50 without its classifier, the power, the linear layer
    assert sum(p.numel() for p in network.parameters()) == 23_508_032 + 1 + 2048 * 2049


def test_the_vector_is_the_papers(network: EigenPlacesNet) -> None:
    trunk = ResNet(50).eval()
    trunk.load_state_dict(
        {
            f"{NAMES[key.split('.')[1]]}.{key.split('.', 2)[2]}": value
            for key, value in network.state_dict().items()
            if key.startswith("backbone.")
        },
        strict=True,
    )
    image = torch.rand(2, 3, 75, 98, generator=torch.Generator().manual_seed(1))
    mean, deviation = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])
    with torch.inference_mode():
        found = network(image).numpy()
        features = trunk((image - mean[:, None, None]) / deviation[:, None, None])[-1]
    assert found.shape == (2, 12) and found.dtype == np.float32
    linear = network.aggregation["3"]
    weight, bias = (p.detach().double().numpy() for p in (linear.weight, linear.bias))
    for one, planes in zip(found, features.double().numpy(), strict=True):
        at_place = planes.reshape(2048, -1)
        at_place = at_place / np.sqrt((at_place**2).sum(0))
        pooled = (np.maximum(at_place, 1e-6) ** 2.6).mean(1) ** (1 / 2.6)
        expected = weight @ pooled + bias
        np.testing.assert_allclose(one, expected / np.linalg.norm(expected), atol=1e-5)


@pytest.mark.parametrize(("depth", "size"), [(50, 128), (101, 512)])
def test_depth_and_size_follow_from_the_file(depth: Depth, size: int) -> None:
    # numbers do not matter, and are many: one is seen as all of them
    with torch.device("meta"):
        shapes = EigenPlacesNet(depth, size).state_dict()
    tensors = {
        key: torch.zeros(()).expand(value.shape)
        for key, value in shapes.items()
        if not key.endswith("num_batches_tracked")  # torch before 0.4.1 wrote none
    }
    found = eigenplaces_from(tensors, "w.pth")
    assert not found.training
    assert {k: v.shape for k, v in found.state_dict().items()} == {
        k: v.shape for k, v in shapes.items()
    }


def test_other_networks_are_refused(network: EigenPlacesNet) -> None:
    with pytest.raises(DataError, match=r"w\.pth: no EigenPlaces: .*aggregation\.3\.weight"):
        eigenplaces_from({"conv1.weight": torch.zeros(1)}, "w.pth")
    tensors = dict(network.state_dict())
    tensors["backbone.0.weight"] = torch.zeros(64, 3, 3, 3)  # as VGG-16 begins
    with pytest.raises(DataError, match=r"backbone\.0\.weight is \(64, 3, 3, 3\)"):
        eigenplaces_from(tensors, "w.pth")
    del tensors["backbone.4.0.conv3.weight"]  # blocks of ResNet-18 have none
    with pytest.raises(DataError, match=r"missing keys: backbone\.4\.0\.conv3\.weight"):
        eigenplaces_from(tensors, "w.pth")
