"""AP-GeM as a plugin: names, the steps around the network, batches, checkpoints."""

from __future__ import annotations

import hashlib
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pydantic import ValidationError

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.features.global_networks import ApGem, ApGemOptions
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.nets.global_descriptors import ApGemNet
from megloc_kapture.plugins import GlobalFeatureExtractor

Image = NDArray[np.uint8]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights of depth 50, with a whitening, as a converted checkpoint has them."""
    torch.manual_seed(0)
    net = ApGemNet(50)
    with torch.no_grad():
        net.fc.bias.zero_()  # which would be most of a vector of random weights
    extra = {
        "pca.Landmarks_clean.mean": 0.001 * torch.randn(2048),
        "pca.Landmarks_clean.components": torch.randn(2048, 2048) / 45,
        "pca.Landmarks_clean.explained_variance": torch.rand(2048) + 0.01,
        "pca.Landmarks_clean.whiten": torch.tensor(True),
    }
    path = tmp_path_factory.mktemp("weights") / "mine.pth"
    torch.save(dict(net.state_dict()) | extra, path)
    return path


@pytest.fixture(scope="module")
def photographs() -> list[Image]:
    noise = np.random.default_rng(0).integers(0, 256, (2, 9, 12, 3), dtype=np.uint8)
    return [cv2.resize(n, (80, 60), interpolation=cv2.INTER_CUBIC) for n in noise]


def extractor(weights: Path, **options: object) -> ApGem:
    return ApGem(ApGemOptions.model_validate({"weights": str(weights), "device": "cpu", **options}))


def test_names_tell_the_model_and_the_whitening(weights: Path) -> None:
    assert isinstance(extractor(weights), GlobalFeatureExtractor)
    assert extractor(weights).name == "apgem-mine-Landmarks_clean-0.25"
    assert extractor(weights, whitening_power=0.5).name == "apgem-mine-Landmarks_clean-0.5"
    assert extractor(weights, whitening="").name == "apgem-mine"
    with pytest.raises(ValidationError, match="whitening"):
        extractor(weights, whitening="a/b")


def test_missing_weights_say_where_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(tmp_path))
    with pytest.raises(MissingWeightsError, match=r"no Resnet101-AP-GeM-LM18\.pt .*megloc weights"):
        ApGem()
    (tmp_path / "Resnet101-AP-GeM-LM18.pt").touch()
    assert ApGem().name == "apgem-resnet101-lm18-Landmarks_clean-0.25"


def test_vectors_are_the_networks_of_the_resized_image(
    weights: Path, photographs: list[Image]
) -> None:
    found = extractor(weights, whitening="", max_size_px=40).describe(photographs[0])
    assert found.shape == (2048,) and found.dtype == np.float32
    net = ApGemNet(50).eval()
    net.load_state_dict(torch.load(weights, weights_only=True), strict=False)
    halved = photographs[0].reshape(30, 2, 40, 2, 3).astype(np.float32).mean(axis=(1, 3))
    with torch.inference_mode():
        expected = net.describe(torch.from_numpy(halved.transpose(2, 0, 1))[None] / 255)[0]
        whole = net.describe(torch.from_numpy(photographs[0].transpose(2, 0, 1))[None] / 255)[0]
    np.testing.assert_allclose(found, expected.numpy(), atol=1e-5)
    assert np.abs(found - whole.numpy()).max() > 1e-3
    of_all = extractor(weights, whitening="", max_size_px=None).describe(photographs[0])
    np.testing.assert_allclose(of_all, whole.numpy(), atol=1e-6)


def test_whitened(weights: Path, photographs: list[Image]) -> None:
    plain = extractor(weights, whitening="").describe(photographs[0])
    found = extractor(weights).describe(photographs[0])
    parts = torch.load(weights, weights_only=True)
    mean, components, variance = (
        parts[f"pca.Landmarks_clean.{part}"].double().numpy()
        for part in ("mean", "components", "explained_variance")
    )
    expected = components @ (plain - mean) / variance**0.25
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected), atol=1e-6)
    assert np.linalg.norm(found) == pytest.approx(1, abs=1e-6)
    with pytest.raises(OptionError, match=r"no whitening 'other' in it; there is Landmarks_clean"):
        extractor(weights, whitening="other").describe(photographs[0])


def test_batches_are_the_images_one_by_one(weights: Path, photographs: list[Image]) -> None:
    net = extractor(weights, whitening="")
    together = net.describe_many(photographs)
    apart = np.stack([net.describe(image) for image in photographs])
    assert together.shape == (2, 2048)
    np.testing.assert_allclose(together, apart, atol=1e-5)
    assert np.abs(apart[0] - apart[1]).max() > 1e-3
    assert np.array_equal(net.describe_many(photographs), together)


def test_half_precision_is_near(weights: Path, photographs: list[Image]) -> None:
    vectors = [
        extractor(weights, whitening="", half_precision=half).describe(photographs[0])
        for half in (False, True)
    ]
    assert vectors[1].dtype == np.float32 and not np.array_equal(*vectors)
    assert vectors[0] @ vectors[1] > 0.99
    assert np.linalg.norm(vectors[1]) == pytest.approx(1, abs=1e-6)


def test_it_travels_light_and_names_its_weights(weights: Path, photographs: list[Image]) -> None:
    plugin = extractor(weights)
    expected = plugin.describe(photographs[0])
    packed = pickle.dumps(plugin)
    assert len(packed) < 10_000
    assert np.array_equal(pickle.loads(packed).describe(photographs[0]), expected)
    assert plugin.weights() == {"mine.pth": hashlib.sha256(weights.read_bytes()).hexdigest()}


def test_a_checkpoint_of_something_else_is_refused(
    tmp_path: Path, photographs: list[Image]
) -> None:
    torch.save({"conv1a.weight": torch.zeros(64, 1, 3, 3)}, tmp_path / "other.pth")
    with pytest.raises(DataError, match=r"other\.pth: no AP-GeM"):
        extractor(tmp_path / "other.pth").describe(photographs[0])
