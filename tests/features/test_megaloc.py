"""MegaLoc as a plugin, on a small network of random weights in a file of the published kind."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pydantic import ValidationError
from safetensors.torch import save_file

from megloc_kapture.errors import DataError
from megloc_kapture.features import megaloc
from megloc_kapture.features.megaloc import MegaLoc, MegaLocOptions
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.nets import megaloc as nets_megaloc
from megloc_kapture.nets.dinov2 import DinoV2
from megloc_kapture.nets.megaloc import MegaLocNet
from megloc_kapture.plugins import GlobalFeatureExtractor

Image = NDArray[np.uint8]
SIZE = 10


def small() -> MegaLocNet:
    return MegaLocNet(
        DinoV2(channels=12, depth=2, heads=3, grid=7),
        clusters=5,
        cluster_size=4,
        token_size=6,
        descriptor_size=SIZE,
    )


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    generator = torch.Generator().manual_seed(0)
    tensors = {
        key: torch.randn(value.shape, generator=generator) * 0.3
        for key, value in small().state_dict().items()
    }
    place = tmp_path_factory.mktemp("weights") / "megaloc-small.safetensors"
    save_file(tensors, place)
    return place


@pytest.fixture(autouse=True)
def _small_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nets_megaloc, "MegaLocNet", small)


def extractor(weights: Path, **options: object) -> MegaLoc:
    return MegaLoc(
        MegaLocOptions.model_validate({"device": "cpu", "weights": str(weights), **options})
    )


def random_image(height: int, width: int, seed: int = 0) -> Image:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize("size", [(322, 322), (101, 233), (480, 3), (1, 1), (15, 14), (700, 501)])
def test_images_of_any_size_have_vectors_of_unit_length(
    weights: Path, size: tuple[int, int]
) -> None:
    found = extractor(weights).describe(random_image(*size))
    assert found.shape == (SIZE,) and found.dtype == np.float32
    assert np.linalg.norm(found) == pytest.approx(1, abs=1e-6)


def test_many_are_described_as_one_by_one(weights: Path) -> None:
    images = [random_image(61, 83, seed) for seed in range(3)]
    found = extractor(weights)
    many = found.describe_many(images)
    assert many.shape == (3, SIZE) and many.dtype == np.float32
    for image, vector in zip(images, many, strict=True):
        np.testing.assert_allclose(found.describe(image), vector, atol=1e-6)
    assert np.abs(many[0] - many[1]).max() > 1e-3


def test_two_runs_give_the_same_also_after_pickling(weights: Path) -> None:
    first = extractor(weights)
    again = pickle.loads(pickle.dumps(first))
    assert len(pickle.dumps(first)) < 2000
    image = random_image(90, 120)
    np.testing.assert_array_equal(first.describe(image), again.describe(image.copy()))


class Spy(torch.nn.Module):
    """Keeps what the trunk is given."""

    def __init__(self, trunk: torch.nn.Module) -> None:
        super().__init__()
        self.trunk = trunk
        self.seen = torch.empty(0)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        self.seen = image.clone()
        return self.trunk(image)


def test_the_trunk_sees_a_normalised_square_of_rgb(
    weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = small()
    spy = Spy(network.backbone)
    network.backbone = spy
    monkeypatch.setattr(megaloc, "_network", lambda *_: network.eval())
    # left half one colour, right half another: their order, their place, their numbers
    image = np.zeros((50, 200, 3), dtype=np.uint8)
    image[:, :100], image[:, 100:] = (255, 0, 51), (0, 102, 255)
    extractor(weights).describe(image)
    assert spy.seen.shape == (1, 3, 322, 322)
    left = [(1 - 0.485) / 0.229, (0 - 0.456) / 0.224, (0.2 - 0.406) / 0.225]
    right = [(0 - 0.485) / 0.229, (0.4 - 0.456) / 0.224, (1 - 0.406) / 0.225]
    for columns, colour in ((slice(0, 159), left), (slice(163, None), right)):
        expected = torch.tensor(colour)[:, None, None].expand_as(spy.seen[0, :, :, columns])
        torch.testing.assert_close(spy.seen[0, :, :, columns], expected, rtol=0, atol=1e-5)
    extractor(weights, size_px=140).describe(image)
    assert spy.seen.shape == (1, 3, 140, 140)


def test_half_precision_describes_nearly_the_same(weights: Path) -> None:
    image = random_image(200, 150)
    full = extractor(weights).describe(image)
    half = extractor(weights, half_precision=True).describe(image)
    assert half.dtype == np.float32 and np.linalg.norm(half) == pytest.approx(1, abs=1e-6)
    assert full @ half > 0.99 and (full != half).any()


def test_the_name_tells_what_vectors_must_have_in_common(weights: Path, tmp_path: Path) -> None:
    assert extractor(weights).name == "megaloc-small"
    assert extractor(weights, size_px=448).name == "megaloc-small-448px"
    copy = tmp_path / "model.safetensors"
    copy.write_bytes(weights.read_bytes())
    assert extractor(copy).name == "megaloc-model"


def test_weights_are_named_by_their_sha256(weights: Path) -> None:
    found = extractor(weights).weights()
    assert list(found) == ["megaloc-small.safetensors"]
    assert len(found["megaloc-small.safetensors"]) == 64
    assert isinstance(extractor(weights), GlobalFeatureExtractor)


def test_the_published_file_is_found_in_the_folder_of_weights(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(tmp_path))
    with pytest.raises(MissingWeightsError, match=r"megloc weights fetch megaloc$"):
        MegaLoc()
    place = tmp_path / "MegaLoc" / "model.safetensors"
    place.parent.mkdir()
    place.write_bytes(weights.read_bytes())
    found = MegaLoc()
    assert found.name == "megaloc"
    with pytest.raises(DataError, match="is not the published file of megaloc"):
        found.describe(random_image(20, 20))


@pytest.mark.parametrize("size_px", [0, 112, 320, 325])
def test_sizes_that_patches_do_not_fill_or_too_few_do_are_refused(size_px: int) -> None:
    with pytest.raises(ValidationError, match="size_px"):
        MegaLocOptions(size_px=size_px)


def test_a_file_of_another_network_is_refused(tmp_path: Path) -> None:
    torch.save({"conv1.weight": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(DataError, match=r"other\.pth.*unexpected keys: conv1\.weight"):
        extractor(tmp_path / "other.pth").describe(random_image(20, 20))
