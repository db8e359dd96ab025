"""VLAD against its formulas, the vocabulary against known clusters, whitening against scipy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.features import vlad
from megloc_kapture.features.vlad import (
    VladOptions,
    Vocabulary,
    aggregate,
    learn_whitening,
    sample_rows,
    train_vlad,
    train_vocabulary,
)

EMPTY = np.zeros((0, 8), np.float32)


def unit_rows(rng: np.random.Generator, count: int, size: int) -> NDArray[np.float32]:
    rows = rng.normal(size=(count, size))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def by_formula(data: NDArray[np.float32], centres: NDArray[np.float32]) -> NDArray[np.float64]:
    residuals = np.zeros(centres.shape)
    for x in data.astype(np.float64):
        nearest = ((x - centres) ** 2).sum(axis=1).argmin()
        residuals[nearest] += x - centres[nearest]
    length = np.linalg.norm(residuals, axis=1, keepdims=True)
    residuals = residuals / np.where(length > 0, length, 1)
    return residuals.ravel() / np.linalg.norm(residuals)


def test_the_vector_equals_the_formula(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vlad, "_CHUNK", 7)  # descriptors are assigned in chunks
    rng = np.random.default_rng(1)
    data, centres = unit_rows(rng, 60, 8), unit_rows(rng, 5, 8)
    bytes_ = rng.integers(0, 256, (60, 8), dtype=np.uint8)
    for descriptors, words in ((data, centres), (bytes_, 255 * np.abs(centres))):
        vector = aggregate(descriptors, Vocabulary(words))
        assert vector.dtype == np.float32 and vector.shape == (40,)
        expected = by_formula(descriptors.astype(np.float32), words)
        np.testing.assert_allclose(vector, expected, atol=2e-6)


def test_the_vocabulary_finds_well_separated_clusters() -> None:
    rng = np.random.default_rng(100)
    truth = rng.normal(size=(6, 10)) * 10
    data = np.concatenate([c + 0.1 * rng.normal(size=(40, 10)) for c in truth])
    rows = rng.permutation(data).astype(np.float32)
    centres = train_vocabulary(rows, VladOptions(num_clusters=6)).centres
    labels = np.linalg.norm(rows[:, None] - centres, axis=2).argmin(axis=1)
    means = [rows[labels == k].astype(np.float64).mean(axis=0) for k in range(6)]
    np.testing.assert_allclose(centres, means, atol=1e-4)
    distance = np.linalg.norm(centres[:, None] - truth, axis=2)
    assert sorted(distance.argmin(axis=1).tolist()) == list(range(6))
    # the mean of 40 members in ten dimensions of sigma 0.1 is this accurate
    assert distance.min(axis=1).max() < 5 * 0.1 * np.sqrt(10 / 40)


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (train_vocabulary, (np.eye(9, 8), VladOptions(num_clusters=10)), "10 clusters .* has 9"),
        (
            train_vocabulary,
            (np.repeat(np.eye(3, 8), 20, axis=0), VladOptions(num_clusters=10)),
            "fewer than 10 distinct",
        ),
        (train_vocabulary, (np.full((20, 8), np.nan), VladOptions(num_clusters=4)), "not finite"),
        (aggregate, (np.zeros((5, 4)), Vocabulary(np.eye(3, 8))), "4 dimensions, .* has 8"),
        (train_vlad, (["a"], lambda _: 0, lambda _: EMPTY, VladOptions()), "no descriptors"),
        (learn_whitening, (np.ones((4, 8), np.float32), 3), "from 4 images with equal"),
    ],
    ids=["few", "copies", "NaN", "dimensions", "no descriptors", "equal images"],
)
def test_unusable_descriptors_are_refused(function: Any, arguments: Any, message: str) -> None:
    with pytest.raises(DataError, match=message):
        function(*arguments)


def test_training_depends_on_the_seed_only() -> None:
    data = unit_rows(np.random.default_rng(8), 500, 8)
    first = train_vocabulary(data, VladOptions(num_clusters=10, seed=1)).centres
    again = train_vocabulary(data.copy(), VladOptions(num_clusters=10, seed=1)).centres
    other = train_vocabulary(data, VladOptions(num_clusters=10, seed=2)).centres
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@given(st.lists(st.integers(0, 300), max_size=20), st.integers(1, 500), st.integers(0, 2**32 - 1))
def test_each_image_has_its_share_of_sampled_rows(counts: list[int], total: int, seed: int) -> None:
    rows = sample_rows(counts, total, seed)
    assert len(rows) == len(counts)
    share = min(1.0, total / max(sum(counts), 1))
    for chosen, count in zip(rows, counts, strict=True):
        assert (np.diff(chosen) > 0).all()  # sorted, each once
        assert len(chosen) == 0 or (chosen.min() >= 0 and chosen.max() < count)
        assert count * share <= len(chosen) + 1e-9 and len(chosen) < count * share + 1 + 1e-9


def images_of(rng: np.random.Generator, count: int) -> dict[str, NDArray[np.float32]]:
    """Images of a few kinds of descriptors each, and an empty image."""
    kinds = unit_rows(rng, 12, 8)
    result = {}
    for number in range(count):
        some = kinds[rng.integers(0, 12, 30)] + 0.2 * rng.normal(size=(30, 8))
        result[f"{number:03d}"] = some.astype(np.float32)
    return {**result, "empty": np.zeros((0, 8), np.float32)}


WHITENED = VladOptions(num_clusters=8, dimensions=10)


def train(images: dict[str, NDArray[np.float32]], options: VladOptions, **more: Any) -> Vocabulary:
    def length(name: str) -> int:
        return len(images[name])

    return train_vlad(sorted(images), length, images.__getitem__, options, **more)


def test_training_learns_the_vocabulary_then_whitening() -> None:
    images = images_of(np.random.default_rng(13), 30)
    vocabulary = train(images, WHITENED)
    named = sorted(set(images) - {"empty"})
    plain = train_vocabulary(np.concatenate([images[name] for name in named]), WHITENED)
    np.testing.assert_array_equal(vocabulary.centres, plain.centres)
    vectors = np.stack([aggregate(images[name], plain) for name in named])
    mean, projection = learn_whitening(vectors.copy(), 10)
    assert vocabulary.size == 10
    np.testing.assert_array_equal(vocabulary.projection, projection)
    np.testing.assert_array_equal(vocabulary.mean, mean)
    whitened = aggregate(images[named[0]], vocabulary)
    expected = projection @ (vectors[0] - mean)
    np.testing.assert_array_equal(whitened, expected / np.linalg.norm(expected))
    nothing = aggregate(images["empty"], vocabulary)
    np.testing.assert_array_equal(nothing, np.zeros(10, np.float32), strict=True)
    unwhitened = train(images, WHITENED.model_copy(update={"dimensions": None}))
    assert unwhitened.projection is None and unwhitened.size == 64


@pytest.mark.parametrize(("count", "size"), [(2, 1), (30, 10)])
def test_whitening_has_fewer_dimensions_than_images(count: int, size: int) -> None:
    projection = train(images_of(np.random.default_rng(14), count), WHITENED).projection
    assert projection is not None and len(projection) == size


def test_whitening_is_learnt_from_some_of_the_images(monkeypatch: pytest.MonkeyPatch) -> None:
    images = images_of(np.random.default_rng(16), 40)
    monkeypatch.setattr(vlad, "_WHITENING_IMAGES", 6)
    described: list[str] = []

    def each(function: Any, items: Any) -> Any:
        described.extend(items)
        return map(function, items)

    assert train(images, WHITENED, each=each).size == 5
    assert described == ["000", "008", "016", "023", "031", "039"]


def vectors_of(rng: np.random.Generator, count: int, size: int) -> NDArray[np.float32]:
    """Around a mean far from zero, each axis of another deviation."""
    turn = scipy.linalg.qr(rng.normal(size=(size, size)))[0]
    rows = rng.normal(size=(count, size)) * np.linspace(2.0, 0.1, size)
    return (rows @ turn + 3.0).astype(np.float32)


@pytest.mark.parametrize(("count", "size", "power"), [(200, 12, 0.0), (200, 12, 1.0), (9, 40, 0.5)])
def test_the_projection_is_the_eigenvectors_over_powers_of_the_deviations(
    count: int, size: int, power: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vlad, "_COLUMNS", 4)  # dimensions are read in parts
    monkeypatch.setattr(vlad, "WHITENING_POWER", power)
    data = vectors_of(np.random.default_rng(1), count, size)
    variances, axes = scipy.linalg.eigh(np.cov(data.astype(np.float64).T, bias=True))
    mean, projection = learn_whitening(data.copy(), 5)
    _, mirrored = learn_whitening(-data, 5)
    np.testing.assert_allclose(projection, mirrored, atol=1e-5)
    np.testing.assert_allclose(mean, data.mean(axis=0), atol=1e-5)
    assert projection.shape == (5, size)
    for k, row in enumerate(projection, start=1):
        expected = axes[:, -k] / np.sqrt(variances[-k]) ** power
        expected *= np.sign(expected[np.abs(expected).argmax()])
        np.testing.assert_allclose(row, expected, atol=5e-4)


def test_whitened_vectors_have_unit_length_and_zero_stays_zero() -> None:
    data = vectors_of(np.random.default_rng(6), 20, 10)
    mean, projection = learn_whitening(data.copy(), 4)
    vocabulary = Vocabulary(np.zeros((2, 5), np.float32), mean, projection)
    result = vocabulary.whiten(data[0])
    assert result.dtype == np.float32 and result.shape == (4,)
    np.testing.assert_allclose(np.linalg.norm(result), 1.0, atol=1e-6)
    assert not vocabulary.whiten(np.zeros(10, np.float32)).any()
    assert not vocabulary.whiten(mean).any()
    # dimensions without variance are left out
    rng = np.random.default_rng(7)
    flat = (rng.normal(size=(30, 3)) @ rng.normal(size=(3, 20))).astype(np.float32)
    assert len(learn_whitening(flat, 20)[1]) == 3
