"""Pairs files, as kapture-localization reads and writes them."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from megloc_kapture.errors import DataError
from megloc_kapture.io.pairs import ImagePair, read_pairs, write_pairs

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


@given(
    st.binary(max_size=100) | st.text(st.sampled_from("ab,1. \n#\r"), max_size=60).map(str.encode)
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=200)
def test_random_content_is_read_or_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "p.txt"
    path.write_bytes(content)
    try:
        pairs = read_pairs(path)
    except DataError as error:
        assert "p.txt" in str(error)
        return
    write_pairs(path, pairs)
    assert read_pairs(path) == pairs
