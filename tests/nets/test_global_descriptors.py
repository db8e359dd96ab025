"""ResNet against transformers, NetVLAD and AP-GeM against their equations, and whitening."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from published import Tensors, published_shapes, randomised
from torch.nn import functional as F
from transformers import ResNetConfig, ResNetModel

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.nets.global_descriptors import (
    ApGemNet,
    NetVladLayer,
    apgem_from,
    netvlad,
    openibl,
    whitening_from,
)
from megloc_kapture.nets.trunks import ResNet, generalized_mean


def resnet_names(key: str) -> str:
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


CLUSTERS, OUTPUT = 3, 10
MEAN = (123.0, 116.5, 104.25)
AVERAGE_IMAGE = "average_image"


def by_the_paper(layer: NetVladLayer, features: NDArray[np.float64]) -> NDArray[np.float64]:
    """V(j, k) of equation 4, of features (D, h, w)."""
    weights = layer.conv.weight.detach()[:, :, 0, 0].double().numpy()
    centres = layer.centroids.detach().double().numpy()
    sums = np.zeros(centres.T.shape)
    for x in features.reshape(len(features), -1).T:
        unit = x / np.linalg.norm(x)
        scores = np.exp(weights @ unit)
        sums += (scores / scores.sum()) * (unit[:, None] - centres.T)
    sums /= np.linalg.norm(sums, axis=0)
    return sums / np.linalg.norm(sums)


@pytest.fixture(scope="module")
def weights() -> Tensors:
    """Weights of the full trunk with few clusters and a short vector."""
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
    return torch.rand(1, 3, 50, 37, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("official", [True, False], ids=["netvlad", "openibl"])
def test_netvlad_is_equation_four(weights: Tensors, image: torch.Tensor, official: bool) -> None:
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
    assert x.shape == (1, 512, 3, 2) and (x < 0).float().mean() > 0.1  # no ReLU at the end
    sums = by_the_paper(net.net_vlad, x[0].numpy())
    vector = (sums if official else sums.T).ravel()
    whitening = weights["pca_layer.weight"].double().numpy()[:, :, 0, 0]
    expected = whitening @ vector + weights["pca_layer.bias"].double().numpy()
    np.testing.assert_allclose(result[0].numpy(), expected / np.linalg.norm(expected), atol=1e-5)


def test_each_netvlad_refuses_the_weights_of_the_other(weights: Tensors) -> None:
    with pytest.raises(DataError, match=r"^w\.pth: .*weights of NetVLAD's .*plugin netvlad"):
        openibl(weights | {AVERAGE_IMAGE: torch.zeros(3)}, "w.pth")
    with pytest.raises(DataError, match=r"^w\.mat: .*lacks average_image .*plugin openibl"):
        netvlad(weights, "w.mat")


@pytest.fixture(scope="module")
def apgem_tensors() -> Tensors:
    """Weights of depth 50 whose activations stay near 1."""
    net = randomised(ApGemNet(50))
    net.adpool.p.fill_(2.6)
    return dict(net.state_dict())


def test_apgem_equals_its_steps(apgem_tensors: Tensors) -> None:
    tensors = apgem_tensors
    mean, deviation = np.array([0.4, 0.5, 0.6]), np.array([0.2, 0.25, 0.3])
    image = torch.rand(1, 3, 75, 98, generator=torch.manual_seed(1))
    seen = (image.numpy() - mean[:, None, None]) / deviation[:, None, None]
    trunk = ResNet(50).eval()  # compared with transformers' above
    trunk.load_state_dict(tensors, strict=False)
    with torch.inference_mode():
        features = trunk(torch.from_numpy(seen.astype(np.float32)))[-1].numpy()
    assert features.shape == (1, 2048, 3, 4) and features.std() > 0.1
    power = float(tensors["adpool.p"])
    pooled = (np.maximum(features.astype(float), 1e-6) ** power).mean(axis=(2, 3)) ** (1 / power)
    settings = {
        "preprocess.mean": torch.from_numpy(mean),
        "preprocess.std": torch.tensor(deviation),
    }
    for normalised in (False, True):
        settings["model_options.norm_features"] = torch.tensor(normalised)
        with torch.inference_mode():
            result = apgem_from(tensors | settings, "w.pt")(image).numpy()
        if normalised:
            pooled /= np.linalg.norm(pooled, axis=1, keepdims=True)
        vectors = pooled @ tensors["fc.weight"].numpy().T + tensors["fc.bias"].numpy()
        expected = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        assert result.shape == (1, 2048) and result.dtype == np.float32
        np.testing.assert_allclose(result, expected, atol=1e-6)


def test_apgem_uses_imagenets_statistics_by_default(apgem_tensors: Tensors) -> None:
    net = apgem_from(apgem_tensors, "w.pt")
    assert net.mean.flatten().tolist() == pytest.approx([0.485, 0.456, 0.406])
    assert net.deviation.flatten().tolist() == pytest.approx([0.229, 0.224, 0.225])
    assert not net.training and not net.normalised_features


def pca(name: str = "Landmarks_clean", *, whiten: bool = True, size: int = 2048) -> Tensors:
    generator = torch.manual_seed(3)
    return {
        f"pca.{name}.mean": 0.01 * torch.randn(size, generator=generator),
        f"pca.{name}.components": torch.randn(40, size, generator=generator),
        f"pca.{name}.explained_variance": torch.rand(40, generator=generator) + 0.1,
        f"pca.{name}.whiten": torch.tensor(whiten),
    }


@pytest.mark.parametrize("whiten", [True, False])
def test_whitening_is_the_authors_formula(whiten: bool) -> None:
    parts = pca(whiten=whiten)
    vectors = torch.nn.functional.normalize(torch.randn(3, 2048))
    whiten_linearly = whitening_from(parts, "Landmarks_clean", "w.pt")
    with torch.inference_mode():
        result = torch.nn.functional.normalize(whiten_linearly(vectors))
    mean, components, variance, _ = (value.double().numpy() for value in parts.values())
    expected = (vectors.numpy() - mean) @ components.T
    if whiten:
        expected /= variance**0.25
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert result.shape == (3, 40) and result.dtype == torch.float32
    np.testing.assert_allclose(result.numpy(), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("parts", "name", "message"),
    [
        (pca() | pca("other"), "mine", "no whitening 'mine'; it has Landmarks_clean, other"),
        ({}, "mine", "no whitening .*an empty name"),
    ],
    ids=["another name", "no whitening"],
)
def test_missing_whitenings_are_refused(parts: Tensors, name: str, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        whitening_from(parts, name, "w.pt")
