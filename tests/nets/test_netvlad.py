"""NetVLAD's layer against the paper's equation, the networks' keys, and weights that do not fit."""

from __future__ import annotations

import copy
import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.nn import functional as F

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights.netvlad import AVERAGE_IMAGE
from megloc_kapture.nets.global_descriptors import NetVladLayer, Order, VggNetVlad, netvlad, openibl

KEYS = Path(__file__).parent / "keys" / "openibl.txt"
CLUSTERS, OUTPUT = 3, 10
MEAN = (123.0, 116.5, 104.25)


def published_shapes() -> dict[str, tuple[int, ...]]:
    pairs = (row.split() for row in KEYS.read_text(encoding="utf-8").splitlines())
    return {key: tuple(map(int, shape.split("x"))) for key, shape in pairs}


def random_layer(order: Order, seed: int = 0, *, clusters: int = 4, size: int = 5) -> NetVladLayer:
    torch.manual_seed(seed)
    layer = NetVladLayer(clusters, size, order=order)
    # sharp enough that the clusters differ
    torch.nn.init.normal_(layer.conv.weight, std=4)
    torch.nn.init.normal_(layer.centroids)
    return layer.requires_grad_(False)


def by_the_paper(layer: NetVladLayer, features: NDArray[np.float64]) -> NDArray[np.float64]:
    """V(j, k) of equation 4, each number a sum of its own, of features (D, h, w)."""
    weights = layer.conv.weight.detach()[:, :, 0, 0].double().numpy()
    centres = layer.centroids.detach().double().numpy()
    unit = [x / np.sqrt((x**2).sum()) for x in features.reshape(len(features), -1).T]
    sums = np.zeros(centres.T.shape)
    for j, k in itertools.product(range(len(features)), range(len(centres))):
        for x in unit:
            scores = [np.exp(w @ x) for w in weights]
            sums[j, k] += scores[k] / sum(scores) * (x[j] - centres[k, j])
    for k in range(len(centres)):
        sums[:, k] /= np.sqrt((sums[:, k] ** 2).sum())
    return sums / np.sqrt((sums**2).sum())


@pytest.mark.parametrize("seed", range(3))
def test_the_layer_is_the_papers_equation(seed: int) -> None:
    features = torch.randn(2, 5, 3, 4, generator=torch.Generator().manual_seed(seed)) * 30
    dk, kd = random_layer("dk", seed), random_layer("kd", seed)
    for row in range(2):
        expected = by_the_paper(dk, features[row].double().numpy())
        for layer, vector in ((dk, expected.ravel()), (kd, expected.T.ravel())):
            np.testing.assert_allclose(layer(features)[row].numpy(), vector, atol=2e-6)


def test_the_two_orders_hold_the_same_numbers() -> None:
    features = torch.randn(1, 5, 6, 2, generator=torch.Generator().manual_seed(4))
    dk = random_layer("dk")(features)[0]
    kd = random_layer("kd")(features)[0]
    assert (dk - kd).abs().max() > 0.1
    torch.testing.assert_close(dk, kd.reshape(4, 5).T.reshape(-1), rtol=0, atol=1e-7)


def test_one_feature_and_two_clusters_in_closed_form() -> None:
    layer = random_layer("dk", clusters=2, size=2)
    layer.conv.weight.copy_(torch.tensor([[[[np.log(3.0)]], [[0.0]]], [[[0.0]], [[0.0]]]]))
    layer.centroids.copy_(torch.tensor([[0.0, -1.0], [1.0, 2.0]]))
    # (1, 0) belongs to the first by 3 / 4, to the second by 1 / 4, which no unit length shows:
    # the differences are (1, 1) and (0, -2)
    found = layer(torch.tensor([[[[7.0]], [[0.0]]]]))[0]
    half = np.sqrt(0.5)
    np.testing.assert_allclose(found.numpy(), np.array([half, 0, half, -1]) / np.sqrt(2), atol=1e-6)


