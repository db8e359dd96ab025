"""Global features by networks, on random weights in files of the published kinds."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from convert_weights import delg_state
from images import Image, random_image, texture
from numpy.typing import NDArray
from PIL import Image as PillowImage
from published import delg_variables
from pydantic import ValidationError
from safetensors.torch import save_file

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.features import global_networks
from megloc_kapture.features.global_networks import (
    ApGem,
    Delg,
    GlobalNetwork,
    MegaLoc,
    MegaLocOptions,
    NetVlad,
    OpenIbl,
    _with_longer_side,
    official_size,
)
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.nets import delg as nets_delg
from megloc_kapture.nets import megaloc as nets_megaloc
from megloc_kapture.nets.global_descriptors import ApGemNet, VggNetVlad
from megloc_kapture.nets.megaloc import DinoV2, MegaLocNet
from megloc_kapture.plugins import GlobalFeatureExtractor

DELG_REFERENCE = Path(__file__).parents[1] / "nets" / "data" / "delg" / "reference.npz"
CLUSTERS = 2
KINDS: dict[str, Any] = {
    "netvlad": NetVlad,
    "openibl": OpenIbl,
    "apgem": ApGem,
    "delg": Delg,
    "megaloc": MegaLoc,
}
# components, and by how much vectors of two images differ at least
SIZES = {
    "netvlad": (12, 0.03),
    "openibl": (12, 0.03),
    "apgem": (2048, 1e-4),
    "delg": (2048, 1e-4),
    "megaloc": (10, 1e-3),
}
# that keep the tests short
CHOSEN: dict[str, dict[str, object]] = {
    "openibl": {"max_size_px": 64},
    "apgem": {"whitening": ""},
    "delg": {"scales": [1.0]},
}
REFUSALS = {
    "netvlad": "lacks average_image",
    "openibl": "this file does not fit VggNetVlad",
    "apgem": "not AP-GeM",
    "delg": r"not DELG: 0 blocks .*found: conv1\.weight$",
    "megaloc": r".*unexpected keys: conv1\.weight",
}


def around_zero(features: Callable[[torch.Tensor], torch.Tensor], bias: torch.Tensor) -> None:
    """Features that are not lose the difference between images."""
    planes = torch.from_numpy(texture(64, 64).transpose(2, 0, 1).copy())[None].float()
    with torch.no_grad():
        bias -= features(planes).mean((0, 2, 3))


def write_netvlad(folder: Path) -> Path:
    """A network of few clusters, as the script converts Tokyo's."""
    path = write_openibl(folder)
    state = torch.load(path, weights_only=True)
    state["average_image"] = torch.tensor([120.0, 110.0, 100.0])
    save_file(state, folder / "netvlad-tokyotm.safetensors")
    return folder / "netvlad-tokyotm.safetensors"


def write_openibl(folder: Path) -> Path:
    net = VggNetVlad(order="kd", mean_rgb=(0.0, 0.0, 0.0), num_clusters=CLUSTERS, output_size=12)
    for name, value in net.state_dict().items():
        value.normal_(0, 1.0 if value.ndim < 2 else (2 / value[0].numel()) ** 0.5)
        value *= {"net_vlad.conv.weight": 300, "net_vlad.centroids": 0.3}.get(name, 1)
        value *= 0.01 if name == "pca_layer.bias" else 1
    bias = net.get_parameter("base_model.base.28.bias").detach()
    around_zero(lambda planes: net.features(planes / 255 - 0.45), bias)
    torch.save(net.state_dict(), folder / "vgg16_netvlad.pth")
    return folder / "vgg16_netvlad.pth"


def write_apgem(folder: Path) -> Path:
    """Of depth 50, with a whitening, as a converted checkpoint has it."""
    net = ApGemNet(50)
    with torch.no_grad():
        net.fc.bias.zero_()  # which would be most of a vector of random weights
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


def small_megaloc() -> MegaLocNet:
    trunk = DinoV2(channels=12, depth=2, heads=3, grid=7)
    sizes = {"clusters": 5, "cluster_size": 4, "token_size": 6, "descriptor_size": 10}
    return MegaLocNet(trunk, **sizes)


def write_megaloc(folder: Path) -> Path:
    tensors = {key: 0.3 * torch.randn(v.shape) for key, v in small_megaloc().state_dict().items()}
    save_file(tensors, folder / "megaloc-small.safetensors")
    return folder / "megaloc-small.safetensors"


