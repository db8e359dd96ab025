"""Reranking by the number of correspondences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import (
    ImagePair,
    KaptureFolder,
    MatchesWriter,
    read_pairs,
    write_pairs,
)
from megloc_kapture.io.tables import PairCount, match_counts_path, write_match_counts
from megloc_kapture.stages.image_pairs import RerankingOptions, counted, rerank, reranked
from megloc_kapture.stages.matches import VerifiedMatches, iterate_candidates

PAIRS = [
    ImagePair("q1", "z", 0.9),
    ImagePair("q1", "y", 0.8),
    ImagePair("q1", "x", 0.7),
    ImagePair("q1", "w", 0.6),
    ImagePair("q2", "x", 0.3),
    ImagePair("q2", "y", 0.2),
]


def write_matches(root: Path, counts: dict[tuple[str, str], tuple[int, int]], name: str) -> None:
    """Matches and their table: of each pair how many were found and verified."""
    table = []
    with MatchesWriter(root, name, orphan=True) as writer:
        for (image, other), (found, verified) in counts.items():
            rows = np.stack([np.arange(verified)] * 2, axis=1)
            writer.write(image, other, rows, np.ones(verified))
            table.append(PairCount(image, other, found, verified))
    write_match_counts(root, name, table)


def run(root: Path, names: list[str], by: Any, keep: int) -> list[ImagePair]:
    query = KaptureFolder(root, features_dirs=[root])
    return reranked(PAIRS, query, root, names, RerankingOptions(by=by, keep=keep))


def test_most_correspondences_first_and_no_more_than_asked(tmp_path: Path) -> None:
    counts = {("q1", "w"): (40, 30), ("q1", "y"): (50, 10), ("q2", "y"): (4, 4)}
    write_matches(tmp_path, counts, "a")
    found = run(tmp_path, ["a"], "verified", 3)
    assert [(pair.query, pair.map) for pair in found] == [
        ("q1", "w"),
        ("q1", "y"),
        ("q1", "z"),
        ("q2", "y"),
        ("q2", "x"),
    ]
    assert [pair.map for pair in run(tmp_path, ["a"], "matches", 2)] == ["y", "w", "y", "x"]


def test_equal_counts_keep_retrievals_order_also_in_the_file(tmp_path: Path) -> None:
    write_matches(tmp_path, {("q1", "x"): (7, 7), ("q1", "z"): (7, 7)}, "a")
    found = run(tmp_path, ["a"], "verified", 4)
    write_pairs(tmp_path / "pairs.txt", found)
    ranked = dict(iterate_candidates(read_pairs(tmp_path / "pairs.txt")))
    assert ranked == {"q1": ["z", "x", "y", "w"], "q2": ["x", "y"]}
    # the score tells the count
    assert [int(pair.score) for pair in found] == [7, 7, 0, 0, 0, 0]


def test_coverage_counts_each_keypoint_once(tmp_path: Path) -> None:
    matched = {"z": [0, 1, 2, 3], "y": [0, 1, 2], "x": [5, 6, 5], "w": []}
    with MatchesWriter(tmp_path, "a", orphan=True) as writer:
        for image, rows in matched.items():
            both = np.stack([rows, np.arange(len(rows))], axis=1).astype(np.int64)
            writer.write("q1", image, both, np.ones(len(rows)))
    found = [pair for pair in run(tmp_path, ["a"], "coverage", 3) if pair.query == "q1"]
    assert [(pair.map, int(pair.score)) for pair in found] == [("z", 4), ("x", 2), ("y", 0)]
    # the same from arrays
    of_image = [np.array(matched[image], np.int64) for image in ("z", "y", "x", "w")]
    assert rerank([of_image], RerankingOptions(by="coverage", keep=3)) == ([0, 2, 1], [4, 2, 0])


def test_keypoints_of_several_types_are_told_apart() -> None:
    options = RerankingOptions(by="coverage", keep=2)
    # row 1 of one type is no row of the other
    of_types = [[np.array([2]), np.array([1])], [np.array([1, 2]), np.array([1, 3])]]
    assert rerank(of_types, options) == ([0, 1], [3, 2])
    assert rerank([[np.array([0]), np.array([0])]], options) == ([0, 1], [1, 0])


def test_counts_of_all_types_are_added(tmp_path: Path) -> None:
    write_matches(tmp_path, {("q1", "y"): (9, 4), ("q1", "x"): (2, 0)}, "a")
    write_matches(tmp_path, {("q1", "y"): (5, 1)}, "b")
    counts = {
        by: [int(pair.score) for pair in run(tmp_path, ["a", "b"], by, 2)][:2]
        for by in ("matches", "verified")
    }
    assert counts == {"matches": [14, 2], "verified": [5, 0]}


def test_matches_count_alike_stored_and_at_hand() -> None:
    pair = VerifiedMatches(np.array([[3, 0], [5, 1]]), np.ones(2, np.float32), num_found=9)
    assert (counted(pair, "matches"), counted(pair, "verified")) == (9, 2)
    assert np.asarray(counted(pair, "coverage")).tolist() == [3, 5]


def test_a_broken_table_is_named_with_its_line(tmp_path: Path) -> None:
    write_matches(tmp_path, {("q", "m"): (9, 4)}, "a")
    path = match_counts_path(tmp_path, "a")
    path.write_text(path.read_text() + "q,n,many,1\n")
    with pytest.raises(DataError, match=r"match_counts\.csv:3: matches 'many'"):
        run(tmp_path, ["a"], "verified", 1)
    with pytest.raises(DataError, match=r"match_counts\.csv"):
        run(tmp_path, ["none"], "verified", 1)


def test_nothing_is_reranked_unless_asked() -> None:
    assert not RerankingOptions().reranks()
    assert rerank([[3, 9], [0, 0]], RerankingOptions()) == ([0, 1], [3, 9])
    assert reranked(PAIRS, KaptureFolder("none"), Path("none"), ["a"], RerankingOptions()) == PAIRS
