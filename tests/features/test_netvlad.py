"""NetVLAD: what the network sees of an image, out of MATLAB's file to vectors of unit length."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.io import savemat

from megloc_kapture.errors import DataError
from megloc_kapture.features import global_networks
from megloc_kapture.features.global_networks import NetVlad, NetVladOptions
from megloc_kapture.io.weights import MissingWeightsError, convert_weights
from megloc_kapture.nets.trunks import Vgg16Features
from megloc_kapture.plugin_loading import weights_of
from megloc_kapture.plugins import GlobalFeatureExtractor

Image = NDArray[np.uint8]
CLUSTERS, OUTPUT = 2, 12
MEAN = (120.0, 110.0, 100.0)


def cell(values: list[Any]) -> Any:
    found = np.empty((1, len(values)), object)
    for column, value in enumerate(values):
        found[0, column] = value
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of weights with a network of few clusters under the name of Tokyo's."""
    torch.manual_seed(0)
    trunk = Vgg16Features(last=28).requires_grad_(False)
    for value in trunk.state_dict().values():
        value.normal_(0, 1.0 if value.ndim < 2 else (2 / value[0].numel()) ** 0.5)
    # features around zero: else those of all images are alike
    planes = torch.from_numpy(np.array(noise(64, 64).transpose(2, 0, 1)))[None] - 110.0
    trunk[28].bias -= trunk(planes).mean((0, 2, 3))
    layers: list[Any] = [{"type": "relu"}] * 34
    for number, layer in enumerate(trunk):
        if isinstance(layer, torch.nn.Conv2d) and layer.bias is not None:
            weight = layer.weight.permute(2, 3, 1, 0).numpy()
            layers[number] = {"type": "conv", "weights": cell([weight, layer.bias[None].numpy()])}
    rng = np.random.default_rng(0)

    def floats(*shape: int, scale: float = 1.0) -> Any:
        return rng.standard_normal(shape, dtype=np.float32) * np.float32(scale)

    core = [floats(512, CLUSTERS, scale=20), floats(512, CLUSTERS, scale=0.02)]
    layers[30] = {"type": "custom", "weights": cell(core)}
    whitening = [floats(1, 1, 512 * CLUSTERS, OUTPUT), floats(1, OUTPUT, scale=0.1)]
    layers[33] = {"type": "conv", "weights": cell(whitening)}
    mean = np.tile(np.array(MEAN, np.float32), (2, 2, 1))
    net = {"layers": cell(layers), "meta": {"normalization": {"averageImage": mean}}}
    place = tmp_path_factory.mktemp("weights")
    savemat(place / "TokyoTM_struct.mat", {"net": net})
    return place


@pytest.fixture(autouse=True)
def weights(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(folder))


def extractor(**options: object) -> NetVlad:
    given = {"device": "cpu", "weights": "netvlad-tokyotm", **options}
    return NetVlad(NetVladOptions.model_validate(given))