WRITERS: dict[str, Callable[[Path], Path]] = {
    "netvlad": write_netvlad,
    "openibl": write_openibl,
    "apgem": write_apgem,
    "delg": write_delg,
    "megaloc": write_megaloc,
}
FILES: dict[str, Path] = {}


@pytest.fixture(scope="module", params=KINDS)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(autouse=True)
def _small_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nets_megaloc, "MegaLocNet", small_megaloc)


@pytest.fixture
def make(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., GlobalNetwork[Any]]:
    """Makes the plugin of a name, with its file unless there is another."""

    def made(name: str, **options: object) -> GlobalNetwork[Any]:
        if name not in FILES:
            torch.manual_seed(0)
            FILES[name] = WRITERS[name](tmp_path_factory.mktemp(name))
        given = {"device": "cpu", "weights": str(FILES[name]), **CHOSEN.get(name, {}), **options}
        return KINDS[name](KINDS[name].Options.model_validate(given))

    return made


Make = Callable[..., GlobalNetwork[Any]]


def seen(plugin: GlobalNetwork[Any], *images: Image) -> torch.Tensor:
    """Return the network's input of images."""
    return torch.cat([plugin._seen(image, torch.device("cpu")) for image in images])


def test_vectors_equal_the_network(name: str, make: Make) -> None:
    plugin = make(name)
    assert isinstance(plugin, GlobalFeatureExtractor)
    images = [texture(61, 83, seed, sigma_px=6.0) for seed in range(2)]
    many = plugin.describe_many(images)
    size, apart = SIZES[name]
    assert many.shape == (2, size) and many.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(many, axis=1), 1, atol=1e-6)
    assert np.abs(many[0] - many[1]).max() > apart
    for image, vector in zip(images, many, strict=True):
        np.testing.assert_allclose(plugin.describe(image), vector, atol=1e-5)
    np.testing.assert_array_equal(plugin.describe_many(images), many)
    net, _ = plugin.network(plugin._load, *plugin._load_with)
    batch = seen(plugin, *images)
    with torch.inference_mode():
        if name == "apgem":
            expected = net[0].describe(batch)
        elif name == "delg":
            expected = nets_delg.describe(net, batch, (1.0,))
        else:
            expected = net(batch)
    np.testing.assert_allclose(many, expected.numpy(), atol=1e-5)


def test_it_travels_and_names_its_weights(name: str, make: Make) -> None:
    plugin, image = make(name), texture(64, 80)
    packed = pickle.dumps(plugin)
    assert len(packed) < 10_000
    again = pickle.loads(packed)
    assert again.name == plugin.name
    np.testing.assert_array_equal(again.describe(image), plugin.describe(image.copy()))
    file = FILES[name]
    assert plugin.weights() == {file.name: hashlib.sha256(file.read_bytes()).hexdigest()}


def test_weights_that_are_missing_or_of_another_network(
    name: str, make: Make, tmp_path: Path
) -> None:
    with pytest.raises(MissingWeightsError, match=f"{name}"):
        KINDS[name]()
    torch.save({"conv1.weight": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(DataError, match=rf"other\.pth: .*{REFUSALS[name]}"):
        make(name, weights=str(tmp_path / "other.pth")).describe(random_image(32, 32))


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("netvlad", {}, "netvlad-tokyotm"),
        ("openibl", {}, "openibl-vgg16_netvlad"),
        ("apgem", {"whitening": "Landmarks_clean"}, "apgem-mine-Landmarks_clean-0.25"),
        ("apgem", {"whitening": "other", "whitening_power": 0.5}, "apgem-mine-other-0.5"),
        ("apgem", {}, "apgem-mine"),
        ("delg", {}, "r50delg_mine"),
        ("megaloc", {}, "megaloc-small"),
        ("megaloc", {"size_px": 448}, "megaloc-small-448px"),
    ],
)
def test_names_identify_comparable_vectors(
    make: Make, name: str, options: dict[str, object], expected: str
) -> None:
    assert make(name, **options).name == expected


