"""NetVLAD, AP-GeM and EigenPlaces: keys, layers against equations, weights that do not fit."""

from __future__ import annotations

import copy
import itertools

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from published import published_shapes
from torch import nn
from torch.nn import functional as F
from transformers import ResNetConfig, ResNetModel

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.weights.authors import AVERAGE_IMAGE
from megloc_kapture.nets.global_descriptors import (
    ApGemNet,
    EigenPlacesNet,
    NetVladLayer,
    Order,
    VggNetVlad,
    Whitening,
    apgem_from,
    eigenplaces_from,
    netvlad,
    openibl,
    whitening_from,
)
from megloc_kapture.nets.trunks import Depth, ResNet

CLUSTERS, OUTPUT = 3, 10
MEAN = (123.0, 116.5, 104.25)
Tensors = dict[str, torch.Tensor]
# place in the published sequence -> torchvision's name
NAMES = {"0": "conv1", "1": "bn1", "4": "layer1", "5": "layer2", "6": "layer3", "7": "layer4"}


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
    assert {key: tuple(v.shape) for key, v in net.state_dict().items()} == published_shapes(
        "openibl"
    )
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
    for key, shape in published_shapes("openibl").items():
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


@pytest.fixture(scope="module")
def apgem_tensors() -> Tensors:
    """Weights of depth 50 whose activations stay near 1."""
    torch.manual_seed(0)
    net = ApGemNet(50)
    for part in net.modules():
        if isinstance(part, nn.Conv2d):
            nn.init.kaiming_normal_(part.weight, mode="fan_in")
        if isinstance(part, nn.BatchNorm2d):
            nn.init.uniform_(part.weight, 0.3, 0.7)
            nn.init.uniform_(part.bias, -0.3, 0.3)
    with torch.no_grad():
        net.adpool.p.fill_(2.6)
    return {key: value.detach().clone() for key, value in net.state_dict().items()}


def trunk_of_transformers(tensors: Tensors) -> ResNetModel:
    kind = {"c": "convolution", "b": "normalization"}
    renamed = {}
    for key, value in tensors.items():
        parts = key.split(".")
        if parts[0] in ("conv1", "bn1"):
            renamed[f"embedder.embedder.{kind[parts[0][0]]}.{parts[-1]}"] = value
        elif parts[0].startswith("layer"):
            place = f"encoder.stages.{int(parts[0][-1]) - 1}.layers.{parts[1]}"
            if parts[2] == "downsample":
                part = f"shortcut.{'convolution' if parts[3] == '0' else 'normalization'}"
            else:
                part = f"layer.{int(parts[2][-1]) - 1}.{kind[parts[2][0]]}"
            renamed[f"{place}.{part}.{parts[-1]}"] = value
    model = ResNetModel(ResNetConfig(depths=[3, 4, 6, 3], layer_type="bottleneck"))
    model.load_state_dict(renamed, strict=True)
    return model.eval()


def test_apgems_keys_and_shapes_are_the_published_ones() -> None:
    with torch.device("meta"):
        net = ApGemNet(101)
    found = {key: tuple(value.shape) for key, value in net.state_dict().items()}
    assert found == published_shapes("apgem-resnet101")
    assert sum(p.numel() for p in net.parameters()) == 46_696_513


@pytest.mark.parametrize("normalised", [False, True])
def test_apgem_is_its_steps_one_by_one(apgem_tensors: Tensors, normalised: bool) -> None:
    tensors = apgem_tensors
    mean, deviation = np.array([0.4, 0.5, 0.6]), np.array([0.2, 0.25, 0.3])
    net = apgem_from(
        tensors
        | {"preprocess.mean": torch.from_numpy(mean), "preprocess.std": torch.tensor(deviation)}
        | {"model_options.norm_features": torch.tensor(normalised)},
        "w.pt",
    )
    image = torch.rand(2, 3, 75, 98, generator=torch.manual_seed(1))
    seen = (image.numpy() - mean[:, None, None]) / deviation[:, None, None]
    with torch.inference_mode():
        found = net.describe(image).numpy()
        trunk = trunk_of_transformers(tensors)
        features = trunk(torch.from_numpy(seen.astype(np.float32))).last_hidden_state.numpy()
    assert features.shape == (2, 2048, 3, 4) and features.std() > 0.1
    power = float(tensors["adpool.p"])
    pooled = (np.maximum(features.astype(float), 1e-6) ** power).mean(axis=(2, 3)) ** (1 / power)
    if normalised:
        pooled /= np.linalg.norm(pooled, axis=1, keepdims=True)
    vectors = pooled @ tensors["fc.weight"].numpy().T + tensors["fc.bias"].numpy()
    expected = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    assert found.shape == (2, 2048) and found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-6)


def test_without_statistics_of_its_own_it_is_imagenets(apgem_tensors: Tensors) -> None:
    tensors = apgem_tensors
    net = apgem_from(tensors, "w.pt")
    assert net.mean.flatten().tolist() == pytest.approx([0.485, 0.456, 0.406])
    assert net.deviation.flatten().tolist() == pytest.approx([0.229, 0.224, 0.225])
    assert not net.training and not net.normalised_features


