"""Reranking by the number of correspondences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    ImagePair,
    KaptureFolder,
    MatchesWriter,
    read_pairs,
    write_pairs,
)
from megloc_kapture.io.tables import PairCount, match_counts_path, write_match_counts
from megloc_kapture.stages.matches import iterate_candidates
from megloc_kapture.stages.reranking import (
    RerankingOptions,
    correspondences,
    cover_pairs,
    matched_keypoints,
    rerank_pairs,
)

PAIRS = [
    ImagePair("q1", "z", 0.9),
    ImagePair("q1", "y", 0.8),
    ImagePair("q1", "x", 0.7),
    ImagePair("q1", "w", 0.6),
    ImagePair("q2", "x", 0.3),
    ImagePair("q2", "y", 0.2),
]


def test_most_correspondences_first_and_no_more_than_asked() -> None:
    found = rerank_pairs(PAIRS, {("q1", "w"): 30, ("q1", "y"): 10, ("q2", "y"): 4}, keep=3)
    assert [(pair.query, pair.map) for pair in found] == [
        ("q1", "w"),
        ("q1", "y"),
        ("q1", "z"),
        ("q2", "y"),
        ("q2", "x"),
    ]


def test_equal_counts_keep_retrievals_order_also_in_the_file(tmp_path: Path) -> None:
    found = rerank_pairs(PAIRS, {("q1", "x"): 7, ("q1", "z"): 7}, keep=4)
    write_pairs(tmp_path / "pairs.txt", found)
    ranked = dict(iterate_candidates(read_pairs(tmp_path / "pairs.txt")))
    assert ranked == {"q1": ["z", "x", "y", "w"], "q2": ["x", "y"]}
    # the score tells the count
    assert [int(pair.score) for pair in found] == [7, 7, 0, 0, 0, 0]


def test_coverage_counts_each_keypoint_once() -> None:
    matched = {"z": [0, 1, 2, 3], "y": [0, 1, 2], "x": [5, 6], "w": []}

    def keypoints(query: str, image: str) -> np.ndarray:
        return np.array(matched[image], dtype=np.int64)

    found = cover_pairs(PAIRS[:4], keypoints, keep=3)
    assert [(pair.map, int(pair.score)) for pair in found] == [("z", 4), ("x", 2), ("y", 0)]


def test_keypoints_of_several_types_are_told_apart(tmp_path: Path) -> None:
    folder = KaptureFolder(tmp_path, features_dirs=[tmp_path])
    for name, count, rows in (("a", 3, [[2, 0]]), ("b", 4, [[1, 0], [2, 1]])):
        config = FeatureConfig(name, np.dtype("float32"), 2)
        with FeatureWriter(tmp_path, "keypoints", name, config, orphan=True) as writer:
            writer.write("q", np.zeros((count, 2), np.float32))
        with MatchesWriter(tmp_path, name, orphan=True) as writer:
            writer.write("q", "m", np.array(rows), np.ones(len(rows)))
    matched = matched_keypoints(folder, ["a", "b"])
    assert matched("q", "m").tolist() == [2, 3 + 1, 3 + 2]
    assert matched("q", "other").tolist() == []


def test_counts_of_all_types_are_added(tmp_path: Path) -> None:
    write_match_counts(tmp_path, "a", [PairCount("q", "m", 9, 4), PairCount("q", "n", 2, 0)])
    write_match_counts(tmp_path, "b", [PairCount("q", "m", 5, 1)])
    assert correspondences(tmp_path, ["a", "b"], "matches") == {("q", "m"): 14, ("q", "n"): 2}
    assert correspondences(tmp_path, ["a", "b"], "verified") == {("q", "m"): 5, ("q", "n"): 0}
    assert correspondences(tmp_path, ["b"], "verified") == {("q", "m"): 1}


def test_a_broken_table_is_named_with_its_line(tmp_path: Path) -> None:
    write_match_counts(tmp_path, "a", [PairCount("q", "m", 9, 4)])
    path = match_counts_path(tmp_path, "a")
    path.write_text(path.read_text() + "q,n,many,1\n")
    with pytest.raises(DataError, match=r"match_counts\.csv:3: matches 'many'"):
        correspondences(tmp_path, ["a"], "verified")
    with pytest.raises(DataError, match=r"match_counts\.csv"):
        correspondences(tmp_path, ["none"], "verified")


def test_nothing_is_reranked_unless_asked() -> None:
    assert not RerankingOptions().reranks()
