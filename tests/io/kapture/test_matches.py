"""Matches are stored under the smaller name and read in the order asked; pairs files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.features import feature_folder
from megloc_kapture.io.kapture.matches import (
    ImagePair,
    MatchesReader,
    MatchesWriter,
    read_pairs,
    write_pairs,
)

INDICES = np.array([[0, 7], [3, 2], [2**24 + 1, 5]])
SCORES = np.array([0.5, 1 / 3, -1.0])
FORMS = [(tar, orphan) for tar in (False, True) for orphan in (False, True)]


def reader(root: Path, *, orphan: bool = False) -> MatchesReader:
    return MatchesReader("T", [(root, feature_folder(root, "matches", "T", orphan=orphan))])


def store(root: Path, rows: bytes) -> None:
    path = root / "reconstruction/matches/T/a.jpg.overlapping/b.jpg.matches"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(rows)


@pytest.mark.parametrize(("tar", "orphan"), FORMS)
@pytest.mark.parametrize("pair", [("a/x.jpg", "b.jpg"), ("b.jpg", "a/x.jpg")])
def test_matches_come_back_in_either_order(
    tmp_path: Path, pair: tuple[str, str], tar: bool, orphan: bool
) -> None:
    with MatchesWriter(tmp_path, "T", tar=tar, orphan=orphan) as writer:
        assert pair not in writer
        writer.write(*pair, INDICES, SCORES)
        assert pair in writer and pair[::-1] in writer
        writer.write("c", "b.jpg", [], [])
    matches = reader(tmp_path, orphan=orphan)
    assert matches.pairs == [("a/x.jpg", "b.jpg"), ("b.jpg", "c")]
    assert pair in matches and pair[::-1] in matches and ("a/x.jpg", "c") not in matches
    for asked, expected in ((pair, INDICES), (pair[::-1], INDICES[:, ::-1])):
        indices, scores = matches.read(*asked)
        assert indices.dtype == np.int64 and scores.dtype == np.float64
        assert np.array_equal(indices, expected)
        assert np.array_equal(scores, SCORES)
    assert matches.read("b.jpg", "c")[0].shape == (0, 2)


def test_the_file_lies_under_the_smaller_name(tmp_path: Path) -> None:
    with MatchesWriter(tmp_path, "T") as writer:
        writer.write("b.jpg", "a.jpg", INDICES, SCORES)
    path = tmp_path / "reconstruction/matches/T/a.jpg.overlapping/b.jpg.matches"
    rows = np.fromfile(path, "<f8").reshape(-1, 3)
    assert np.array_equal(rows, np.c_[INDICES[:, ::-1], SCORES])


def test_files_of_the_unordered_pair_are_found(tmp_path: Path) -> None:
    # what kapture's own writers make of ("b", "a")
    folder = tmp_path / "reconstruction/matches/T/b.overlapping"
    folder.mkdir(parents=True)
    np.c_[INDICES, SCORES].astype("<f8").tofile(folder / "a.matches")
    matches = reader(tmp_path)
    assert matches.pairs == [("a", "b")]
    assert np.array_equal(matches.read("b", "a")[0], INDICES)
    assert np.array_equal(matches.read("a", "b")[0], INDICES[:, ::-1])


@pytest.mark.parametrize("bad", [0.5, -1.0, np.nan, np.inf, 2.0**53])
def test_indices_must_be_whole_and_not_negative(tmp_path: Path, bad: float) -> None:
    store(tmp_path, np.array([[0, 1, 0.5], [1, bad, 0.5]]).tobytes())
    with pytest.raises(DataError, match=r"b\.jpg\.matches: row 1: .*not keypoint indices"):
        reader(tmp_path).read("a.jpg", "b.jpg")


def test_truncated_files_are_refused(tmp_path: Path) -> None:
    store(tmp_path, bytes(32))
    with pytest.raises(DataError, match=r"b\.jpg\.matches: 32 bytes"):
        reader(tmp_path).read("a.jpg", "b.jpg")


def test_absent_pairs_are_named(tmp_path: Path) -> None:
    store(tmp_path, b"")
    with pytest.raises(DataError, match="'a.jpg' and 'c.jpg'"):
        reader(tmp_path).read("a.jpg", "c.jpg")


@pytest.mark.parametrize("name", ["lonely.matches", "a.overlapping/a.matches"])
def test_files_that_name_no_pair_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "reconstruction/matches/T" / name
    path.parent.mkdir(parents=True)
    path.touch()
    with pytest.raises(DataError, match=f"{path.name}: does not name a pair"):
        _ = reader(tmp_path).pairs


@pytest.mark.parametrize(
    ("indices", "scores"),
    [
        (INDICES, SCORES[:2]),
        (INDICES.T, SCORES),
        (INDICES.astype(float), SCORES),
        (-INDICES, SCORES),
        (np.array([[0, 1]], dtype=bool), SCORES[:1]),
    ],
)
def test_wrong_arrays_are_refused(tmp_path: Path, indices: np.ndarray, scores: np.ndarray) -> None:
    with (
        MatchesWriter(tmp_path, "T") as writer,
        pytest.raises(ValueError, match="expected|indices"),
    ):
        writer.write("a", "b", indices, scores)


def test_an_image_is_not_matched_with_itself(tmp_path: Path) -> None:
    with MatchesWriter(tmp_path, "T") as writer, pytest.raises(ValueError, match="itself"):
        writer.write("a", "a", INDICES, SCORES)


def test_names_that_lead_elsewhere_are_refused(tmp_path: Path) -> None:
    with MatchesWriter(tmp_path, "T") as writer:
        for other in ("../b", "/b", "b,c", ""):
            with pytest.raises(DataError):
                writer.write("a", other, INDICES, SCORES)
    with pytest.raises(DataError):
        MatchesWriter(tmp_path, "../T")


HEAD = "# kapture format: 1.1\n# query_image, map_image, score\n"


def test_pairs_come_back_in_their_order(tmp_path: Path) -> None:
    pairs = [
        ImagePair("q 2", "m/1", 1 / 3),
        ImagePair("q1", "m2", -1.0),
        ImagePair("q1", "m1", 2.0),
    ]
    write_pairs(tmp_path / "pairs" / "query.txt", pairs)
    assert read_pairs(tmp_path / "pairs" / "query.txt") == pairs
    text = (tmp_path / "pairs" / "query.txt").read_text()
    assert text == HEAD + "q 2, m/1, 0.3333333333333333\nq1, m2, -1.0\nq1, m1, 2.0\n"


def test_a_repeated_pair_counts_once(tmp_path: Path) -> None:
    (tmp_path / "p.txt").write_text("a, b, 1\nb, a, 1\na, b, 2\n")
    assert read_pairs(tmp_path / "p.txt") == [ImagePair("a", "b", 1.0), ImagePair("b", "a", 1.0)]


@pytest.mark.parametrize(
    ("row", "match"),
    [
        ("a, b", "expected 3 columns, got 2"),
        ("a, b, c", "score 'c' is not a number"),
        ("a, b, nan", "not finite"),
        ("a, ../b, 1", "leads out"),
        (", b, 1", "empty"),
    ],
)
def test_bad_rows_name_file_and_line(tmp_path: Path, row: str, match: str) -> None:
    (tmp_path / "p.txt").write_text(HEAD + f"a, b, 1\n{row}\n")
    with pytest.raises(DataError, match=r"p\.txt:4: .*" + match):
        read_pairs(tmp_path / "p.txt")


def test_what_could_not_be_read_back_is_not_written(tmp_path: Path) -> None:
    for pair in (
        ImagePair("a,b", "c", 1.0),
        ImagePair("a", "../c", 1.0),
        ImagePair("#a", "b", 1.0),
    ):
        with pytest.raises(DataError):
            write_pairs(tmp_path / "p.txt", [pair])
    with pytest.raises(DataError, match="not finite"):
        write_pairs(tmp_path / "p.txt", [ImagePair("a", "b", float("nan"))])
    assert list(tmp_path.iterdir()) == []


def test_an_indented_comment_is_neither_comment_nor_name(tmp_path: Path) -> None:
    (tmp_path / "p.txt").write_text("a, b, 1\n\t#, c, 0\n")
    with pytest.raises(DataError, match=r"p\.txt:2: a comment must begin in the first column"):
        read_pairs(tmp_path / "p.txt")
