"""EigenPlaces and MegaLoc as plugins, on random weights in files of the published kinds."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pydantic import ValidationError
from safetensors.torch import save_file

from megloc_kapture.errors import DataError
from megloc_kapture.features import global_networks
from megloc_kapture.features.global_networks import (
    EigenPlaces,
    EigenPlacesOptions,
    GlobalNetwork,
    MegaLoc,
    MegaLocOptions,
)
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.nets import megaloc as nets_megaloc
from megloc_kapture.nets.global_descriptors import EigenPlacesNet
from megloc_kapture.nets.megaloc import DinoV2, MegaLocNet
from megloc_kapture.plugins import GlobalFeatureExtractor

Image = NDArray[np.uint8]
Maker = Callable[..., GlobalNetwork]
NAMES = ["eigenplaces", "megaloc"]
SIZES = {"eigenplaces": 128, "megaloc": 10}


def small() -> MegaLocNet:
    return MegaLocNet(
        DinoV2(channels=12, depth=2, heads=3, grid=7),
        clusters=5,
        cluster_size=4,
        token_size=6,
        descriptor_size=SIZES["megaloc"],
    )


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    eigenplaces = folder / "ResNet50_128_eigenplaces.pth"
    torch.save(EigenPlacesNet(50, SIZES["eigenplaces"]).state_dict(), eigenplaces)
    generator = torch.Generator().manual_seed(0)
    tensors = {
        key: torch.randn(value.shape, generator=generator) * 0.3
        for key, value in small().state_dict().items()
    }
    save_file(tensors, folder / "megaloc-small.safetensors")
    return {"eigenplaces": eigenplaces, "megaloc": folder / "megaloc-small.safetensors"}


@pytest.fixture(autouse=True)
def _small_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nets_megaloc, "MegaLocNet", small)


@pytest.fixture
def extractor(files: dict[str, Path]) -> Maker:
    """Makes the plugin of a name, with its file unless there is another."""

    def make(name: str, weights: Path | None = None, **options: object) -> GlobalNetwork:
        given = {"device": "cpu", "weights": str(weights or files[name]), **options}
        if name == "megaloc":
            return MegaLoc(MegaLocOptions.model_validate(given))
        return EigenPlaces(EigenPlacesOptions.model_validate(given))

    return make


def random_image(height: int, width: int, seed: int = 0) -> Image:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("name", "size"),
    [
        *(("eigenplaces", size) for size in [(64, 64), (101, 33), (1, 1), (7, 130)]),
        *(("megaloc", size) for size in [(322, 322), (101, 233), (480, 3), (1, 1), (15, 14)]),
        ("megaloc", (700, 501)),
    ],
)
def test_images_of_any_size_have_vectors_of_unit_length(
    extractor: Maker, name: str, size: tuple[int, int]
) -> None:
    found = extractor(name).describe(random_image(*size))
    assert found.shape == (SIZES[name],) and found.dtype == np.float32
    assert np.linalg.norm(found) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(("name", "apart"), [("eigenplaces", 1e-5), ("megaloc", 1e-3)])
def test_many_are_described_as_one_by_one(extractor: Maker, name: str, apart: float) -> None:
    images = [random_image(61, 83, seed) for seed in range(3)]
    found = extractor(name)
    many = found.describe_many(images)
    assert many.shape == (3, SIZES[name]) and many.dtype == np.float32
    for image, vector in zip(images, many, strict=True):
        np.testing.assert_allclose(found.describe(image), vector, atol=1e-6)
    assert np.abs(many[0] - many[1]).max() > apart


@pytest.mark.parametrize(("name", "size"), [("eigenplaces", (50, 70)), ("megaloc", (90, 120))])
def test_two_runs_give_the_same_also_after_pickling(
    extractor: Maker, name: str, size: tuple[int, int]
) -> None:
    first = extractor(name)
    again = pickle.loads(pickle.dumps(first))
    assert len(pickle.dumps(first)) < 2000
    image = random_image(*size)
    np.testing.assert_array_equal(first.describe(image), again.describe(image.copy()))


@pytest.mark.parametrize(("name", "size"), [("eigenplaces", (96, 64)), ("megaloc", (200, 150))])
def test_half_precision_describes_nearly_the_same(
    extractor: Maker, name: str, size: tuple[int, int]
) -> None:
    image = random_image(*size)
    full = extractor(name).describe(image)
    half = extractor(name, half_precision=True).describe(image)
    assert half.dtype == np.float32 and np.linalg.norm(half) == pytest.approx(1, abs=1e-6)
    assert full @ half > 0.99 and (full != half).any()


@pytest.mark.parametrize("name", NAMES)
def test_weights_are_named_by_their_sha256(
    extractor: Maker, files: dict[str, Path], name: str
) -> None:
    found = extractor(name)
    assert isinstance(found, GlobalFeatureExtractor)
    assert list(found.weights()) == [files[name].name]
    assert len(found.weights()[files[name].name]) == 64


@pytest.mark.parametrize(
    ("name", "reason"),
    [("eigenplaces", r": no EigenPlaces"), ("megaloc", r".*unexpected keys: conv1\.weight")],
)
def test_a_file_of_another_network_is_refused(
    extractor: Maker, tmp_path: Path, name: str, reason: str
) -> None:
    torch.save({"conv1.weight": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(DataError, match=r"other\.pth" + reason):
        extractor(name, tmp_path / "other.pth").describe(random_image(20, 20))


def test_eigenplaces_sees_normalised_rgb_of_the_images_size_or_less(
    extractor: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = EigenPlacesNet(50, SIZES["eigenplaces"]).eval()
    seen: list[torch.Tensor] = []
    network.backbone.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].clone()))
    given = network, torch.device("cpu")
    monkeypatch.setattr(global_networks.GlobalNetwork, "network", lambda *_, **__: given)
    image = random_image(60, 160)
    mean, deviation = np.array([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])

    def expected(pixels: NDArray[np.float32]) -> NDArray[np.float64]:
        return ((pixels / 255 - mean) / deviation).transpose(2, 0, 1)[None]

    for max_size_px, size in ((160, (60, 160)), (None, (60, 160)), (80, (30, 80))):
        extractor("eigenplaces", max_size_px=max_size_px).describe(image)
        pixels = image.astype(np.float32)
        if size != image.shape[:2]:
            pixels = cv2.resize(pixels, size[::-1], interpolation=cv2.INTER_AREA)
        np.testing.assert_allclose(seen[-1].numpy(), expected(pixels), atol=1e-5)


def test_the_name_of_eigenplaces_tells_the_model(extractor: Maker, tmp_path: Path) -> None:
    assert extractor("eigenplaces").name == "ResNet50_128_eigenplaces"
    other = tmp_path / "cosplace.pth"
    other.write_bytes(b"")
    assert extractor("eigenplaces", other).name == "eigenplaces-cosplace"


class Spy(torch.nn.Module):
    """Keeps what the trunk is given."""

    def __init__(self, trunk: torch.nn.Module) -> None:
        super().__init__()
        self.trunk = trunk
        self.seen = torch.empty(0)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        self.seen = image.clone()
        return self.trunk(image)


def test_megaloc_sees_a_normalised_square_of_rgb(
    extractor: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = small()
    spy = Spy(network.backbone)
    network.backbone = spy
    given = network.eval(), torch.device("cpu")
    monkeypatch.setattr(global_networks.GlobalNetwork, "network", lambda *_, **__: given)
    # left half one colour, right half another: their order, their sides, their numbers
    image = np.zeros((50, 200, 3), dtype=np.uint8)
    image[:, :100], image[:, 100:] = (255, 0, 51), (0, 102, 255)
    extractor("megaloc").describe(image)
    assert spy.seen.shape == (1, 3, 322, 322)
    left = [(1 - 0.485) / 0.229, (0 - 0.456) / 0.224, (0.2 - 0.406) / 0.225]
    right = [(0 - 0.485) / 0.229, (0.4 - 0.456) / 0.224, (1 - 0.406) / 0.225]
    for columns, colour in ((slice(0, 159), left), (slice(163, None), right)):
        expected = torch.tensor(colour)[:, None, None].expand_as(spy.seen[0, :, :, columns])
        torch.testing.assert_close(spy.seen[0, :, :, columns], expected, rtol=0, atol=1e-5)
    extractor("megaloc", size_px=140).describe(image)
    assert spy.seen.shape == (1, 3, 140, 140)


def test_the_name_of_megaloc_tells_what_vectors_must_have_in_common(
    extractor: Maker, files: dict[str, Path], tmp_path: Path
) -> None:
    assert extractor("megaloc").name == "megaloc-small"
    assert extractor("megaloc", size_px=448).name == "megaloc-small-448px"
    copy = tmp_path / "model.safetensors"
    copy.write_bytes(files["megaloc"].read_bytes())
    assert extractor("megaloc", copy).name == "megaloc-model"


def test_the_published_file_is_found_in_the_folder_of_weights(
    files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(tmp_path))
    with pytest.raises(MissingWeightsError, match=r"megloc weights fetch megaloc$"):
        MegaLoc()
    published = tmp_path / "MegaLoc" / "model.safetensors"
    published.parent.mkdir()
    published.write_bytes(files["megaloc"].read_bytes())
    found = MegaLoc()
    assert found.name == "megaloc"
    with pytest.raises(DataError, match="is not the published file of megaloc"):
        found.describe(random_image(20, 20))


@pytest.mark.parametrize("size_px", [0, 112, 320, 325])
def test_sizes_that_patches_do_not_fill_or_too_few_do_are_refused(size_px: int) -> None:
    with pytest.raises(ValidationError, match="size_px"):
        MegaLocOptions(size_px=size_px)
