"""Late fusion against kapture-localization's own code, and where the two differ, the difference."""

from __future__ import annotations

import importlib.util
from collections import defaultdict
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.retrieval.fusion import (
    DiversityOptions,
    FusionOptions,
    concatenate,
    diversify,
    fuse,
    fuse_rankings,
    greedy_coverage,
)
from megloc_kapture.retrieval.search import ConcatenatedBlocks, FusedSearch

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
    (FusionOptions(method=ours, **given), theirs or ours, parameters, least)
    for ours, given, theirs, parameters, least in (
        ("mean", {}, "", {}, -1.0),
        ("power", {}, "", {}, 0.0),
        ("maximum", {}, "", {}, -1.0),
        ("minimum", {}, "", {}, -1.0),
        ("mean_and_power", {}, "", {"gamma": 0.5}, 0.0),
        ("mean_and_power", {"gamma": 0.2}, "", {"gamma": 0.2}, 0.0),
        ("min_and_max", {}, "", {"min_weight": 2, "max_weight": 2}, -1.0),
        ("min_and_max", {"alpha": 0.75}, "", {"min_weight": 3, "max_weight": 1}, -1.0),
        ("villena_roman", {}, "", {"alpha": 0.5}, 0.01),
        ("villena_roman", {"alpha": 0.9}, "", {"alpha": 0.9}, 0.01),
        ("mean_and_min", {}, "", {"gamma": 0.5}, -1.0),
        ("mean_and_min", {"gamma": 0.8}, "", {"gamma": 0.8}, -1.0),
        ("harmonic_mean", {}, "", {}, 0.01),
        ("ghm", {}, "generalized_harmonic_mean", {"gamma": 0.5}, -0.45),
        ("ghm", {"gamma": 2.0}, "generalized_harmonic_mean", {"gamma": 2.0}, -1.0),
        ("ghm", {"gamma": 0.0}, "generalized_harmonic_mean", {"gamma": 0.0}, 0.01),
    )
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


@needs_kapture_localization
@pytest.mark.parametrize(
    ("method", "first", "second", "expected"),
    [
        ("power", [-0.1, 0.5], [0.4, 0.5], [0, 0.5]),
        # reciprocals of opposite signs cancel
        ("harmonic_mean", [-0.3, -0.3001, 0.3, 0], [0.3, 0.3, 0.3, 0.3], [0, 0, 0.15, 0]),
        ("villena_roman", [-0.3, 0, -0.5], [0.3001, 0, -0.2], [0.15005, 0, 0]),
    ],
)
def test_where_theirs_is_no_number_or_no_similarity(
    method: Any, first: list[float], second: list[float], expected: list[float]
) -> None:
    matrices = [np.array([first]), np.array([second])]
    parameters = {"alpha": 0.5} if method == "villena_roman" else {"weights": None}
    assert not np.abs(theirs(matrices, method, **parameters)).max() < 100
    np.testing.assert_allclose(fuse(matrices, FusionOptions(method=method)), [expected])


@needs_kapture_localization
def test_the_generalized_harmonic_mean_ends_at_minus_gamma() -> None:
    matrices = [np.array([[-1.0, -0.41, -0.4, -0.3999]]), np.full((1, 4), 0.5)]
    expected = theirs(matrices, "generalized_harmonic_mean", weights=None, gamma=0.2)
    assert expected[0, 1] < -0.2  # below the pole theirs falls as similarity grows
    fused = fuse(matrices, FusionOptions(method="ghm", gamma=0.2))
    np.testing.assert_allclose(fused[0, :3], -0.2, atol=1e-12)
    np.testing.assert_allclose(fused[0, 3], expected[0, 3], atol=1e-9)
    # and it is continuous there
    assert -0.2 < fused[0, 3] < -0.1995


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
    lists = [np.argsort(-matrix, axis=1, kind="stable") for matrix in matrices]
    order, _ = fuse_rankings(lists, top_k, FusionOptions(method="round_robin"))
    assert {q: images[row].tolist() for q, row in zip(queries, order, strict=True)} == expected