def noise(height: int, width: int, seed: int = 0) -> Image:
    small = np.random.default_rng(seed).integers(0, 256, (-(-height // 8), -(-width // 8), 3))
    return np.kron(small, np.ones((8, 8, 1))).astype(np.uint8)[:height, :width]


class Watched:
    """A network that keeps what it is shown."""

    def __init__(self) -> None:
        self.seen: list[torch.Tensor] = []

    def features(self, image: torch.Tensor) -> torch.Tensor:
        self.seen.append(image)
        return torch.ones(len(image), 512, 1, 1)

    def vectors(self, features: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.normalize(features.flatten(1), dim=1)


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Watched:
    network = Watched()
    given = network, torch.device("cpu")
    monkeypatch.setattr(global_networks.GlobalNetwork, "network", lambda *_, **__: given)
    return network


def test_a_large_image_is_shrunk_to_means_and_a_small_one_stays(watched: Watched) -> None:
    image = np.random.default_rng(1).integers(0, 256, (64, 96, 3)).astype(np.uint8)
    for size, expected in (
        (48, image.astype(np.float64).reshape(32, 2, 48, 2, 3).mean((1, 3))),
        (96, image.astype(np.float64)),
        (200, image.astype(np.float64)),
    ):
        extractor(max_size_px=size).describe(image)
        seen = watched.seen.pop()
        assert seen.dtype == torch.float32
        # not rounded to whole numbers
        np.testing.assert_allclose(255 * seen[0].permute(1, 2, 0).numpy(), expected, atol=1e-4)


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        *(((1500, 999), (1024, 682)), ((600, 1600), (384, 1024)), ((1024, 768), (1024, 768))),
        ((1023, 30), (1023, 30)),
    ],
)
def test_sizes_at_the_default(
    watched: Watched, size: tuple[int, int], expected: tuple[int, int]
) -> None:
    extractor().describe(np.zeros((*size, 3), np.uint8))
    assert watched.seen[0].shape == (1, 3, *expected)


def test_vectors_are_those_of_the_network_run_by_hand() -> None:
    image = noise(50, 70)
    plugin = extractor()
    found = plugin.describe(image)
    assert found.dtype == np.float32 and found.shape == (OUTPUT,)
    np.testing.assert_allclose(np.linalg.norm(found), 1, atol=1e-6)
    net, _ = plugin.network(global_networks.netvlad)
    planes = torch.from_numpy(image.astype(np.float32).transpose(2, 0, 1))[None]
    with torch.inference_mode():
        features = net.base_model["base"](planes - torch.tensor(MEAN)[:, None, None])
        expected = net.vectors(features)[0].numpy()
    np.testing.assert_allclose(found, expected, atol=1e-5)
    # another image has another vector, the same one the same bytes
    assert np.abs(found - plugin.describe(noise(50, 70, seed=1))).max() > 0.03
    assert np.array_equal(found, plugin.describe(image))


def test_several_at_once() -> None:
    images = [noise(48, 66, seed) for seed in range(3)]
    plugin = extractor(max_size_px=60)
    found = plugin.describe_many(images)
    assert found.shape == (3, OUTPUT) and found.dtype == np.float32
    for row, image in zip(found, images, strict=True):
        np.testing.assert_allclose(row, plugin.describe(image), atol=1e-5)


def test_half_precision_is_near() -> None:
    image = noise(64, 64)
    whole, half = extractor(), extractor(half_precision=True)
    a, b = whole.describe(image), half.describe(image)
    assert b.dtype == np.float32 and not np.array_equal(a, b)
    assert 0.99 < a @ b < 1
    np.testing.assert_allclose(np.linalg.norm(b), 1, atol=1e-6)


def test_what_half_precision_cannot_hold_is_made_in_full(watched: Watched) -> None:
    def features(image: torch.Tensor) -> torch.Tensor:
        is_half = torch.is_autocast_enabled("cpu")
        watched.seen.append(image)
        return torch.full((1, 512, 1, 1), float("inf") if is_half else 2.0)

    watched.features = features  # type: ignore[method-assign]
    found = extractor(half_precision=True).describe(noise(32, 32))
    np.testing.assert_allclose(found, np.sqrt(1 / 512), rtol=1e-5)
    assert len(watched.seen) == 2


def test_an_image_that_is_too_small_is_refused() -> None:
    with pytest.raises(DataError, match=r"image of 20x15 pixels .* needs 16 a side"):
        extractor().describe(np.zeros((15, 20, 3), np.uint8))
    with pytest.raises(DataError, match=r"image of 64x6 pixels"):
        extractor(max_size_px=64).describe(np.zeros((30, 320, 3), np.uint8))
    assert extractor().describe(noise(16, 17)).shape == (OUTPUT,)
    with pytest.raises(ValidationError, match="max_size_px"):
        extractor(max_size_px=15)


def test_it_is_a_plugin_that_names_its_model_and_its_weights(folder: Path) -> None:
    plugin = extractor()
    assert isinstance(plugin, GlobalFeatureExtractor) and plugin.name == "netvlad-tokyotm"
    assert list(weights_of(plugin)) == ["TokyoTM_struct.mat"]
    own = extractor(weights=str(folder / "TokyoTM_struct.mat"))
    assert own.name == "netvlad-TokyoTM_struct" and weights_of(own) == weights_of(plugin)
    again = pickle.loads(pickle.dumps(plugin))
    assert np.array_equal(again.describe(noise(32, 32)), plugin.describe(noise(32, 32)))
    with pytest.raises(MissingWeightsError, match=r"netvlad-pitts30k are missing.*Pitts30K_struct"):
        NetVlad()


def test_converted_weights_give_the_same_vectors(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = extractor().describe(noise(32, 48))
    convert_weights(folder / "TokyoTM_struct.mat", tmp_path / "netvlad-tokyotm.safetensors")
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(tmp_path))
    plugin = extractor()
    assert list(weights_of(plugin)) == ["netvlad-tokyotm.safetensors"]
    assert plugin.name == "netvlad-tokyotm"
    assert np.array_equal(plugin.describe(noise(32, 48)), expected)
