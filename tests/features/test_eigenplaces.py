"""EigenPlaces as a plugin, on random weights in a file of the published kind."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.features import eigenplaces
from megloc_kapture.features.eigenplaces import EigenPlaces, EigenPlacesOptions
from megloc_kapture.nets.eigenplaces import EigenPlacesNet
from megloc_kapture.plugins import GlobalFeatureExtractor

Image = NDArray[np.uint8]
SIZE = 128


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    place = tmp_path_factory.mktemp("weights") / "ResNet50_128_eigenplaces.pth"
    torch.save(EigenPlacesNet(50, SIZE).state_dict(), place)
    return place


def extractor(weights: Path, **options: object) -> EigenPlaces:
    return EigenPlaces(
        EigenPlacesOptions.model_validate({"device": "cpu", "weights": str(weights), **options})
    )


def random_image(height: int, width: int, seed: int = 0) -> Image:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize("size", [(64, 64), (101, 33), (1, 1), (7, 130)])
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
    assert np.abs(many[0] - many[1]).max() > 1e-5


def test_two_runs_give_the_same_also_after_pickling(weights: Path) -> None:
    first = extractor(weights)
    again = pickle.loads(pickle.dumps(first))
    assert len(pickle.dumps(first)) < 2000
    image = random_image(50, 70)
    np.testing.assert_array_equal(first.describe(image), again.describe(image.copy()))


def test_the_trunk_sees_normalised_rgb_of_the_images_size_or_less(
    weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = EigenPlacesNet(50, SIZE).eval()
    seen: list[torch.Tensor] = []
    network.backbone.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].clone()))
    monkeypatch.setattr(eigenplaces, "_network", lambda *_: network)
    image = random_image(60, 160)
    mean, deviation = np.array([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])

    def expected(pixels: NDArray[np.float32]) -> NDArray[np.float64]:
        return ((pixels / 255 - mean) / deviation).transpose(2, 0, 1)[None]

    for max_size_px, size in ((160, (60, 160)), (None, (60, 160)), (80, (30, 80))):
        extractor(weights, max_size_px=max_size_px).describe(image)
        pixels = image.astype(np.float32)
        if size != image.shape[:2]:
            pixels = cv2.resize(pixels, size[::-1], interpolation=cv2.INTER_AREA)
        np.testing.assert_allclose(seen[-1].numpy(), expected(pixels), atol=1e-5)


def test_half_precision_describes_nearly_the_same(weights: Path) -> None:
    image = random_image(96, 64)
    full = extractor(weights).describe(image)
    half = extractor(weights, half_precision=True).describe(image)
    assert half.dtype == np.float32 and np.linalg.norm(half) == pytest.approx(1, abs=1e-6)
    assert full @ half > 0.99 and (full != half).any()


def test_the_name_tells_the_model(weights: Path, tmp_path: Path) -> None:
    found = extractor(weights)
    assert found.name == "ResNet50_128_eigenplaces"
    assert isinstance(found, GlobalFeatureExtractor)
    assert list(found.weights()) == ["ResNet50_128_eigenplaces.pth"]
    other = tmp_path / "cosplace.pth"
    other.write_bytes(b"")
    assert extractor(other).name == "eigenplaces-cosplace"


def test_a_file_of_another_network_is_refused(tmp_path: Path) -> None:
    torch.save({"conv1.weight": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(DataError, match=r"other\.pth: no EigenPlaces"):
        extractor(tmp_path / "other.pth").describe(random_image(20, 20))
