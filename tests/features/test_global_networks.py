"""Global features by networks, on random weights in files of the published kinds."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from convert_weights import delg_state
from images import Image, random_image, texture
from PIL import Image as PillowImage
from published import delg_variables, plugin, small_megaloc
from pydantic import ValidationError
from safetensors.torch import save_file

from megloc_kapture.errors import DataError
from megloc_kapture.features.global_networks import (
    ApGem,
    Delg,
    GlobalNetwork,
    MegaLoc,
    NetVlad,
    OpenIbl,
    official_size,
)
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.nets import megaloc as nets_megaloc
from megloc_kapture.nets.global_descriptors import ApGemNet, VggNetVlad, whitening_from

KINDS: dict[str, Any] = {
    "netvlad": NetVlad,
    "openibl": OpenIbl,
    "apgem": ApGem,
    "delg": Delg,
    "megaloc": MegaLoc,
}
# dimensions, and least difference between vectors of two images
SIZES = {
    "netvlad": (12, 0.03),
    "openibl": (12, 0.03),
    "apgem": (2048, 1e-4),
    "delg": (2048, 1e-4),
    "megaloc": (10, 1e-3),
}
# options that keep the tests short
CHOSEN: dict[str, dict[str, object]] = {
    "openibl": {"max_size_px": 64},
    "apgem": {"whitening": ""},
    "delg": {"scales": [1.0]},
}


def write_apgem(folder: Path) -> Path:
    """A network of depth 50 with a whitening, as converted."""
    net = ApGemNet(50)
    with torch.no_grad():
        net.fc.bias.zero_()  # it would dominate random vectors
    whitening = {
        "mean": 0.001 * torch.randn(2048),
        "components": torch.randn(2048, 2048) / 45,
        "explained_variance": torch.rand(2048) + 0.01,
        "whiten": torch.tensor(True),
    }
    parts = {f"pca.Landmarks_clean.{part}": value for part, value in whitening.items()}
    torch.save(dict(net.state_dict()) | parts, folder / "mine.pth")
    return folder / "mine.pth"


def write_delg(folder: Path) -> Path:
    save_file(delg_state(delg_variables("slim")), folder / "r50delg_mine.safetensors")
    return folder / "r50delg_mine.safetensors"


def write_megaloc(folder: Path) -> Path:
    tensors = {key: 0.3 * torch.randn(v.shape) for key, v in small_megaloc().state_dict().items()}
    save_file(tensors, folder / "megaloc-small.safetensors")
    return folder / "megaloc-small.safetensors"


@pytest.fixture(scope="module", params=KINDS)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(autouse=True)
def _small_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nets_megaloc, "MegaLocNet", small_megaloc)


Make = Callable[..., GlobalNetwork[Any]]


@pytest.fixture(scope="module")
def files(
    tmp_path_factory: pytest.TempPathFactory, random_weights: dict[str, Path]
) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("networks")
    torch.manual_seed(0)
    return {
        "netvlad": random_weights["netvlad-pitts30k"],
        "openibl": random_weights["openibl"],
        "apgem": write_apgem(folder),
        "delg": write_delg(folder),
        "megaloc": write_megaloc(folder),
    }


@pytest.fixture
def make(files: dict[str, Path]) -> Make:
    def build(name: str, **options: object) -> GlobalNetwork[Any]:
        return plugin(KINDS[name], **{"weights": files[name], **CHOSEN.get(name, {}), **options})

    return build


def seen(network: GlobalNetwork[Any], *images: Image) -> torch.Tensor:
    return torch.cat([network._seen(image, torch.device("cpu")) for image in images])


def test_vectors_equal_the_network(name: str, make: Make) -> None:
    network = make(name)
    images = [texture(49, 67, seed, sigma_px=6.0) for seed in range(2)]
    many = network.describe_many(images)
    assert len(pickle.dumps(network)) < 10_000  # without the network
    size, apart = SIZES[name]
    assert many.shape == (2, size) and many.dtype == np.float32
    assert np.abs(many[0] - many[1]).max() > apart
    net, _ = network.network(network._load, *network._load_with)
    with torch.inference_mode():
        np.testing.assert_allclose(many, net(seen(network, *images)).numpy(), atol=1e-5)


def test_missing_and_unsuitable_weights_are_refused(make: Make, tmp_path: Path) -> None:
    for name, kind in KINDS.items():
        with pytest.raises(MissingWeightsError, match=name):
            kind()
    torch.save({"conv1.weight": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(DataError, match=r"other\.pth: .*not AP-GeM"):
        make("apgem", weights=str(tmp_path / "other.pth")).describe(random_image(32, 32))


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("netvlad", {}, "netvlad-pitts30k"),
        ("openibl", {}, "openibl-vgg16_netvlad"),
        ("apgem", {"whitening": "Landmarks_clean"}, "apgem-mine-Landmarks_clean-0.25"),
        ("apgem", {"whitening": "other"}, "apgem-mine-other-0.25"),
        ("apgem", {}, "apgem-mine"),
        ("delg", {}, "r50delg_mine"),
        ("megaloc", {}, "megaloc-small"),
        ("megaloc", {"size_px": 448}, "megaloc-small-448px"),
    ],
)
def test_names_identify_vectors(make: Make, name: str, options: Any, expected: str) -> None:
    assert make(name, **options).name == expected


@pytest.mark.parametrize("name", ["netvlad", "openibl", "apgem"])
def test_large_images_are_reduced_and_small_images_are_not(make: Make, name: str) -> None:
    image = random_image(64, 96)
    for most, size in ((48, (32, 48)), (96, (64, 96))):
        result = seen(make(name, max_size_px=most), image)
        assert result.shape == (1, 3, *size)
        assert result.mean().item() == pytest.approx(image.mean() / 255, rel=1e-5)


@pytest.mark.parametrize("size", [(768, 1024), (120, 90)])
def test_openibl_resizes_to_the_official_size(make: Make, size: tuple[int, int]) -> None:
    image = random_image(*size)
    result = official_size(image)
    assert result.dtype == np.uint8
    planes = torch.from_numpy(image).permute(2, 0, 1)[None].double()
    expected = torch.nn.functional.interpolate(
        planes, (480, 640), mode="bilinear", antialias=True, align_corners=False
    )[0].permute(1, 2, 0)
    assert np.abs(result - expected.numpy()).max() <= 1.01  # rounding
    shown = seen(make("openibl", max_size_px=None), image)[0].permute(1, 2, 0)
    np.testing.assert_allclose(shown.numpy() * 255, result, atol=1e-4)


def test_megaloc_resizes_to_a_square(make: Make) -> None:
    """nets/test_megaloc.py compares the resampling with PIL."""
    image = random_image(50, 200)
    for options, size in (({}, 322), ({"size_px": 140}, 140)):
        result = seen(make("megaloc", **options), image)
        assert result.shape == (1, 3, size, size)
        np.testing.assert_allclose(result.mean((0, 2, 3)) * 255, image.mean((0, 1)), atol=1.0)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("megaloc", {"size_px": 112}),  # too few patches
        ("megaloc", {"size_px": 325}),  # incomplete patches
        ("apgem", {"whitening": "a/b"}),
    ],
)
def test_invalid_options_are_refused(make: Make, name: str, options: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match=next(iter(options))):
        make(name, **options)


def test_delg_reduces_like_pillow(make: Make) -> None:
    image = random_image(75, 201)
    pillow = PillowImage.fromarray(image).resize((100, 37), PillowImage.Resampling.BILINEAR)
    result = seen(make("delg", max_size_px=100), image)[0].permute(1, 2, 0)
    np.testing.assert_array_equal(result.numpy(), np.asarray(pillow))


def test_half_precision_falls_back_at_overflow(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[bool] = []

    class Overflowing(VggNetVlad):
        def features(self, image: torch.Tensor) -> torch.Tensor:
            calls.append(torch.is_autocast_enabled("cpu"))
            return torch.full((1, 512, 1, 1), float("inf") if calls[-1] else 2.0)

        def vectors(self, features: torch.Tensor) -> torch.Tensor:
            return torch.nn.functional.normalize(features.flatten(1), dim=1)

    given = Overflowing(order="dk", mean_rgb=(0, 0, 0), output_size=1), torch.device("cpu")
    monkeypatch.setattr(GlobalNetwork, "network", lambda *_, **__: given)
    result = make("netvlad", half_precision=True).describe(random_image(32, 32))
    np.testing.assert_allclose(result, np.sqrt(1 / 512), rtol=1e-5)
    assert calls == [True, False]


def test_an_image_too_small_for_vgg_is_refused(make: Make) -> None:
    with pytest.raises(DataError, match=r"20x15 pixels, but needs at least 16"):
        make("netvlad").describe(random_image(15, 20))
    with pytest.raises(DataError, match=r"64x6 pixels"):
        make("netvlad", max_size_px=64).describe(random_image(30, 320))
    assert make("netvlad").describe(random_image(16, 17)).shape == (12,)


def test_apgem_whitens(make: Make, files: dict[str, Path]) -> None:
    image = texture(49, 67)
    plain = make("apgem").describe(image)
    result = make("apgem", whitening="Landmarks_clean").describe(image)
    parts = torch.load(files["apgem"], weights_only=True)
    whiten = whitening_from(parts, "Landmarks_clean", "w.pt")
    with torch.inference_mode():
        whitened = torch.nn.functional.normalize(whiten(torch.from_numpy(plain)[None]))[0]
    np.testing.assert_allclose(result, whitened, atol=1e-6)