def test_places_of_features_do_not_matter_and_doubling_them_neither() -> None:
    features = torch.randn(1, 5, 4, 6, generator=torch.Generator().manual_seed(5))
    layer = random_layer("kd")
    expected = layer(features)
    order = torch.randperm(24, generator=torch.Generator().manual_seed(6))
    shuffled = features.flatten(2)[:, :, order].reshape(1, 5, 8, 3)
    torch.testing.assert_close(layer(shuffled), expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(layer(torch.cat([features, 2 * features], 3)), expected)


def test_keys_shapes_and_number_of_parameters_are_the_published_ones() -> None:
    with torch.device("meta"):
        net = VggNetVlad(order="kd", mean_rgb=MEAN)
    assert {key: tuple(v.shape) for key, v in net.state_dict().items()} == published_shapes()
    assert sum(parameter.numel() for parameter in net.parameters()) == 149_002_048
    image = torch.empty(2, 3, 480, 640, device="meta")
    assert net.features(image).shape == (2, 512, 30, 40)
    assert net(image).shape == (2, 4096)


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    """Of a network with few clusters and a short vector; the trunk is the whole one."""
    generator = torch.Generator().manual_seed(0)
    small = {64: CLUSTERS, 32768: CLUSTERS * 512, 4096: OUTPUT}
    tensors = {}
    for key, shape in published_shapes().items():
        if not key.startswith("base_model"):
            shape = tuple(small.get(length, length) for length in shape)
        fan_in = int(np.prod(shape[1:])) if len(shape) > 1 else 1
        tensors[key] = torch.randn(shape, generator=generator) * (2 / fan_in) ** 0.5
    tensors["net_vlad.conv.weight"] *= 40  # clusters that differ
    return tensors


@pytest.fixture(scope="module")
def image() -> torch.Tensor:
    return torch.rand(2, 3, 50, 37, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("official", [True, False], ids=["netvlad", "openibl"])
def test_the_whole_network_restated(
    weights: dict[str, torch.Tensor], image: torch.Tensor, official: bool
) -> None:
    if official:
        net = netvlad(weights | {AVERAGE_IMAGE: torch.tensor(MEAN)}, "w.mat")
        assert net.mean_rgb == MEAN and net.net_vlad.order == "dk"
        mean = torch.tensor(MEAN).double()
    else:
        net = openibl(weights, "w.pth")
        assert net.net_vlad.order == "kd"
        # as its authors write it: colours in [0, 1] less these, by 1 / 255
        mean = 255 * torch.tensor((0.48501960784313836, 0.4579568627450961, 0.4076039215686255))
    assert not net.training
    with torch.inference_mode():
        found = net(image)
    x = image.double() * 255 - mean.double()[:, None, None]
    for number in range(29):
        if f"base_model.base.{number}.weight" in weights:
            weight = weights[f"base_model.base.{number}.weight"].double()
            x = F.conv2d(x, weight, weights[f"base_model.base.{number}.bias"].double(), padding=1)
        elif number in (4, 9, 16, 23):
            x = F.max_pool2d(x, 2)
        else:
            x = x.relu()
    assert x.shape == (2, 512, 3, 2) and (x < 0).float().mean() > 0.1  # no ReLU at the end
    for row in range(2):
        sums = by_the_paper(net.net_vlad, x[row].numpy())
        vector = (sums if official else sums.T).ravel()
        whitening = weights["pca_layer.weight"].double().numpy()[:, :, 0, 0]
        expected = whitening @ vector + weights["pca_layer.bias"].double().numpy()
        expected /= np.linalg.norm(expected)
        np.testing.assert_allclose(found[row].numpy(), expected, atol=1e-5)
    np.testing.assert_allclose(found.norm(dim=1).numpy(), 1, atol=1e-6)


def test_weights_go_in_whole_or_not_at_all(weights: dict[str, torch.Tensor]) -> None:
    net = openibl(weights, "w.pth")
    for key, value in net.state_dict().items():
        assert torch.equal(value, weights[key]), key
    less = copy.copy(weights)
    lost = less.pop("net_vlad.centroids")
    with pytest.raises(DataError, match=r"^w\.pth: .*missing keys: net_vlad\.centroids"):
        openibl(less, "w.pth")
    with pytest.raises(DataError, match=r"unexpected keys: net_vlad\.centres"):
        openibl(weights | {"net_vlad.centres": lost}, "w.pth")
    with pytest.raises(DataError, match=r"net_vlad\.conv\.weight is \(3, 512, 1, 1\), not \(4, 5"):
        openibl(weights | {"net_vlad.centroids": torch.zeros(4, 512)}, "w.pth")
    with pytest.raises(DataError, match=r"pca_layer\.bias is \(\), not \(4096,\)"):
        openibl(weights | {"pca_layer.bias": torch.tensor(1.0)}, "w.pth")
    with pytest.raises(DataError, match=r"^w\.mat: average_image is \(1, 3\), not \(3,\)"):
        netvlad(weights | {AVERAGE_IMAGE: torch.zeros(1, 3)}, "w.mat")


def test_one_plugins_weights_are_not_the_others(weights: dict[str, torch.Tensor]) -> None:
    with pytest.raises(DataError, match=r"^w\.pth: .*no average_image .*plugin openibl"):
        netvlad(weights, "w.pth")
    with pytest.raises(DataError, match=r"^w\.mat: weights of NetVLAD's .*plugin netvlad"):
        openibl(weights | {AVERAGE_IMAGE: torch.zeros(3)}, "w.mat")