def test_a_zero_descriptor_is_similar_to_nothing() -> None:
    # theirs divides by its length, which is none
    for options, *_ in OPERATORS:
        fused = fuse([np.array([[0.0, 0.0]]), np.array([[0.0, 0.9]])], options)
        assert np.isfinite(fused).all() and fused[0, 0] <= fused[0, 1]


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
    matrices: Any = [rng.uniform(-1, 1, (2, 8)).round(1) for _ in range(3)]
    weights = rng.uniform(0.1, 3, 3).tolist()
    fused = fuse(matrices, options, weights)
    assert np.isfinite(fused).all()
    np.testing.assert_allclose(fuse(matrices[::-1], options, weights[::-1]), fused, atol=1e-12)
    # float32 stays float32, and nothing is changed
    single = [matrix.astype(np.float32) for matrix in matrices]
    assert fuse(single, options).dtype == np.float32
    np.testing.assert_array_equal(single, np.float32(matrices))


def test_ranks_as_scores() -> None:
    lists = [ids(0, 1, 2)[None], ids(1, 0, 2)[None]]
    turns, _ = fuse_rankings(lists, 3, FusionOptions(method="round_robin"))
    assert turns.tolist() == [[0, 1, 2]]
    _, reciprocal = fuse_rankings(lists, 3, FusionOptions(method="reciprocal_rank"))
    expected = [1 / 61 + 1 / 62, 1 / 62 + 1 / 61, 1 / 63 + 1 / 63]
    np.testing.assert_allclose(reciprocal, np.array([expected]) / 2, rtol=1e-6)
    order, borda = fuse_rankings(lists, 3, FusionOptions(method="borda"), [3, 1])
    assert order.tolist() == [[0, 1, 2]]
    np.testing.assert_allclose(borda, [[2.75, 2.25, 1]])


def test_what_cannot_be_fused_is_refused() -> None:
    same, more = [np.zeros((2, 4), np.float32)] * 2, np.zeros((3, 4))
    for weights in ([1.0], [1.0, 0.0], [1.0, -1.0], [1.0, np.nan], [[1.0, 1.0]]):
        for weighted in (partial(fuse, same, FusionOptions()), partial(ConcatenatedBlocks, same)):
            with pytest.raises(OptionError, match="weights"):
                weighted(weights)
    for function in (partial(fuse, [], FusionOptions()), partial(concatenate, [])):
        with pytest.raises(OptionError, match="0 global features"):
            function()
    with pytest.raises(DataError, match="different shapes"):
        fuse([*same, more], FusionOptions())
    with pytest.raises(DataError, match="2, 3 images"):
        concatenate([same[0], more])
    with pytest.raises(DataError, match=r"\[2, 3\] rows"):
        ConcatenatedBlocks([same[0], more])
    with pytest.raises(ValidationError, match="gamma is a share"):
        FusionOptions(method="mean_and_min", gamma=1.5)
    for method in ("round_robin", "borda", "reciprocal_rank"):
        options = FusionOptions.model_validate({"method": method})
        with pytest.raises(OptionError):
            fuse_rankings([], 3, options)
        with pytest.raises(DataError, match="shapes"):
            fuse_rankings([ids(0, 1)[None], np.zeros((2, 2), np.int64)], 3, options)


def unit(seed: int, count: int, dimension: int) -> NDArray[np.float32]:
    rows = np.random.default_rng(seed).normal(size=(count, dimension))
    return (rows / np.linalg.norm(rows, axis=1)[:, None]).astype(np.float32)


@pytest.mark.parametrize("weights", [None, [1.0, 1.0, 1.0], [5.0, 1.0, 0.25]])
def test_the_inner_product_is_the_weighted_mean_of_cosines(weights: list[float] | None) -> None:
    a = [unit(k, 6, 3 + k) for k in range(3)]
    b = [unit(k + 10, 9, 3 + k) for k in range(3)]
    cosines = [x.astype(np.float64) @ y.T.astype(np.float64) for x, y in zip(a, b, strict=True)]
    fused = concatenate(a, weights)
    assert fused.shape == (6, 12) and fused.dtype == np.float32
    expected = np.average(cosines, axis=0, weights=weights)
    np.testing.assert_allclose(fused @ concatenate(b, weights).T, expected, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(fused, axis=1), 1, atol=1e-6)


