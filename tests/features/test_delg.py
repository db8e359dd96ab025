"""DELG as a plugin: a SavedModel in, TensorFlow's vectors out."""

from __future__ import annotations

import pickle
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image as PillowImage

from megloc_kapture.errors import DataError
from megloc_kapture.features.global_networks import Delg, DelgOptions, _with_longer_side
from megloc_kapture.io.weights import MissingWeightsError
from megloc_kapture.plugins import GlobalFeatureExtractor

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from tensorflow_checkpoints import write_saved_model  # noqa: E402

# written by TensorFlow, see make_reference.py there
WRITTEN = Path(__file__).parents[1] / "nets" / "data" / "delg"


def values_of(name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """As make_reference.py has it, of TF-Slim's names."""
    random = np.random.RandomState(zlib.crc32(name.encode()))
    if len(shape) > 1:
        deviation = np.sqrt(2 / np.prod(shape[:-1]))
        return (random.standard_normal(shape) * deviation).astype(np.float32)
    word = name.rpartition("/")[2]
    low, high = {"moving_variance": (0.5, 2.0), "gamma": (0.3, 0.7)}.get(word, (-0.2, 0.2))
    return random.uniform(low, high, shape).astype(np.float32)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rows = [row.split() for row in (WRITTEN / "slim.txt").read_text().splitlines()]
    arrays = {name: values_of(name, tuple(map(int, s.split("x")))) for name, s in rows}
    path = tmp_path_factory.mktemp("weights") / "r50delg_mine.tar.gz"
    write_saved_model(path, "r50delg", arrays)
    return path


@pytest.fixture(scope="module")
def image() -> NDArray[np.uint8]:
    return np.random.RandomState(0).randint(0, 256, (101, 134, 3)).astype(np.uint8)


def extractor(weights: Path, **options: object) -> Delg:
    return Delg(DelgOptions.model_validate({"weights": str(weights), "device": "cpu", **options}))


def test_a_saved_model_gives_tensorflows_vector(weights: Path, image: NDArray[np.uint8]) -> None:
    plugin = extractor(weights)
    assert isinstance(plugin, GlobalFeatureExtractor) and plugin.name == "r50delg_mine"
    found = plugin.describe(image)
    with np.load(WRITTEN / "reference.npz") as written:
        vectors = written["slim"] / np.linalg.norm(written["slim"], axis=1, keepdims=True)
    expected = vectors.sum(axis=0) / np.linalg.norm(vectors.sum(axis=0))
    assert found.shape == (2048,) and found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-6)
    one = extractor(weights, scales=[1.0]).describe(image)
    np.testing.assert_allclose(one, vectors[1], atol=1e-6)


def test_batches_and_half_precision(weights: Path, image: NDArray[np.uint8]) -> None:
    small = np.ascontiguousarray(image[:64, :80])
    plugin = extractor(weights, scales=[1.0])
    together = plugin.describe_many([small, small[::-1]])
    for row, one in enumerate((small, small[::-1])):
        np.testing.assert_allclose(together[row], plugin.describe(one), atol=1e-6)
    assert np.abs(together[0] - together[1]).max() > 1e-4
    half = extractor(weights, scales=[1.0], half_precision=True).describe(small)
    assert not np.array_equal(half, together[0]) and half @ together[0] > 0.99


def test_it_travels_light(weights: Path) -> None:
    packed = pickle.dumps(extractor(weights))
    assert len(packed) < 10_000
    assert list(pickle.loads(packed).weights()) == ["r50delg_mine.tar.gz"]


def test_larger_images_are_made_smaller_by_pillow() -> None:
    image = np.random.default_rng(0).integers(0, 256, (75, 201, 3), dtype=np.uint8)
    assert _with_longer_side(image, None) is image and _with_longer_side(image, 201) is image
    found = _with_longer_side(image, 100)
    pillow = PillowImage.fromarray(image).resize((100, 37), PillowImage.Resampling.BILINEAR)
    assert found.shape == (37, 100, 3) and np.array_equal(found, np.asarray(pillow))
    # a filter two pixels wide, not samples: stripes become gray
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::2] = 200
    assert np.abs(_with_longer_side(stripes, 32)[:, 1:-1].astype(int) - 100).max() <= 1


def test_missing_weights_and_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(tmp_path))
    with pytest.raises(MissingWeightsError, match="no r101delg_gldv2clean_20200914"):
        Delg()
    (tmp_path / "r50delg_gld_20200814.tar.gz").touch()
    assert Delg(DelgOptions(weights="delg-r50-gld")).name == "delg-r50-gld"


def test_models_of_other_things(tmp_path: Path, image: NDArray[np.uint8]) -> None:
    path = tmp_path / "other.tar.gz"
    write_saved_model(path, "r50delg", {"dense/kernel": np.ones((2, 3), np.float32)})
    message = r"other\.tar\.gz: no DELG .*resnet_v1_101.*found: dense/kernel$"
    with pytest.raises(DataError, match=message):
        extractor(path).describe(image)
    torch.save({"a": torch.zeros(1)}, tmp_path / "a.pth")
    with pytest.raises(DataError, match=r"a\.pth: no DELG .*found: a$"):
        extractor(tmp_path / "a.pth").describe(image)