def test_checkpoints_that_do_not_fit(apgem_tensors: Tensors) -> None:
    tensors = apgem_tensors
    no_counters = {k: v for k, v in tensors.items() if not k.endswith("num_batches_tracked")}
    assert len(no_counters) < len(tensors)
    apgem_from(no_counters, "w.pt")
    with pytest.raises(DataError, match=r"^w\.pt: no AP-GeM: keys layer3.*adpool\.p expected"):
        apgem_from({k: v for k, v in tensors.items() if k != "adpool.p"}, "w.pt")
    with pytest.raises(DataError, match=r"1 missing keys: fc\.bias"):
        apgem_from({k: v for k, v in tensors.items() if k != "fc.bias"}, "w.pt")
    with pytest.raises(DataError, match=r"fc\.weight is \(512, 2048\), not \(2048, 2048\)"):
        apgem_from(tensors | {"fc.weight": torch.zeros(512, 2048)}, "w.pt")
    with pytest.raises(DataError, match=r"preprocess\.mean has 1 values"):
        apgem_from(tensors | {"preprocess.mean": torch.zeros(1)}, "w.pt")


def pca(name: str = "Landmarks_clean", *, whiten: bool = True, size: int = 2048) -> Tensors:
    generator = torch.manual_seed(3)
    return {
        f"pca.{name}.mean": 0.01 * torch.randn(size, generator=generator),
        f"pca.{name}.components": torch.randn(40, size, generator=generator),
        f"pca.{name}.explained_variance": torch.rand(40, generator=generator) + 0.1,
        f"pca.{name}.whiten": torch.tensor(whiten),
    }


@pytest.mark.parametrize(("whiten", "power"), [(True, 0.25), (True, 0.5), (False, 0.25)])
def test_whitening_is_the_authors_formula(whiten: bool, power: float) -> None:
    parts = pca(whiten=whiten)
    vectors = torch.nn.functional.normalize(torch.randn(3, 2048))
    found = whitening_from(parts, "Landmarks_clean", "w.pt", power=power)(vectors)
    mean, components, variance, _ = (value.double().numpy() for value in parts.values())
    expected = (vectors.numpy() - mean) @ components.T
    if whiten:
        expected /= variance**power
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert found.shape == (3, 40) and found.dtype == torch.float32
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


def test_power_one_half_makes_equal_variances() -> None:
    """What whitening means, before the vectors are scaled to unit length."""
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(500, 6)) * [5, 3, 2, 1, 0.5, 0.1] @ rng.normal(size=(6, 6))
    variance, directions = np.linalg.eigh(np.cov(samples.T))
    whitening = Whitening(
        *(torch.from_numpy(a) for a in (samples.mean(axis=0), directions.T, variance)), power=0.5
    )
    white = (samples - whitening.mean.double().numpy()) @ whitening.weight.double().numpy().T
    np.testing.assert_allclose(np.cov(white.T), np.eye(6), atol=1e-4)


def test_whitenings_that_are_not_there_or_not_whole() -> None:
    parts = pca() | pca("other")
    with pytest.raises(OptionError, match="no whitening 'mine' in it; there is Landmarks_clean, o"):
        whitening_from(parts, "mine", "w.pt", power=0.25)
    with pytest.raises(OptionError, match=r"w\.pt: no whitening .*there is none .an empty name"):
        whitening_from({}, "Landmarks_clean", "w.pt", power=0.25)
    del parts["pca.other.explained_variance"]
    with pytest.raises(DataError, match="the whitening other lacks explained_variance"):
        whitening_from(parts, "other", "w.pt", power=0.25)
    with pytest.raises(DataError, match=r"of shapes \(\(64,\), \(40, 64\), \(40,\)\)"):
        whitening_from(pca(size=64), "Landmarks_clean", "w.pt", power=0.25)
    zero = pca() | {"pca.Landmarks_clean.explained_variance": torch.zeros(40)}
    with pytest.raises(DataError, match="variances that are not positive"):
        whitening_from(zero, "Landmarks_clean", "w.pt", power=0.25)


@pytest.fixture(scope="module")
def eigenplaces() -> EigenPlacesNet:
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


def test_eigenplaces_keys_and_shapes_are_the_published_ones() -> None:
    with torch.device("meta"):
        network = EigenPlacesNet()
    found = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    assert found == published_shapes("eigenplaces")
    # torchvision's ResNet-50 without its classifier, the power, the linear layer
    assert sum(p.numel() for p in network.parameters()) == 23_508_032 + 1 + 2048 * 2049


def test_eigenplaces_vector_is_the_papers(eigenplaces: EigenPlacesNet) -> None:
    network = eigenplaces
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


def test_other_networks_are_refused(eigenplaces: EigenPlacesNet) -> None:
    network = eigenplaces
    with pytest.raises(DataError, match=r"w\.pth: no EigenPlaces: .*aggregation\.3\.weight"):
        eigenplaces_from({"conv1.weight": torch.zeros(1)}, "w.pth")
    tensors = dict(network.state_dict())
    tensors["backbone.0.weight"] = torch.zeros(64, 3, 3, 3)  # as VGG-16 begins
    with pytest.raises(DataError, match=r"backbone\.0\.weight is \(64, 3, 3, 3\)"):
        eigenplaces_from(tensors, "w.pth")
    del tensors["backbone.4.0.conv3.weight"]  # blocks of ResNet-18 have none
    with pytest.raises(DataError, match=r"missing keys: backbone\.4\.0\.conv3\.weight"):
        eigenplaces_from(tensors, "w.pth")