def test_a_feature_of_zeros_takes_its_share_away() -> None:
    a, b = unit(0, 1, 4), unit(1, 1, 5)
    with_zero = concatenate([a, np.zeros((1, 5), dtype=np.float32)], [3, 1])
    np.testing.assert_allclose(with_zero @ concatenate([a, b], [3, 1]).T, 0.75, atol=1e-6)


def test_blocks_of_several_features_rank_as_the_mean_does() -> None:
    queries, database = [unit(1, 20, 16), unit(2, 20, 8)], [unit(3, 300, 16), unit(4, 300, 8)]
    blocks = ConcatenatedBlocks(database, [2, 1])
    assert len(blocks) == 300 and blocks.dimension == 24
    alone = FusedSearch(10, FusionOptions())
    (early,) = alone.lists([concatenate(queries, [2, 1])], [blocks])
    search = FusedSearch(10, FusionOptions(method="mean"), [2, 1])
    late = search.ranking([search.lists(queries, database)])
    np.testing.assert_array_equal(early[0], late[0])
    np.testing.assert_allclose(early[1], late[1], atol=1e-6)


@st.composite
def ranked_lists(draw: st.DrawFn) -> list[NDArray[np.int64]]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    queries, lists = draw(st.integers(0, 4)), []
    for _ in range(draw(st.integers(1, 4))):
        length = draw(st.integers(0, 8))
        ranked = np.full((queries, length), -1, dtype=np.int64)
        for row in ranked:
            there = rng.integers(0, length + 1)
            row[:there] = rng.permutation(10)[:there]
        lists.append(ranked)
    return lists


def naive_round_robin(lists: list[list[int]], top_k: int) -> list[int]:
    taken: list[int] = []
    for turn in range(max(map(len, lists), default=0)):
        for ranked in lists:
            if turn < len(ranked) and ranked[turn] >= 0 and ranked[turn] not in taken:
                taken.append(ranked[turn])
    return (taken + [-1] * top_k)[:top_k]


@given(ranked_lists(), st.integers(0, 12))
def test_round_robin(lists: list[NDArray[np.int64]], top_k: int) -> None:
    indices, scores = fuse_rankings(lists, top_k, FusionOptions(method="round_robin"))
    assert indices.shape == scores.shape == (len(lists[0]), top_k)
    for row in range(len(lists[0])):
        expected = naive_round_robin([ranked[row].tolist() for ranked in lists], top_k)
        assert indices[row].tolist() == expected
        points = [float(top_k - k) if i >= 0 else -np.inf for k, i in enumerate(expected)]
        assert scores[row].tolist() == points


@given(ranked_lists(), st.integers(1, 12), st.booleans())
def test_points_add_up(lists: list[NDArray[np.int64]], top_k: int, reciprocal: bool) -> None:
    weights = [float(k + 1) for k in range(len(lists))]
    longest = max(ranked.shape[1] for ranked in lists)
    method = FusionOptions(method="reciprocal_rank" if reciprocal else "borda", rank_constant=7)
    fused = fuse_rankings(lists, top_k, method, weights)
    for row in range(len(lists[0])):
        points: defaultdict[int, float] = defaultdict(float)
        for ranked, weight in zip(lists, weights, strict=True):
            for rank, image in enumerate(ranked[row].tolist()):
                if image >= 0:
                    point = 1 / (7 + rank + 1) if reciprocal else longest - rank
                    points[image] += weight / sum(weights) * point
        best = sorted(points, key=lambda image: (-round(points[image], 12), image))[:top_k]
        found = [image for image in fused[0][row].tolist() if image >= 0]
        assert len(found) == len(best)
        # of equal sums the order may hang on rounding: points are compared, not images
        np.testing.assert_allclose([points[i] for i in found], [points[i] for i in best])
        np.testing.assert_allclose(fused[1][row, : len(best)], [points[i] for i in best], rtol=1e-6)