def means_of_four(image: Image) -> NDArray[np.float64]:
    height, width, _ = image.shape
    parts = image.astype(np.float64).reshape(height // 2, 2, width // 2, 2, 3)
    return parts.mean(axis=(1, 3)) / 255


@pytest.mark.parametrize("name", ["netvlad", "openibl", "apgem"])
def test_a_large_image_is_shrunk_to_means_and_a_small_one_stays(make: Make, name: str) -> None:
    image = random_image(64, 96)
    for most, expected in ((48, means_of_four(image)), (96, image / 255), (200, image / 255)):
        result = seen(make(name, max_size_px=most), image)
        assert result.dtype == torch.float32
        # not rounded to whole numbers
        np.testing.assert_allclose(result[0].permute(1, 2, 0).numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("size", [(480, 640), (640, 480), (768, 1024), (120, 90), (7, 2000)])
def test_openibl_sees_the_official_size(make: Make, size: tuple[int, int]) -> None:
    image = random_image(*size)
    result = official_size(image)
    assert result.shape == (480, 640, 3) and result.dtype == np.uint8
    # torch's own resampling of the same kind, up to rounding
    planes = torch.from_numpy(image).permute(2, 0, 1)[None].double()
    expected = torch.nn.functional.interpolate(
        planes, (480, 640), mode="bilinear", antialias=True, align_corners=False
    )[0].permute(1, 2, 0)
    assert np.abs(result - expected.numpy()).max() <= 1.01
    shown = seen(make("openibl", max_size_px=None), image)[0].permute(1, 2, 0)
    np.testing.assert_allclose(shown.numpy() * 255, result, atol=1e-4)


def test_megaloc_sees_a_square_of_rgb(make: Make) -> None:
    # left half one colour, right half another: their order, their sides, their numbers
    image = np.zeros((50, 200, 3), dtype=np.uint8)
    image[:, :100], image[:, 100:] = (255, 0, 51), (0, 102, 255)
    result = seen(make("megaloc"), image)
    assert result.shape == (1, 3, 322, 322)
    for columns, colour in ((slice(0, 159), (1, 0, 0.2)), (slice(163, None), (0, 0.4, 1))):
        expected = torch.tensor(colour)[:, None, None].expand_as(result[0, :, :, columns])
        torch.testing.assert_close(result[0, :, :, columns], expected, rtol=0, atol=2e-6)
    assert seen(make("megaloc", size_px=140), image).shape == (1, 3, 140, 140)
    for size_px in (0, 112, 320, 325):  # that patches do not fill, or too few do
        with pytest.raises(ValidationError, match="size_px"):
            MegaLocOptions(size_px=size_px)


def test_delg_shrinks_by_pillow_and_gives_tensorflows_vector(make: Make) -> None:
    image = random_image(75, 201)
    assert _with_longer_side(image, None) is image and _with_longer_side(image, 201) is image
    pillow = PillowImage.fromarray(image).resize((100, 37), PillowImage.Resampling.BILINEAR)
    result = seen(make("delg", max_size_px=100), image)[0].permute(1, 2, 0)
    np.testing.assert_array_equal(result.numpy(), np.asarray(pillow))
    with np.load(DELG_REFERENCE) as written:
        vectors = written["slim"] / np.linalg.norm(written["slim"], axis=1, keepdims=True)
    image = np.random.RandomState(0).randint(0, 256, (101, 134, 3)).astype(np.uint8)
    np.testing.assert_allclose(make("delg").describe(image), vectors[1], atol=1e-6)
    joined = make("delg", scales=global_networks.DelgOptions().scales).describe(image)
    expected = vectors.sum(axis=0) / np.linalg.norm(vectors.sum(axis=0))
    np.testing.assert_allclose(joined, expected, atol=1e-6)


def test_overflow_in_half_precision_falls_back_to_full(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_an_image_that_is_too_small_for_vgg_is_refused(make: Make) -> None:
    with pytest.raises(DataError, match=r"20x15 pixels, but needs at least 16"):
        make("netvlad").describe(random_image(15, 20))
    with pytest.raises(DataError, match=r"64x6 pixels"):
        make("netvlad", max_size_px=64).describe(random_image(30, 320))
    assert make("netvlad").describe(random_image(16, 17)).shape == (12,)
    with pytest.raises(ValidationError, match="max_size_px"):
        make("netvlad", max_size_px=15)


def test_apgem_whitens(make: Make) -> None:
    image = texture(60, 80)
    plain = make("apgem").describe(image)
    result = make("apgem", whitening="Landmarks_clean").describe(image)
    parts = torch.load(FILES["apgem"], weights_only=True)
    mean, components, variance = (
        parts[f"pca.Landmarks_clean.{part}"].double().numpy()
        for part in ("mean", "components", "explained_variance")
    )
    expected = components @ (plain - mean) / variance**0.25
    np.testing.assert_allclose(result, expected / np.linalg.norm(expected), atol=1e-6)
    with pytest.raises(OptionError, match=r"no whitening 'other'; it has Landmarks_clean"):
        make("apgem", whitening="other").describe(image)
    with pytest.raises(ValidationError, match="whitening"):
        make("apgem", whitening="a/b")
