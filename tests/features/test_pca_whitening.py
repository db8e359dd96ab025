"""PCA whitening against scipy's eigenvectors, and known covariances."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.features.pca_whitening import learn_whitening


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
    np.testing.assert_allclose(whitening.mean, data.mean(axis=0), atol=1e-5)
    assert whitening.projection.shape == (5, size)
    for row, variance, axis in zip(
        whitening.projection, variances[::-1], axes[:, ::-1].T, strict=False
    ):
        expected = axis / np.sqrt(variance) ** power
        expected *= np.sign(expected[np.abs(expected).argmax()])
        np.testing.assert_allclose(row, expected, atol=5e-4)


@pytest.mark.slow
def test_many_vectors_are_white_afterwards() -> None:
    data = vectors_of(np.random.default_rng(4), 4000, 6)
    whitening = learn_whitening(data.copy(), 6)
    white = (data - whitening.mean) @ whitening.projection.T
    np.testing.assert_allclose(white.mean(axis=0), 0, atol=1e-3)
    np.testing.assert_allclose(np.cov(white.T), np.eye(6), atol=0.02)


def test_of_few_vectors_the_power_keeps_their_likeness() -> None:
    rng = np.random.default_rng(5)
    groups = np.repeat(rng.normal(size=(4, 300)), 3, axis=0)
    data = (groups + 0.5 * rng.normal(size=groups.shape)).astype(np.float32)
    same = np.kron(np.eye(4), np.ones((3, 3))) - np.eye(12) > 0
    other = ~same & ~np.eye(12, dtype=bool)
    alike = []
    for power in (0.5, 1.0):
        whitening = learn_whitening(data.copy(), 300, power)
        assert len(whitening.projection) == 11
        white = np.stack([whitening.apply(row) for row in data])
        alike.append(white @ white.T)
    assert alike[0][same].min() > 0.1 + alike[0][other].max()
    # as many dimensions as can be, each of the same deviation: the corners of a simplex
    np.testing.assert_allclose(alike[1][same | other], -1 / 11, atol=1e-4)


def test_vectors_are_of_unit_length_and_nothing_stays_nothing() -> None:
    data = vectors_of(np.random.default_rng(6), 20, 10)
    whitening = learn_whitening(data.copy(), 4)
    found = whitening.apply(data[0])
    assert found.dtype == np.float32 and found.shape == (4,)
    np.testing.assert_allclose(np.linalg.norm(found), 1.0, atol=1e-6)
    nothing = whitening.apply(np.zeros(10, np.float32))
    assert nothing.shape == (4,) and not nothing.any()
    assert not whitening.apply(whitening.mean).any()


def test_no_dimension_without_variance() -> None:
    rng = np.random.default_rng(7)
    flat = (rng.normal(size=(30, 3)) @ rng.normal(size=(3, 20))).astype(np.float32)
    assert len(learn_whitening(flat, 20).projection) == 3
    assert len(learn_whitening(vectors_of(rng, 6, 20), 20).projection) == 5


def test_parts_of_the_dimensions_are_taken_one_after_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = vectors_of(np.random.default_rng(8), 15, 25)
    whole = learn_whitening(data.copy(), 6)
    monkeypatch.setattr("megloc_kapture.features.pca_whitening._COLUMNS", 4)
    parts = learn_whitening(data.copy(), 6)
    np.testing.assert_allclose(parts.projection, whole.projection, atol=1e-5)


def test_learning_again_gives_the_same_bytes() -> None:
    data = vectors_of(np.random.default_rng(9), 15, 25)
    first, again = learn_whitening(data.copy(), 6), learn_whitening(data.copy(), 6)
    assert first.projection.tobytes() == again.projection.tobytes()


def test_the_sign_of_the_data_does_not_turn_the_axes() -> None:
    data = vectors_of(np.random.default_rng(10), 15, 25)
    first, mirrored = learn_whitening(data.copy(), 6), learn_whitening(-data, 6)
    np.testing.assert_allclose(first.projection, mirrored.projection, atol=1e-6)


@given(arrays(np.float32, (6, 5), elements=st.floats(-10, 10, width=16)))
@settings(max_examples=60)
def test_whatever_is_learnt_is_finite(data: NDArray[np.float32]) -> None:
    try:
        whitening = learn_whitening(data.copy(), 5)
    except DataError:
        assert np.ptp(data, axis=0).max() < 1e-3
        return
    assert np.isfinite(whitening.projection).all()
    for row in data:
        length = np.linalg.norm(whitening.apply(row))
        assert length == 0 or abs(length - 1) < 1e-5


@pytest.mark.parametrize("count", [1, 4])
def test_vectors_that_do_not_differ_are_refused(count: int) -> None:
    with pytest.raises(DataError, match=f"from {count} images that do not differ"):
        learn_whitening(np.ones((count, 8), np.float32), 3)
