"""Pairs of the small scene against rankings made by hand, and their stored matches."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError, OptionError, PluginError
from megloc_kapture.io.dataset_tables import ImageGroup, SideTables
from megloc_kapture.io.kapture import (
    ImagePair,
    KaptureFolder,
    MatchesWriter,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.tables import PairCount, read_match_counts, write_match_counts
from megloc_kapture.mapping import pairs as pairs_module
from megloc_kapture.matching.nearest_neighbours import NearestNeighbours, match_nearest
from megloc_kapture.matching.verification import KnownPoseOptions, TwoViewOptions
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.retrieval.search import FusionOptions
from megloc_kapture.stages.image_pairs import (
    MappingPairsOptions,
    QueryPairsOptions,
    Retrieval,
    pair_map_images,
    pair_queries,
    vectors_of,
)
from megloc_kapture.stages.matches import (
    SecondMatchingOptions,
    VerifiedMatches,
    candidates_of,
    check_given_poses,
    match_all,
    match_pairs,
    pairs_to_rematch,
)
from megloc_kapture.stages.reranking import RerankingOptions, counted, rerank, reranked
from megloc_kapture.values import ImageFeatures

VECTORS = {
    # two copies, one near them, one across, one opposite
    "left/0.png": [1.0, 0.0, 0.0],
    "left/1.png": [2.0, 0.0, 0.0],
    "right/2.png": [0.9, 0.1, 0.0],
    "right/3.png": [0.0, 0.0, 3.0],
    "right/4.png": [-1.0, 0.0, 0.1],
    "query/a.png": [1.0, 0.1, 0.0],
    "query/b.png": [0.0, 0.2, 1.0],
}


def similarity(image: str, other: str) -> float:
    a, b = np.array(VECTORS[image]), np.array(VECTORS[other])
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


Folders = tuple[KaptureFolder, KaptureFolder]
BY_TOY = Retrieval(("toy",))


@pytest.fixture
def folders(world: Any, write_features: Any, tmp_path: Path) -> Folders:
    """Map and queries with the vectors above, of another length than one."""
    vectors = {image: np.array(vector, np.float32) for image, vector in VECTORS.items()}
    write_features(tmp_path, "global_features", "toy", vectors)
    return world.mapping().with_features([tmp_path]), world.query().with_features([tmp_path])


def paired(folder: KaptureFolder, covisible: KaptureFolder | None = None, **options: Any) -> Any:
    chosen = MappingPairsOptions.model_validate(options)
    return pair_map_images(folder, chosen, retrieval=BY_TOY, covisible=covisible)


def names(pairs: list[Any]) -> list[tuple[str, str]]:
    return [(pair.query, pair.map) for pair in pairs]


@pytest.mark.parametrize("top_k", [2, 30])
def test_map_pairs_by_retrieval(world: Any, folders: Folders, top_k: int) -> None:
    images = sorted(world.map_poses)
    expected = {}
    for image in images:
        others = sorted(set(images) - {image}, key=lambda other: (-similarity(image, other), other))
        for other in others[:top_k]:
            pair = min(image, other), max(image, other)
            expected[pair] = similarity(*pair)
    found = paired(folders[0], top_k=top_k)
    assert names(found) == sorted(expected)
    np.testing.assert_allclose(
        [p.score for p in found], [expected[k] for k in sorted(expected)], atol=1e-6
    )
    assert ("left/0.png", "left/1.png") in expected  # copies of each other


def test_methods_are_combined_and_retrieval_gives_the_score(folders: Folders) -> None:
    found = paired(folders[0], by=("exhaustive", "retrieval"), top_k=1)
    assert names(found) == list(combinations(sorted(VECTORS)[:2] + sorted(VECTORS)[4:], 2))
    scores = {(pair.query, pair.map): pair.score for pair in found}
    assert scores["left/0.png", "left/1.png"] == pytest.approx(1.0, abs=1e-6)
    expected = similarity("left/0.png", "right/2.png")
    assert scores["left/0.png", "right/2.png"] == pytest.approx(expected, abs=1e-6)
    assert scores["left/0.png", "right/4.png"] == 1.0  # retrieval does not name it


def test_map_pairs_by_covisibility_count_points_of_all_types(
    world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = world.map().observations()["rootsift"]
    halves = {
        name: replace(
            whole,
            point_ids=whole.point_ids[rows],
            image_ids=whole.image_ids[rows],
            keypoint_ids=whole.keypoint_ids[rows],
        )
        for name, rows in (("a", whole.point_ids % 2 == 0), ("b", whole.point_ids % 2 == 1))
    }
    write_sensors(tmp_path, world.map().read())
    write_points3d(tmp_path, world.map().points3d())
    write_observations(tmp_path, halves)
    # more than an image pair shares in one of the halves
    monkeypatch.setattr(pairs_module, "_MIN_SHARED_POINTS", 500)
    of_halves, of_whole = (
        paired(folder, by=("covisibility",)) for folder in (KaptureFolder(tmp_path), world.map())
    )
    assert of_halves == of_whole != []


def test_map_pairs_by_sequence_follow_the_times_of_a_camera(world: Any, tmp_path: Path) -> None:
    data, images = world.mapping().read(), sorted(world.map_poses)
    times = dict(zip(images, (0, 1, 5, 1, 3), strict=True))
    data.sensors["other"] = data.sensors["cam"]
    data.records_camera = {
        (time, "other" if image.startswith("right") else "cam"): image
        for image, time in times.items()
    }
    data.trajectories = {key: world.map_poses[image] for key, image in data.records_camera.items()}
    write_sensors(tmp_path, data)
    found = paired(KaptureFolder(tmp_path), by=("sequence",), sequence={"window": 1})
    right = [("right/2.png", "right/4.png"), ("right/3.png", "right/4.png")]
    assert names(found) == [("left/0.png", "left/1.png"), *right]


FRAMES = SideTables(
    groups={
        image: ImageGroup(frame="a" if k % 2 else "b") for k, image in enumerate(sorted(VECTORS))
    }
)


@pytest.mark.parametrize(
    "by", [("exhaustive",), ("poses",), ("retrieval",), ("sequence",), ("covisibility",)]
)
def test_frames_never_mix(world: Any, folders: Folders, by: Any) -> None:
    found = pair_map_images(
        folders[0],
        MappingPairsOptions(by=by, covisibility={"top_k": 1}),
        retrieval=BY_TOY,
        tables=FRAMES,
        covisible=world.map(),
    )
    images = sorted(world.map_poses)
    within = [pair for pair in combinations(images, 2) if len({*map(FRAMES.frame, pair)}) == 1]
    assert 0 < len(within) < 10
    assert set(names(found)) <= set(within)
    # the best image of the same frame is paired although the other frame has a better match
    assert {image for pair in names(found) for image in pair} == set(images)


def test_query_pairs_are_sorted_by_similarity(folders: Folders) -> None:
    found = pair_queries(*folders, QueryPairsOptions(top_k=3), retrieval=BY_TOY)
    assert names(found) == [
        ("query/a.png", "right/2.png"),
        ("query/a.png", "left/0.png"),  # equal to its copy: the order of names
        ("query/a.png", "left/1.png"),
        ("query/b.png", "right/3.png"),
        ("query/b.png", "right/4.png"),
        ("query/b.png", "right/2.png"),
    ]
    expected = [similarity(p.query, p.map) for p in found]
    np.testing.assert_allclose([pair.score for pair in found], expected, atol=1e-6)
    everything = pair_queries(*folders, QueryPairsOptions(by="exhaustive"), retrieval=None)
    queries, images = (sorted(folder.read().image_names()) for folder in reversed(folders))
    assert names(everything) == list(product(queries, images))


def test_images_without_global_features_are_named(world: Any) -> None:
    reader = world.mapping().global_features("vlad_rootsift")
    with pytest.raises(DataError, match=r"2 images have no .* vlad_rootsift, the first is x\.png"):
        vectors_of([reader], ["left/0.png", "x.png", "y.png"])
    with pytest.raises(DataError, match="need global features"):
        pair_map_images(world.mapping(), MappingPairsOptions(), retrieval=None)
    with pytest.raises(DataError, match="needs global features"):
        pair_queries(world.mapping(), world.query(), QueryPairsOptions(), retrieval=None)


PAIRS = [
    *(ImagePair("q1", image, 0.9 - 0.1 * rank) for rank, image in enumerate("zyxw")),
    *(ImagePair("q2", image, 0.3 - 0.1 * rank) for rank, image in enumerate("xy")),
]


def write_matches(root: Path, counts: dict[tuple[str, str], tuple[int, int]], name: str) -> None:
    table = []
    writer = MatchesWriter(root, name, orphan=True)
    for (image, other), (found, verified) in counts.items():
        rows = np.stack([np.arange(verified)] * 2, axis=1)
        writer.write(image, other, rows, np.ones(verified))
        table.append(PairCount(image, other, found, verified))
    write_match_counts(root, name, table)


def run(root: Path, names: str, by: Any, keep: int) -> dict[str, list[tuple[str, int]]]:
    query = KaptureFolder(root, features_dirs=[root])
    found = reranked(PAIRS, query, root, list(names), RerankingOptions(by=by, keep=keep))
    return {q: [(p.map, int(p.score)) for p in found if p.query == q] for q in ("q1", "q2")}


def test_candidates_are_ranked_by_their_matches(tmp_path: Path) -> None:
    counts = {("q1", "w"): (40, 30), ("q1", "y"): (50, 10), ("q2", "y"): (4, 4)}
    write_matches(tmp_path, counts, "a")
    assert run(tmp_path, "a", "verified", 3) == {
        "q1": [("w", 30), ("y", 10), ("z", 0)],
        "q2": [("y", 4), ("x", 0)],
    }
    matches = run(tmp_path, "a", "matches", 2)
    assert matches == {"q1": [("y", 50), ("w", 40)], "q2": [("y", 4), ("x", 0)]}
    # of equal counts retrieval's order stays, and types are added
    write_matches(tmp_path, {("q1", "x"): (7, 7), ("q1", "z"): (7, 7)}, "b")
    equal = run(tmp_path, "b", "verified", 4)
    assert equal == {"q1": [("z", 7), ("x", 7), ("y", 0), ("w", 0)], "q2": [("x", 0), ("y", 0)]}
    assert run(tmp_path, "ab", "matches", 3)["q1"] == [("y", 50), ("w", 40), ("z", 7)]
    # reranking is off by default
    assert reranked(PAIRS, KaptureFolder("none"), Path("none"), ["a"], RerankingOptions()) == PAIRS
    with pytest.raises(DataError, match=r"match_counts\.csv"):
        run(tmp_path, "n", "verified", 1)


def test_one_local_type_can_be_chosen_for_reranking(tmp_path: Path) -> None:
    write_matches(tmp_path, {("q1", "w"): (9, 9), ("q1", "y"): (1, 1)}, "superpoint-mine")
    write_matches(tmp_path, {("q1", "y"): (30, 20), ("q1", "z"): (3, 3)}, "aslfeat")
    query, types = KaptureFolder(tmp_path, features_dirs=[tmp_path]), ["superpoint-mine", "aslfeat"]
    first = {None: "y", "aslfeat": "y", "superpoint": "w", "superpoint-mine": "w"}
    for name, image in first.items():
        options = RerankingOptions(by="verified", local_type=name)
        assert reranked(PAIRS, query, tmp_path, types, options)[0].map == image
    for name in ("superpint", "super"):
        unknown = RerankingOptions(by="verified", local_type=name)
        message = rf"reranking\.local_type: no local features of type '{name}'; "
        with pytest.raises(OptionError, match=message):
            reranked(PAIRS, query, tmp_path, types, unknown)


def test_coverage_counts_each_keypoint_once(tmp_path: Path) -> None:
    matched = {"z": [0, 1, 2, 3], "y": [0, 1, 2], "x": [5, 6, 5], "w": []}
    writer = MatchesWriter(tmp_path, "a", orphan=True)
    for image, rows in matched.items():
        both = np.stack([rows, np.arange(len(rows))], axis=1).astype(np.int64)
        writer.write("q1", image, both, np.ones(len(rows)))
    assert run(tmp_path, "a", "coverage", 3)["q1"] == [("z", 4), ("x", 2), ("y", 0)]
    pair = VerifiedMatches(np.array([[3, 0], [5, 1]]), np.ones(2, np.float32), num_found=9)
    assert (counted(pair, "matches"), counted(pair, "verified")) == (9, 2)
    assert np.asarray(counted(pair, "coverage")).tolist() == [3, 5]
    # row 1 of one type is another keypoint than row 1 of the other type
    of_types = [[np.array([2]), np.array([1])], [np.array([1, 2]), np.array([1, 3])]]
    options = RerankingOptions(by="coverage", keep=2)
    assert rerank(of_types, options) == ([0, 1], [3, 2])


def test_several_global_features_are_fused_with_their_weights(
    world: Any, folders: Folders, write_features: Any, tmp_path: Path
) -> None:
    # of the other feature, all images but the second are across the queries
    across, along = np.array([0.0, 1.0], np.float32), np.array([1.0, 0.0], np.float32)
    other = {image: across for image in world.map_poses} | dict.fromkeys(world.query_poses, along)
    write_features(tmp_path, "global_features", "other", {**other, "left/1.png": along})
    retrieval = Retrieval(("toy", "other"), (1.0, 3.0), FusionOptions(method="mean"))
    first, *_, last = pair_queries(*folders, QueryPairsOptions(top_k=2), retrieval=retrieval)
    assert names([first, last]) == [("query/a.png", "left/1.png"), ("query/b.png", "right/3.png")]
    assert first.score == pytest.approx(0.25 * similarity("query/a.png", "left/1.png") + 0.75)
    assert last.score == pytest.approx(0.25 * similarity("query/b.png", "right/3.png"))


def all_pairs(first: list[str], second: list[str]) -> list[ImagePair]:
    return [ImagePair(a, b, 1.0) for a in first for b in second if a < b or second is not first]


def match_queries(world: Any, verification: Any, output: Path) -> None:
    folders, nearest = (world.query(), world.mapping()), NearestNeighbours()
    pairs = all_pairs(sorted(world.query_poses), sorted(world.map_poses))
    with single_threaded():
        match_pairs(*folders, pairs, "rootsift", nearest, verification, output)


def test_all_matches_or_verified_matches_are_stored(world: Any, tmp_path: Path) -> None:
    match_queries(world, None, tmp_path / "all")
    match_queries(world, TwoViewOptions(), tmp_path / "verified")
    everything, verified = (
        world.mapping().with_features([tmp_path / name]).matches("rootsift")
        for name in ("all", "verified")
    )
    query, image = "query/a.png", "right/2.png"
    with single_threaded():
        matches, scores = match_nearest(
            world.query().descriptors("rootsift").read(query),
            world.mapping().descriptors("rootsift").read(image),
        )
    stored, stored_scores = everything.read(query, image)
    np.testing.assert_array_equal(stored, matches)
    np.testing.assert_allclose(stored_scores, scores)
    swapped, _ = everything.read(image, query)  # stored with the smaller name first
    np.testing.assert_array_equal(swapped, matches[:, ::-1])
    # the table counts the matches of each pair before and after verification
    counts = read_match_counts(tmp_path / "verified", "rootsift").values()
    for count in counts:
        assert count.verified == len(verified.read(count.image, count.other)[0])
        assert count.matches == len(everything.read(count.image, count.other)[0])
    assert any(count.verified < count.matches for count in counts)


def test_pairs_without_matches_are_stored_and_images_matched_once_and_not_with_themselves(
    world: Any, write_features: Any, tmp_path: Path
) -> None:
    empty, full = ("left/0.png", "left/1.png"), ("left/0.png", "right/2.png")
    rows = {"left/0.png": 4, "left/1.png": 0, "right/2.png": 4}
    descriptors = {image: np.eye(4, dtype=np.float32)[:count] for image, count in rows.items()}
    keypoints = {image: np.full((count, 2), 50, np.float32) for image, count in rows.items()}
    write_features(tmp_path, "keypoints", "toy", keypoints)
    write_features(tmp_path, "descriptors", "toy", descriptors)
    folder = world.mapping().with_features([tmp_path])
    pairs = [ImagePair(*pair, score) for pair in (empty, full) for score in (0.2, 0.9)]
    pairs += [ImagePair(image, image, 1.0) for image in rows]
    for verification, matched in ((KnownPoseOptions(), 0), (None, 4)):
        out = tmp_path / f"out{matched}"
        counts = match_pairs(folder, folder, pairs, "toy", NearestNeighbours(), verification, out)
        assert [*counts.values()] == [2, int(matched > 0), matched]
        reader = folder.with_features([out]).matches("toy")
        assert {pair: reader.length(*pair) for pair in reader.pairs} == {empty: 0, full: matched}


def test_the_pairs_to_rematch_are_those_with_most_verified_matches() -> None:
    verified = {("a", "b"): 5, ("a", "c"): 9, ("a", "d"): 5, ("b", "c"): 1, ("c", "d"): 0}
    of_first = [("a", "b"), ("a", "c"), ("b", "c"), ("c", "d")]
    two, lone = (SecondMatchingOptions(pairs=pairs) for pairs in (2, 1))
    assert pairs_to_rematch(verified, two, of_both=False) == of_first
    assert pairs_to_rematch(verified, lone, of_both=True) == [("a", "b"), ("a", "c"), ("a", "d")]
    weak = SecondMatchingOptions(pairs=2, min_matches=9)
    of_weak = [("a", "b"), ("a", "d"), ("b", "c"), ("c", "d")]
    assert pairs_to_rematch(verified, weak, of_both=True) == of_weak


@pytest.mark.parametrize(
    ("found", "message"),
    [
        ((np.array([[0, 5]]), np.ones(3)), r"got float64 \(3,\), expected .*\(1\)"),
        ((np.array([[0, 5]]), np.ones(1)), r"range \(3 and 5 keypoints"),
        (np.array([[0, 4], [1, 3]]), r"got ndarray, expected \(matches, scores\)"),
        (None, r"got NoneType, expected \(matches, scores\)"),
    ],
)
def test_wrong_matches_of_a_plugin_are_refused(found: Any, message: str) -> None:
    class Mistaken:
        def match(self, a: Any, b: Any) -> Any:
            return found

    def image(count: int) -> ImageFeatures:
        return ImageFeatures(np.zeros((count, 2), np.float32), np.zeros((count, 4)), 64, 48)

    with pytest.raises(PluginError, match=f"matcher Mistaken on pair a, b: .*{message}"):
        match_all(Mistaken(), image(3), [image(5)], ["pair a, b"])


def test_candidates_are_sorted_by_score_and_name() -> None:
    pairs = [
        ImagePair("q2", "m1", 0.1),
        ImagePair("q1", "m3", 0.5),
        ImagePair("q1", "m2", 0.9),
        ImagePair("q1", "m1", 0.5),
    ]
    assert list(candidates_of(pairs).items()) == [("q1", ["m2", "m1", "m3"]), ("q2", ["m1"])]


def test_a_wrong_given_pose_is_a_warning(
    world: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = world.mapping().read()
    wrong = replace(data.trajectories[0, "cam"], quat_wxyz=(0.5, -0.5, 0.5, 0.5))
    write_sensors(tmp_path, replace(data, trajectories={**data.trajectories, (0, "cam"): wrong}))
    mapping = KaptureFolder(tmp_path, features_dirs=[world.features_dir])
    images = sorted(world.map_poses)
    check_given_poses(mapping, all_pairs(images, images), "rootsift", NearestNeighbours())
    assert "matches: left/0.png" in caplog.text
