"""Late fusion against kapture-localization's own code, and where the two differ, the difference."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.retrieval.fusion import FusionOptions, fuse

needs_kapture_localization = pytest.mark.skipif(
    importlib.util.find_spec("kapture_localization") is None,
    reason="kapture-localization is not installed (make test installs it)",
)
Matrices = list[NDArray[np.float64]]


def theirs(matrices: Matrices, method: str, **parameters: Any) -> NDArray[np.float64]:
    from kapture_localization.image_retrieval.fusion import LateFusionMethod, fuse_similarities

    with np.errstate(all="ignore"):
        fused: NDArray[np.float64] = fuse_similarities(
            matrices, LateFusionMethod(method), parameters
        )
    return fused


def random_similarities(
    least: float, features: int = 3, shape: tuple[int, int] = (7, 40)
) -> Matrices:
    rng = np.random.default_rng(features)
    return [rng.uniform(least, 1, shape) for _ in range(features)]


# ours, theirs, its parameters beside the weights, and the least similarity it is right for
OPERATORS: list[tuple[FusionOptions, str, dict[str, Any], float]] = [
    (FusionOptions(method="mean"), "mean", {}, -1.0),
    (FusionOptions(method="power"), "power", {}, 0.0),
    (FusionOptions(method="maximum"), "maximum", {}, -1.0),
    (FusionOptions(method="minimum"), "minimum", {}, -1.0),
    (FusionOptions(method="mean_and_power"), "mean_and_power", {"gamma": 0.5}, 0.0),
    (FusionOptions(method="mean_and_power", gamma=0.2), "mean_and_power", {"gamma": 0.2}, 0.0),
    (FusionOptions(method="min_and_max"), "min_and_max", {"min_weight": 2, "max_weight": 2}, -1.0),
    (
        FusionOptions(method="min_and_max", alpha=0.75),
        "min_and_max",
        {"min_weight": 3, "max_weight": 1},
        -1.0,
    ),
    (FusionOptions(method="villena_roman"), "villena_roman", {"alpha": 0.5}, 0.01),
    (FusionOptions(method="villena_roman", alpha=0.9), "villena_roman", {"alpha": 0.9}, 0.01),
    (FusionOptions(method="mean_and_min"), "mean_and_min", {"gamma": 0.5}, -1.0),
    (FusionOptions(method="mean_and_min", gamma=0.8), "mean_and_min", {"gamma": 0.8}, -1.0),
    (FusionOptions(method="harmonic_mean"), "harmonic_mean", {}, 0.01),
    (FusionOptions(method="ghm"), "generalized_harmonic_mean", {"gamma": 0.5}, -0.45),
    (FusionOptions(method="ghm", gamma=2.0), "generalized_harmonic_mean", {"gamma": 2.0}, -1.0),
    (FusionOptions(method="ghm", gamma=0.0), "generalized_harmonic_mean", {"gamma": 0.0}, 0.01),
]


@needs_kapture_localization
@pytest.mark.parametrize(("options", "method", "parameters", "least"), OPERATORS)
@pytest.mark.parametrize("features", [1, 2, 3])
@pytest.mark.parametrize("weighted", [False, True])
def test_operators_equal_kapture_localization_s(
    options: FusionOptions,
    method: str,
    parameters: dict[str, Any],
    least: float,
    features: int,
    weighted: bool,
) -> None:
    matrices = random_similarities(least, features)
    weights = [1.0, 3.0, 0.5][:features] if weighted else None
    expected = theirs(matrices, method, weights=weights, **parameters)
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(fuse(matrices, options, weights), expected, rtol=0, atol=1e-9)


def test_the_default_is_the_generalized_harmonic_mean() -> None:
    a, b = np.array([[0.8]]), np.array([[0.2]])
    expected = 1 / (0.5 / (0.5 + 0.75 * 0.8) + 0.5 / (0.5 + 0.25 * 0.2)) - 0.5
    np.testing.assert_allclose(fuse([a, b], FusionOptions(), [3, 1]), expected, rtol=1e-12)


# ---------------------------------------------------------------------------- the listed quirks


@needs_kapture_localization
def test_power_of_a_negative_similarity_is_zero_not_nan() -> None:
    matrices = [np.array([[-0.1, 0.5]]), np.array([[0.4, 0.5]])]
    assert np.isnan(theirs(matrices, "power", weights=None)[0, 0])
    fused = fuse(matrices, FusionOptions(method="power"))
    np.testing.assert_allclose(fused, [[0, 0.5]])
    both = fuse(matrices, FusionOptions(method="mean_and_power", gamma=0.5))
    np.testing.assert_allclose(both, [[0.5 * 0.15, 0.5]])


@needs_kapture_localization
def test_harmonic_means_have_no_pole() -> None:
    matrices = [np.array([[-0.30, -0.3001, 0.3, 0.0]]), np.array([[0.30, 0.3000, 0.3, 0.3]])]
    # reciprocals of opposite signs cancel: theirs is far beyond any similarity
    assert abs(theirs(matrices, "harmonic_mean", weights=None)[0, 1]) > 100
    fused = fuse(matrices, FusionOptions(method="harmonic_mean"))
    np.testing.assert_allclose(fused, [[0, 0, 0.15, 0]])


@needs_kapture_localization
def test_the_generalized_harmonic_mean_ends_at_minus_gamma() -> None:
    options = FusionOptions(method="ghm", gamma=0.2)
    first = np.array([[-1.0, -0.41, -0.4, -0.3999]])
    matrices = [first, np.full((1, 4), 0.5)]
    expected = theirs(matrices, "generalized_harmonic_mean", weights=None, gamma=0.2)
    assert expected[0, 1] < -0.2  # below the pole theirs falls as similarity grows
    fused = fuse(matrices, options)
    np.testing.assert_allclose(fused[0, :3], -0.2, atol=1e-12)
    np.testing.assert_allclose(fused[0, 3], expected[0, 3], atol=1e-9)
    # and it is continuous there
    assert -0.2 < fused[0, 3] < -0.1995


@needs_kapture_localization
def test_villena_roman_follows_the_code_not_the_help() -> None:
    least, largest = np.array([[0.2]]), np.array([[0.6]])
    options = FusionOptions(method="villena_roman", alpha=0.25)
    joint = 0.2**2 / (0.2 + 0.6)
    fused = fuse([least, largest], options)
    np.testing.assert_allclose(fused, 0.75 * 0.6 + 0.25 * joint)
    np.testing.assert_allclose(fused, theirs([least, largest], "villena_roman", alpha=0.25))
    assert abs(float(fused[0, 0]) - (0.75 * 0.2 + 0.25 * joint)) > 0.1  # what the help says


@needs_kapture_localization
def test_villena_roman_has_no_pole() -> None:
    matrices = [np.array([[-0.3, 0.0, -0.5]]), np.array([[0.3001, 0.0, -0.2]])]
    assert not np.abs(theirs(matrices, "villena_roman", alpha=0.5)).max() < 100
    fused = fuse(matrices, FusionOptions(method="villena_roman"))
    np.testing.assert_allclose(fused, [[0.15005, 0, 0]])


@needs_kapture_localization
@pytest.mark.parametrize("top_k", [1, 3, 10, 40])
def test_round_robin_is_kapture_localization_s(top_k: int) -> None:
    from kapture_localization.image_retrieval import fusion, pairing

    matrices = random_similarities(-1.0)
    queries = np.array([f"q{k}" for k in range(7)], dtype=object)
    images = np.array([f"m{k:02d}" for k in range(40)], dtype=object)
    ranked = [
        pairing.get_similarity_dict_from_similarity_matrix(matrix, queries, images)
        for matrix in matrices
    ]
    # without a number of images it fails: its default is a type
    with pytest.raises(TypeError):
        fusion.round_robin_from_similarity_dicts(ranked)
    expected: dict[str, list[str]] = {}
    for query, image, _ in fusion.round_robin_from_similarity_dicts(ranked, top_k):
        expected.setdefault(query, []).append(image)
    fused = fuse(matrices, FusionOptions(method="round_robin"))
    order = np.argsort(-fused, axis=1, kind="stable")[:, :top_k]
    assert {q: images[row].tolist() for q, row in zip(queries, order, strict=True)} == expected


@needs_kapture_localization
def test_a_zero_descriptor_is_similar_to_nothing() -> None:
    from kapture_localization.image_retrieval import pairing

    class Config:
        dsize, dtype = 2, np.float64

    zero = np.zeros((1, 2))
    with pytest.MonkeyPatch.context() as patch, np.errstate(invalid="ignore"):
        patch.setattr(pairing, "image_global_features_from_file", lambda *_: zero)
        stacked = pairing.stack_global_features(Config(), [("a", "a")])
    assert np.isnan(stacked.stacked_features).all()
    # with the zero row that ours has, its similarity is 0, and every operator takes it
    for options, *_ in OPERATORS:
        fused = fuse([np.array([[0.0, 0.0]]), np.array([[0.0, 0.9]])], options)
        assert np.isfinite(fused).all() and fused[0, 0] <= fused[0, 1]


# ------------------------------------------------------------------------------- what must hold


ALL = [options for options, *_ in OPERATORS if options.method != "villena_roman"]


@given(st.integers(0, 2**32 - 1), st.sampled_from(ALL))
def test_more_similar_is_never_worse(seed: int, options: FusionOptions) -> None:
    rng = np.random.default_rng(seed)
    matrices = [rng.uniform(-1, 1, (1, 8)) for _ in range(3)]
    better = [matrix + rng.uniform(0, 0.5, matrix.shape) for matrix in matrices]
    weights = rng.uniform(0.1, 3, 3).tolist()
    assert (fuse(better, options, weights) >= fuse(matrices, options, weights) - 1e-12).all()


@given(st.integers(0, 2**32 - 1), st.sampled_from([options for options, *_ in OPERATORS]))
def test_features_have_no_order_and_every_value_is_finite(
    seed: int, options: FusionOptions
) -> None:
    rng = np.random.default_rng(seed)
    matrices = [rng.uniform(-1, 1, (2, 8)).round(1) for _ in range(3)]
    weights = rng.uniform(0.1, 3, 3).tolist()
    fused = fuse(matrices, options, weights)
    assert np.isfinite(fused).all()
    np.testing.assert_allclose(fuse(matrices[::-1], options, weights[::-1]), fused, atol=1e-12)


@pytest.mark.parametrize("options", [options for options, *_ in OPERATORS])
def test_float32_stays_float32_and_nothing_is_changed(options: FusionOptions) -> None:
    matrices: Any = [matrix.astype(np.float32) for matrix in random_similarities(-1)]
    before = [matrix.copy() for matrix in matrices]
    assert fuse(matrices, options).dtype == np.float32
    np.testing.assert_array_equal(matrices, before)


def test_ranks_as_scores() -> None:
    a, b = np.array([[0.9, 0.5, 0.1]]), np.array([[0.2, 0.8, 0.2]])  # b ties: database order
    order: Callable[[str], list[int]] = lambda method: np.argsort(  # noqa: E731
        -fuse([a, b], FusionOptions.model_validate({"method": method})), kind="stable"
    )[0].tolist()
    assert order("round_robin") == [0, 1, 2]
    reciprocal = fuse([a, b], FusionOptions(method="reciprocal_rank"))
    expected = [1 / 61 + 1 / 62, 1 / 62 + 1 / 61, 1 / 63 + 1 / 63]
    np.testing.assert_allclose(reciprocal, np.array([expected]) / 2)
    np.testing.assert_allclose(
        fuse([a, b], FusionOptions(method="borda"), [3, 1]), [[2.75, 2.25, 1]]
    )


@pytest.mark.parametrize("weights", [[1.0], [1.0, 0.0], [1.0, -1.0], [1.0, np.nan], [[1.0, 1.0]]])
def test_weights_that_cannot_be_used_are_refused(weights: Any) -> None:
    with pytest.raises(OptionError, match="weights"):
        fuse(random_similarities(0, 2), FusionOptions(), weights)


def test_what_cannot_be_fused_is_refused() -> None:
    with pytest.raises(OptionError, match="0 global features"):
        fuse([], FusionOptions())
    with pytest.raises(DataError, match="different shapes"):
        fuse([np.zeros((1, 2)), np.zeros((2, 1))], FusionOptions())
    with pytest.raises(ValidationError, match="gamma is a share"):
        FusionOptions(method="mean_and_min", gamma=1.5)