def test_equal_sums_keep_the_order_of_the_images() -> None:
    lists = [np.array([[5, 3, 9]]), np.array([[3, 5, 7]])]
    reciprocal = FusionOptions(method="reciprocal_rank")
    for options in (reciprocal, FusionOptions(method="borda")):
        assert fuse_rankings(lists, 4, options)[0].tolist() == [[3, 5, 7, 9]]
    # the paper's constant is the default
    _, scores = fuse_rankings([np.array([[4]]), np.array([[4]])], 1, reciprocal)
    np.testing.assert_allclose(scores, 1 / 61, rtol=1e-6)


def ids(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.int64)


def test_a_neighbour_of_the_best_makes_way_for_what_adds_more() -> None:
    images = [ids(0, 1, 2, 3), ids(0, 1, 2), ids(7, 8), ids()]
    assert greedy_coverage(images, 2) == ([0, 2], [4, 2])
    # what adds nothing comes in order of its matches, and of its place
    assert greedy_coverage(images, 9) == ([0, 2, 1, 3], [4, 2, 0, 0])
    assert greedy_coverage([ids(), ids()], 9) == ([0, 1], [0, 0])
    assert greedy_coverage([], 3) == ([], [])


@settings(deadline=None, max_examples=60)
@given(st.lists(st.sets(st.integers(0, 12)), max_size=6), st.integers(1, 4))
def test_it_is_never_far_from_the_best(sets: list[set[int]], keep: int) -> None:
    order, added = greedy_coverage([ids(*sorted(one)) for one in sets], keep)
    assert len(order) == len(set(order)) == min(keep, len(sets))
    covered = set().union(*(sets[at] for at in order))
    assert sum(added) == len(covered)
    best = max(
        (len(set().union(*some)) for some in combinations(sets, min(keep, len(sets)))), default=0
    )
    assert len(covered) >= (1 - 1 / np.e) * best
    assert sorted(added, reverse=True) == added


@pytest.mark.parametrize(
    ("places", "turned", "most", "top_k", "expected"),
    [
        ([0, 0.1, 0.2, 9, 9.1], [], 2, 4, [0, 1, 3, 4]),
        ([0, 0.1, 0.2, 9, 9.1], [], 2, 3, [0, 1, 3]),
        ([0, 0, 0, 0], [], 1, 3, [0, 1, 2]),  # what was passed over fills the rest
        ([0, 0, 0], [2], 1, 2, [0, 2]),  # who looks elsewhere is in another place
    ],
)
def test_near_duplicates_make_way_for_other_places(
    places: list[float], turned: list[int], most: int, top_k: int, expected: list[int]
) -> None:
    centers = np.multiply.outer(places, [1.0, 0.0, 0.0])
    directions = np.tile([0.0, 0.0, 1.0], (len(places), 1))
    directions[turned] = [1.0, 0.0, 0.0]
    options = DiversityOptions(max_per_place=most, radius=1.0, angle_deg=45)
    found = diversify(np.arange(len(places)), centers, directions, top_k, options)
    assert found.tolist() == expected


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 3), st.floats(0.1, 3))
def test_diversity_against_its_definition(seed: int, top_k: int, most: int, radius: float) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 15))
    centers, ranking = rng.uniform(0, 4, (count, 3)), rng.permutation(count)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    options = DiversityOptions(max_per_place=most, radius=radius, angle_deg=60)
    found = diversify(ranking, centers, directions, top_k, options).tolist()
    distances = np.linalg.norm(centers[ranking, None] - centers[ranking], axis=2)
    angles = np.rad2deg(np.arccos(np.clip(directions @ directions.T, -1, 1)))
    near = (distances <= radius) & (angles[np.ix_(ranking, ranking)] <= 60)
    kept: list[int] = []
    for position in range(count):
        if len(kept) < top_k and near[position, kept].sum() < most:
            kept.append(position)
    rest = [position for position in range(count) if position not in kept]
    assert found == (kept + rest)[:top_k]
