"""VLAD against the formulas written out as loops, and the vocabulary against known clusters."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
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
    soft_assignment,
    train_vlad,
    train_vocabulary,
)


def unit_rows(rng: np.random.Generator, count: int, size: int) -> NDArray[np.float32]:
    rows = rng.normal(size=(count, size))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def vlad_by_loops(
    data: NDArray[np.float32], centres: NDArray[np.float32], options: VladOptions
) -> NDArray[np.float64]:
    num_clusters, size = centres.shape
    residuals = np.zeros((num_clusters, size))
    for x in data.astype(np.float64):
        squared = [float(((x - c) ** 2).sum()) for c in centres.astype(np.float64)]
        if options.assignment == "hard":
            weights = [float(k == int(np.argmin(squared))) for k in range(num_clusters)]
        else:
            least = min(squared)
            powers = [np.exp(-vlad.ALPHA * (s - least)) for s in squared]
            weights = [p / sum(powers) for p in powers]
        for k in range(num_clusters):
            for j in range(size):
                residuals[k, j] += weights[k] * (x[j] - float(centres[k, j]))
    for k in range(num_clusters):
        length = np.sqrt((residuals[k] ** 2).sum())
        residuals[k] = residuals[k] / length if length > 0 else 0.0
    vector = residuals.ravel()
    length = np.sqrt((vector**2).sum())
    return vector / length if length > 0 else vector


@pytest.mark.parametrize("assignment", ["hard", "soft"])
def test_the_vector_is_the_formulas(assignment: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vlad, "ALPHA", 4.0)
    rng = np.random.default_rng(1)
    data, centres = unit_rows(rng, 60, 8), unit_rows(rng, 5, 8)
    options = VladOptions.model_validate({"assignment": assignment})
    bytes_ = rng.integers(0, 256, (60, 8), dtype=np.uint8)
    for descriptors, words in ((data, centres), (bytes_, 255 * np.abs(centres))):
        vector = aggregate(descriptors, Vocabulary(words[None]), options)
        assert vector.dtype == np.float32 and vector.shape == (40,)
        expected = vlad_by_loops(descriptors.astype(np.float32), words, options)
        np.testing.assert_allclose(vector, expected, atol=2e-6)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 200.0))
@settings(max_examples=30, deadline=None)
def test_soft_weights_are_equation_one(seed: int, alpha: float) -> None:
    rng = np.random.default_rng(seed)
    data, centres = rng.normal(size=(7, 4)), rng.normal(size=(3, 4))
    squared = ((data[:, None] - centres) ** 2).sum(axis=2)
    powers = np.exp(-alpha * (squared - squared.min(axis=1, keepdims=True)))
    np.testing.assert_allclose(
        soft_assignment(data, centres, alpha), powers / powers.sum(axis=1, keepdims=True), atol=1e-9
    )
    # far from every centre nothing overflows
    far = soft_assignment(np.array([[1e4, 0.0]]), np.array([[1.0, 0.0], [0.0, 1.0]]), 5 * alpha)
    np.testing.assert_array_equal(far, [[1.0, 0.0]])


def test_more_descriptors_than_one_chunk(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    data, centres = unit_rows(rng, 50, 8), unit_rows(rng, 4, 8)
    for assignment in ("hard", "soft"):
        options = VladOptions.model_validate({"assignment": assignment})
        whole = aggregate(data, Vocabulary(centres[None]), options)
        with monkeypatch.context() as patch:
            patch.setattr("megloc_kapture.features.vlad._CHUNK", 7)
            parts = aggregate(data, Vocabulary(centres[None]), options)
        np.testing.assert_allclose(parts, whole, atol=1e-6)


def test_no_residuals_give_the_zero_vector() -> None:
    centres = np.eye(3, 8, dtype=np.float32)
    vocabulary = Vocabulary(centres[None])
    for assignment in ("hard", "soft"):
        options = VladOptions.model_validate({"assignment": assignment})
        vector = aggregate(np.zeros((0, 8), np.float32), vocabulary, options)
        assert vector.shape == (24,) and vector.dtype == np.float32 and not vector.any()
    assert not aggregate(centres, vocabulary, VladOptions()).any()
    with pytest.raises(DataError, match="4 dimensions, but the vocabulary has 8"):
        aggregate(np.zeros((5, 4), np.float32), vocabulary)


def clusters(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    truth = rng.normal(size=(6, 10)) * 10
    data = np.concatenate([c + 0.1 * rng.normal(size=(40, 10)) for c in truth])
    return truth, rng.permutation(data).astype(np.float32)


@pytest.mark.parametrize("seed", range(2))
def test_the_vocabulary_finds_well_separated_clusters(seed: int) -> None:
    truth, data = clusters(np.random.default_rng(100 + seed))
    centres = train_vocabulary(data, VladOptions(num_clusters=6, seed=seed)).centres[0]
    assert centres.dtype == np.float32
    distance = np.linalg.norm(centres[:, None] - truth, axis=2)
    assert sorted(distance.argmin(axis=1).tolist()) == list(range(6))
    # the mean of 40 members in ten dimensions of sigma 0.1 is this good
    assert distance.min(axis=1).max() < 5 * 0.1 * np.sqrt(10 / 40)


def test_the_vocabulary_is_a_fixed_point_of_lloyd(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vlad, "LLOYD_STEPS", 100)
    _, data = clusters(np.random.default_rng(7))
    centres = train_vocabulary(data, VladOptions(num_clusters=4)).centres[0]
    labels = np.linalg.norm(data[:, None] - centres, axis=2).argmin(axis=1)
    means = np.array([data[labels == k].astype(np.float64).mean(axis=0) for k in range(4)])
    np.testing.assert_allclose(centres, means, atol=1e-4)


@pytest.mark.parametrize(
    ("num_clusters", "rows", "message"),
    [
        (10, np.eye(9, 8), "10 clusters .* has 9"),
        (10, np.repeat(np.eye(3, 8), 20, axis=0), "fewer than 10 distinct"),
        (4, np.where(np.eye(20, 8) > 0, np.nan, 1.0), "not finite"),
    ],
    ids=["few", "copies", "NaN"],
)
def test_descriptors_that_make_no_vocabulary(
    num_clusters: int, rows: NDArray[np.float64], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        train_vocabulary(rows, VladOptions(num_clusters=num_clusters))


def test_training_depends_on_the_seed_only() -> None:
    data = unit_rows(np.random.default_rng(8), 500, 8)
    first = train_vocabulary(data, VladOptions(num_clusters=10, seed=1)).centres
    again = train_vocabulary(data.copy(), VladOptions(num_clusters=10, seed=1)).centres
    other = train_vocabulary(data, VladOptions(num_clusters=10, seed=2)).centres
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    # the first of several is the one that is trained alone
    several = train_vocabulary(data, VladOptions(num_clusters=10, seed=1, vocabularies=2)).centres
    np.testing.assert_array_equal(first[0], several[0])


@given(st.lists(st.integers(0, 300), max_size=20), st.integers(1, 500), st.integers(0, 2**32 - 1))
def test_sampled_rows_are_a_share_of_every_image(counts: list[int], total: int, seed: int) -> None:
    rows = sample_rows(counts, total, seed)
    assert len(rows) == len(counts)
    share = min(1.0, total / max(sum(counts), 1))
    for chosen, count in zip(rows, counts, strict=True):
        assert (np.diff(chosen) > 0).all()  # sorted, each once
        assert len(chosen) == 0 or (chosen.min() >= 0 and chosen.max() < count)
        assert count * share <= len(chosen) + 1e-9 and len(chosen) < count * share + 1 + 1e-9
    assert all(
        np.array_equal(a, b) for a, b in zip(rows, sample_rows(counts, total, seed), strict=True)
    )


def test_vocabularies_are_concatenated_with_equal_weight() -> None:
    rng = np.random.default_rng(11)
    data = unit_rows(rng, 300, 8)
    options = VladOptions(num_clusters=4, vocabularies=3)
    vocabulary = train_vocabulary(data, options)
    assert vocabulary.centres.shape == (3, 4, 8) and vocabulary.size == 96
    assert len({centres.tobytes() for centres in vocabulary.centres}) == 3
    image = unit_rows(rng, 40, 8)
    alone = [vlad_by_loops(image, centres, options) for centres in vocabulary.centres]
    np.testing.assert_allclose(
        aggregate(image, vocabulary, options), np.concatenate(alone) / np.sqrt(3), atol=2e-6
    )


def images_of(rng: np.random.Generator, count: int) -> dict[str, NDArray[np.float32]]:
    """Images of a few kinds of descriptors each, and one without any."""
    kinds = unit_rows(rng, 12, 8)
    result = {}
    for number in range(count):
        some = kinds[rng.integers(0, 12, 30)] + 0.2 * rng.normal(size=(30, 8))
        result[f"{number:03d}"] = some.astype(np.float32)
    return {**result, "empty": np.zeros((0, 8), np.float32)}


WHITENED = VladOptions(num_clusters=4, vocabularies=2, dimensions=10)


def train(images: dict[str, NDArray[np.float32]], options: VladOptions) -> Vocabulary:
    return train_vlad(sorted(images), lambda name: len(images[name]), images.__getitem__, options)


def test_training_learns_vocabularies_then_whitening() -> None:
    images = images_of(np.random.default_rng(13), 30)
    vocabulary = train(images, WHITENED)
    named = sorted(set(images) - {"empty"})
    plain = train_vocabulary(np.concatenate([images[name] for name in named]), WHITENED)
    np.testing.assert_array_equal(vocabulary.centres, plain.centres)
    vectors = np.stack([aggregate(images[name], plain, WHITENED) for name in named])
    expected = learn_whitening(vectors.copy(), 10, 0.5)
    assert vocabulary.whitening is not None and vocabulary.size == 10
    np.testing.assert_array_equal(vocabulary.whitening.projection, expected.projection)
    np.testing.assert_array_equal(vocabulary.whitening.mean, expected.mean)
    for name, vector in zip(named, vectors, strict=True):
        np.testing.assert_array_equal(
            aggregate(images[name], vocabulary, WHITENED), expected.apply(vector)
        )
    assert not aggregate(images["empty"], vocabulary, WHITENED).any()
    none = train(images, WHITENED.model_copy(update={"dimensions": None}))
    assert none.whitening is None and none.size == 64


# fewer than images, and no more than wanted
@pytest.mark.parametrize(("count", "size"), [(2, 1), (5, 4), (30, 10)])
def test_dimensions_of_whitening(count: int, size: int) -> None:
    whitening = train(images_of(np.random.default_rng(14), count), WHITENED).whitening
    assert whitening is not None and len(whitening.projection) == size


def test_images_that_cannot_be_trained_on() -> None:
    with pytest.raises(DataError, match="no descriptors"):
        train({"empty": np.zeros((0, 8), np.float32)}, WHITENED)
    with pytest.raises(DataError, match="cannot be learnt from 1 images"):
        train(images_of(np.random.default_rng(17), 1), WHITENED)


def test_whitening_is_learnt_from_a_bounded_number_of_images(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    images = images_of(np.random.default_rng(16), 40)
    monkeypatch.setattr("megloc_kapture.features.vlad._WHITENING_IMAGES", 6)
    described: list[str] = []

    def each(function: Any, items: Any) -> Any:
        described.extend(items)
        return map(function, items)

    def length(name: str) -> int:
        return len(images[name])

    vocabulary = train_vlad(sorted(images), length, images.__getitem__, WHITENED, each=each)
    assert vocabulary.size == 5
    assert described == ["000", "008", "016", "023", "031", "039"]


def vectors_of(rng: np.random.Generator, count: int, size: int) -> NDArray[np.float32]:
    """Around a mean far from zero, each axis of another deviation."""
    turn = scipy.linalg.qr(rng.normal(size=(size, size)))[0]
    rows = rng.normal(size=(count, size)) * np.linspace(2.0, 0.1, size)
    return (rows @ turn + 3.0).astype(np.float32)


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(("count", "size"), [(200, 12), (9, 40)])
def test_the_projection_is_the_eigenvectors_over_powers_of_the_deviations(
    count: int, size: int, power: float
) -> None:
    data = vectors_of(np.random.default_rng(1), count, size)
    covariance = np.cov(data.astype(np.float64).T, bias=True)
    variances, axes = scipy.linalg.eigh(covariance)
    whitening = learn_whitening(data.copy(), 5, power)
    again = learn_whitening(data.copy(), 5, power)
    assert whitening.projection.tobytes() == again.projection.tobytes()
    mirrored = learn_whitening(-data, 5, power).projection
    np.testing.assert_allclose(whitening.projection, mirrored, atol=1e-5)
    np.testing.assert_allclose(whitening.mean, data.mean(axis=0), atol=1e-5)
    assert whitening.projection.shape == (5, size)
    for row, variance, axis in zip(
        whitening.projection, variances[::-1], axes[:, ::-1].T, strict=False
    ):
        expected = axis / np.sqrt(variance) ** power
        expected *= np.sign(expected[np.abs(expected).argmax()])
        np.testing.assert_allclose(row, expected, atol=5e-4)


def test_vectors_are_of_unit_length_and_nothing_stays_nothing() -> None:
    data = vectors_of(np.random.default_rng(6), 20, 10)
    whitening = learn_whitening(data.copy(), 4)
    result = whitening.apply(data[0])
    assert result.dtype == np.float32 and result.shape == (4,)
    np.testing.assert_allclose(np.linalg.norm(result), 1.0, atol=1e-6)
    nothing = whitening.apply(np.zeros(10, np.float32))
    assert nothing.shape == (4,) and not nothing.any()
    assert not whitening.apply(whitening.mean).any()
    # no dimension without variance
    rng = np.random.default_rng(7)
    flat = (rng.normal(size=(30, 3)) @ rng.normal(size=(3, 20))).astype(np.float32)
    assert len(learn_whitening(flat, 20).projection) == 3
    for count in (1, 4):
        with pytest.raises(DataError, match=f"from {count} images with equal descriptors"):
            learn_whitening(np.ones((count, 8), np.float32), 3)


def test_parts_of_the_dimensions_are_taken_one_after_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = vectors_of(np.random.default_rng(8), 15, 25)
    whole = learn_whitening(data.copy(), 6)
    monkeypatch.setattr("megloc_kapture.features.vlad._COLUMNS", 4)
    parts = learn_whitening(data.copy(), 6)
    np.testing.assert_allclose(parts.projection, whole.projection, atol=1e-5)
