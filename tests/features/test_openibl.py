"""OpenIBL: the size it was trained at, the other rule, and vectors of unit length."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.features import global_networks
from megloc_kapture.features.global_networks import OpenIbl, OpenIblOptions, official_size
from megloc_kapture.nets.global_descriptors import VggNetVlad
from megloc_kapture.plugin_loading import weights_of
from megloc_kapture.plugins import GlobalFeatureExtractor

Image = NDArray[np.uint8]
OUTPUT = 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of weights with a network of few clusters under the published name."""
    torch.manual_seed(0)
    net = VggNetVlad(order="kd", mean_rgb=(0.0, 0.0, 0.0), num_clusters=2, output_size=OUTPUT)
    for name, value in net.state_dict().items():
        value.normal_(0, 1.0 if value.ndim < 2 else (2 / value[0].numel()) ** 0.5)
        value *= {"net_vlad.conv.weight": 300, "net_vlad.centroids": 0.3}.get(name, 1)
        value *= 0.01 if name == "pca_layer.bias" else 1
    # features around zero: else those of all images are alike
    planes = torch.from_numpy(np.array(noise(64, 64).transpose(2, 0, 1)))[None] / 255 - 0.45
    with torch.no_grad():
        net.get_parameter("base_model.base.28.bias").sub_(net.features(planes).mean((0, 2, 3)))
    place = tmp_path_factory.mktemp("weights")
    torch.save(net.state_dict(), place / "vgg16_netvlad.pth")
    return place


@pytest.fixture(autouse=True)
def weights(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(folder))


def extractor(**options: object) -> OpenIbl:
    return OpenIbl(OpenIblOptions.model_validate({"device": "cpu", **options}))


def noise(height: int, width: int, seed: int = 0) -> Image:
    small = np.random.default_rng(seed).integers(0, 256, (-(-height // 8), -(-width // 8), 3))
    return np.kron(small, np.ones((8, 8, 1))).astype(np.uint8)[:height, :width]


@pytest.mark.parametrize("size", [(480, 640), (640, 480), (768, 1024), (120, 90), (7, 2000)])
def test_every_image_gets_the_official_size(size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 256, (*size, 3)).astype(np.uint8)
    found = official_size(image)
    assert found.shape == (480, 640, 3) and found.dtype == np.uint8
    # torch's own resampling of the same kind, up to rounding
    planes = torch.from_numpy(image).permute(2, 0, 1)[None].double()
    expected = torch.nn.functional.interpolate(
        planes, (480, 640), mode="bilinear", antialias=True, align_corners=False
    )[0].permute(1, 2, 0)
    assert np.abs(found - expected.numpy()).max() <= 1.01


def test_half_the_size_by_hand() -> None:
    """A triangle over four pixels each way: an eighth, three eighths, three, one."""
    image = noise(960, 1280)
    weights = np.array([1, 3, 3, 1]) / 8
    for row, column in ((100, 200), (37, 501), (400, 600)):
        window = image[2 * row - 1 : 2 * row + 3, 2 * column - 1 : 2 * column + 3]
        expected = np.einsum("i,j,ijc->c", weights, weights, window.astype(float))
        np.testing.assert_allclose(official_size(image)[row, column], expected, atol=1.01)


class Watched:
    """A network that keeps what it is shown."""

    def __init__(self) -> None:
        self.seen: list[torch.Tensor] = []

    def features(self, image: torch.Tensor) -> torch.Tensor:
        self.seen.append(image)
        return torch.ones(len(image), 512, 1, 1)

    def vectors(self, features: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.normalize(features.flatten(1), dim=1)


def test_the_network_sees_the_size_of_the_option(monkeypatch: pytest.MonkeyPatch) -> None:
    network = Watched()
    given = network, torch.device("cpu")
    monkeypatch.setattr(global_networks.GlobalNetwork, "network", lambda *_, **__: given)
    image = noise(600, 1600)
    extractor().describe(image)
    extractor(max_size_px=1024).describe(image)
    extractor(max_size_px=2000).describe(image)
    shapes = [tuple(seen.shape) for seen in network.seen]
    assert shapes == [(1, 3, 480, 640), (1, 3, 384, 1024), (1, 3, 600, 1600)]
    official = official_size(image).transpose(2, 0, 1)
    np.testing.assert_allclose(network.seen[0][0].numpy(), official / 255, atol=1e-6)
    np.testing.assert_allclose(network.seen[2][0].numpy(), image.transpose(2, 0, 1) / 255, 1e-5)


def test_vectors_are_those_of_the_network_run_by_hand() -> None:
    image = noise(50, 70)
    plugin = extractor(max_size_px=64)
    found = plugin.describe(image)
    assert found.dtype == np.float32 and found.shape == (OUTPUT,)
    np.testing.assert_allclose(np.linalg.norm(found), 1, atol=1e-6)
    assert np.abs(found - plugin.describe(noise(50, 70, seed=1))).max() > 0.03
    many = plugin.describe_many([image, noise(50, 70, seed=1)])
    assert many.shape == (2, OUTPUT)
    np.testing.assert_allclose(many[0], found, atol=1e-5)
    # the colours that its authors subtract, and their scale of 1 / 255
    net, _ = plugin.network(global_networks.openibl)
    planes = torch.from_numpy(np.array(noise(48, 64).transpose(2, 0, 1)))[None] / 255
    mean = torch.tensor([0.48501960784313836, 0.4579568627450961, 0.4076039215686255])
    with torch.inference_mode():
        features = net.base_model["base"]((planes - mean[:, None, None]) / 0.00392156862745098)
        expected = net.vectors(features)[0].numpy()
    np.testing.assert_allclose(plugin.describe(noise(48, 64)), expected, atol=1e-5)


def test_half_precision_is_near() -> None:
    image = noise(64, 64)
    a = extractor(max_size_px=64).describe(image)
    b = extractor(max_size_px=64, half_precision=True).describe(image)
    assert not np.array_equal(a, b) and 0.99 < a @ b < 1


def test_it_is_a_plugin_that_names_its_model_and_its_weights(folder: Path, tmp_path: Path) -> None:
    plugin = extractor()
    assert isinstance(plugin, GlobalFeatureExtractor) and plugin.name == "openibl"
    assert list(weights_of(plugin)) == ["vgg16_netvlad.pth"]
    assert extractor(weights=str(folder / "vgg16_netvlad.pth")).name == "openibl-vgg16_netvlad"
    again = pickle.loads(pickle.dumps(plugin))
    assert again.name == plugin.name and again.options == plugin.options
    torch.save({"a": torch.ones(1)}, tmp_path / "other.pth")
    with pytest.raises(DataError, match=r"other\.pth: this file does not fit VggNetVlad"):
        extractor(weights=str(tmp_path / "other.pth")).describe(noise(32, 32))
