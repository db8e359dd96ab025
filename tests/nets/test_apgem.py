"""AP-GeM: keys, the head against its definition, whitening, and checkpoints that do not fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from transformers import ResNetConfig, ResNetModel

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.nets.global_descriptors import ApGemNet, Whitening, apgem_from, whitening_from

KEYS = Path(__file__).parent / "keys"
Tensors = dict[str, torch.Tensor]


def frozen_keys() -> dict[str, tuple[int, ...]]:
    """Key -> shape, as the published checkpoints have them."""
    rows = (row.split() for row in (KEYS / "apgem-resnet101.txt").read_text().splitlines())
    return {key: () if s == "scalar" else tuple(map(int, s.split("x"))) for key, s in rows}


@pytest.fixture(scope="module")
def tensors() -> Tensors:
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


def test_keys_and_shapes_are_the_published_ones() -> None:
    with torch.device("meta"):
        net = ApGemNet(101)
    assert {key: tuple(value.shape) for key, value in net.state_dict().items()} == frozen_keys()
    assert sum(p.numel() for p in net.parameters()) == 46_696_513


@pytest.mark.parametrize("normalised", [False, True])
def test_vectors_are_those_of_the_steps_one_by_one(tensors: Tensors, normalised: bool) -> None:
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


def test_without_statistics_of_its_own_it_is_imagenets(tensors: Tensors) -> None:
    net = apgem_from(tensors, "w.pt")
    assert net.mean.flatten().tolist() == pytest.approx([0.485, 0.456, 0.406])
    assert net.deviation.flatten().tolist() == pytest.approx([0.229, 0.224, 0.225])
    assert not net.training and not net.normalised_features


def test_checkpoints_that_do_not_fit(tensors: Tensors) -> None:
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
