"""NetVLAD and AP-GeM: layers against equations, weights that do not fit."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from published import Tensors, published_shapes, randomised
from torch.nn import functional as F

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.nets.global_descriptors import (
    ApGemNet,
    NetVladLayer,
    apgem_from,
    netvlad,
    openibl,
    whitening_from,
)
from megloc_kapture.nets.trunks import ResNet

CLUSTERS, OUTPUT = 3, 10
MEAN = (123.0, 116.5, 104.25)
AVERAGE_IMAGE = "average_image"


def by_the_paper(layer: NetVladLayer, features: NDArray[np.float64]) -> NDArray[np.float64]:
    """V(j, k) of equation 4, each number by a separate sum, of features (D, h, w)."""
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


@pytest.fixture(scope="module")
def weights() -> Tensors:
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
def test_the_whole_network_restated(weights: Tensors, image: torch.Tensor, official: bool) -> None:
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
        result = net(image)
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
        np.testing.assert_allclose(result[row].numpy(), expected, atol=1e-5)
    np.testing.assert_allclose(result.norm(dim=1).numpy(), 1, atol=1e-6)


def test_weights_of_netvlad_that_do_not_fit(weights: Tensors) -> None:
    net = openibl(weights, "w.pth")
    assert all(torch.equal(value, weights[key]) for key, value in net.state_dict().items())
    for change, message in (
        (
            {"net_vlad.centroids": torch.zeros(4, 512)},
            r"conv\.weight is \(3, 512, 1, 1\), not \(4, 5",
        ),
        ({"pca_layer.bias": torch.tensor(1.0)}, r"pca_layer\.bias is \(\), not \(4096,\)"),
        ({AVERAGE_IMAGE: torch.zeros(3)}, "weights of NetVLAD's .*plugin netvlad"),
    ):
        with pytest.raises(DataError, match=rf"^w\.pth: .*{message}"):
            openibl(weights | change, "w.pth")
    with pytest.raises(DataError, match=r"^w\.mat: .*lacks average_image .*plugin openibl"):
        netvlad(weights, "w.mat")
    with pytest.raises(DataError, match=r"^w\.mat: average_image is \(1, 3\), not \(3,\)"):
        netvlad(weights | {AVERAGE_IMAGE: torch.zeros(1, 3)}, "w.mat")


@pytest.fixture(scope="module")
def apgem_tensors() -> Tensors:
    """Weights of depth 50 whose activations stay near 1."""
    net = randomised(ApGemNet(50))
    net.adpool.p.fill_(2.6)
    return dict(net.state_dict())


def test_apgem_is_its_steps_one_by_one(apgem_tensors: Tensors) -> None:
    tensors = apgem_tensors
    mean, deviation = np.array([0.4, 0.5, 0.6]), np.array([0.2, 0.25, 0.3])
    image = torch.rand(2, 3, 75, 98, generator=torch.manual_seed(1))
    seen = (image.numpy() - mean[:, None, None]) / deviation[:, None, None]
    trunk = ResNet(50).eval()  # compared with transformers' in test_trunks.py
    trunk.load_state_dict(tensors, strict=False)
    with torch.inference_mode():
        features = trunk(torch.from_numpy(seen.astype(np.float32)))[-1].numpy()
    assert features.shape == (2, 2048, 3, 4) and features.std() > 0.1
    power = float(tensors["adpool.p"])
    pooled = (np.maximum(features.astype(float), 1e-6) ** power).mean(axis=(2, 3)) ** (1 / power)
    settings = {
        "preprocess.mean": torch.from_numpy(mean),
        "preprocess.std": torch.tensor(deviation),
    }
    for normalised in (False, True):
        settings["model_options.norm_features"] = torch.tensor(normalised)
        with torch.inference_mode():
            result = apgem_from(tensors | settings, "w.pt").describe(image).numpy()
        if normalised:
            pooled /= np.linalg.norm(pooled, axis=1, keepdims=True)
        vectors = pooled @ tensors["fc.weight"].numpy().T + tensors["fc.bias"].numpy()
        expected = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        assert result.shape == (2, 2048) and result.dtype == np.float32
        np.testing.assert_allclose(result, expected, atol=1e-6)


def test_checkpoints_of_apgem(apgem_tensors: Tensors) -> None:
    net = apgem_from(apgem_tensors, "w.pt")
    # the default statistics are ImageNet's
    assert net.mean.flatten().tolist() == pytest.approx([0.485, 0.456, 0.406])
    assert net.deviation.flatten().tolist() == pytest.approx([0.229, 0.224, 0.225])
    assert not net.training and not net.normalised_features
    without = {key: value for key, value in apgem_tensors.items() if key != "adpool.p"}
    with pytest.raises(DataError, match=r"^w\.pt: not AP-GeM: it needs adpool\.p and layer3"):
        apgem_from(without, "w.pt")
    with pytest.raises(DataError, match=r"preprocess\.mean has 1 values"):
        apgem_from(apgem_tensors | {"preprocess.mean": torch.zeros(1)}, "w.pt")


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
    result = whitening_from(parts, "Landmarks_clean", "w.pt", power=power)(vectors)
    mean, components, variance, _ = (value.double().numpy() for value in parts.values())
    expected = (vectors.numpy() - mean) @ components.T
    if whiten:
        expected /= variance**power
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert result.shape == (3, 40) and result.dtype == torch.float32
    np.testing.assert_allclose(result.numpy(), expected, atol=1e-6)


PCA = "Landmarks_clean"


@pytest.mark.parametrize(
    ("parts", "name", "message"),
    [
        (
            pca() | pca("other"),
            "mine",
            "no whitening 'mine'; it has Landmarks_clean, other",
        ),
        ({}, PCA, "no whitening .*it has none .an empty name"),
        (pca(size=64), PCA, r"of shapes \(\(64,\), \(40, 64\), \(40,\)\)"),
        (pca() | {f"pca.{PCA}.explained_variance": torch.zeros(40)}, PCA, "are not positive"),
        ({f"pca.{PCA}.mean": torch.zeros(2048)}, PCA, "lacks components, explained_variance, wh"),
    ],
    ids=["other name", "none", "other size", "no variance", "incomplete"],
)
def test_missing_or_incomplete_whitenings(parts: Tensors, name: str, message: str) -> None:
    with pytest.raises(OptionError if "no whitening" in message else DataError, match=message):
        whitening_from(parts, name, "w.pt", power=0.25)
