"""Lines, blocks of rows of numbers, matrices: the parts that all text formats share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.datasets.formats import text_lines
from megloc_kapture.datasets.formats.text_lines import (
    Block,
    Line,
    TextFile,
    image_name,
    read_lines,
    read_rigid_matrix,
)
from megloc_kapture.errors import DataError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "file.txt"


def test_lines_keep_their_numbers(path: Path) -> None:
    path.write_bytes(b"\xef\xbb\xbf# c\r\n\n \t1, 2 ,3,\r\n x\ty\x0bz \n")
    assert [(line.number, line.text) for line in read_lines(path, comments=True)] == [
        (3, "1, 2 ,3,"),
        (4, "x\ty\x0bz"),
    ]
    assert [line.number for line in read_lines(path)] == [1, 3, 4]
    assert [line.number for line in read_lines(path, blank=True)] == [1, 2, 3, 4]
    first, second = read_lines(path, comments=True)
    assert first.comma_fields == ["1", "2", "3"]
    assert second.comma_fields == second.fields == ["x", "y", "z"]
    # a blank of another script ends no field
    assert Line(path, 1, "a\u00a0b\x1cc").fields == ["a\u00a0b\x1cc"]
    assert Line(path, 1, "a  b\tc  \x1c d").rest(2) == "c  \x1c d"


def test_long_texts_are_cut_in_errors(path: Path) -> None:
    line = Line(path, 7, "")
    with pytest.raises(DataError) as caught:
        line.number_of("9" * 4000 + "x", "width")
    assert str(caught.value) == f"{path}:7: width '{'9' * 40}...' is not a finite number"
    with pytest.raises(DataError, match=r":7: expected 2 or 3 fields \(a b c\), got 1$"):
        line.expect(["a"], (2, 3), "a b c")


def test_counts(path: Path) -> None:
    line = Line(path, 1, "")
    assert line.count_of("007", "size") == 7
    for text in ("1_0", "-1", "5.0", "\u0661", "9" * 5000):
        with pytest.raises(DataError, match="is not a whole number"):
            line.count_of(text, "size", 99)
    with pytest.raises(DataError, match="3 is out of range, there are 3"):
        line.count_of("3", "size", 3)


@pytest.mark.parametrize(
    "text", ["nan", "inf", "1e999", "1_0", "0x2", "2,5", "\u0661", "3\0", "", "x"]
)
def test_what_is_no_finite_number(path: Path, text: str) -> None:
    assert Line(path, 1, "").number_of("-.5e1", "width") == -5
    with pytest.raises(DataError, match="is not a finite number"):
        Line(path, 1, "").number_of(text, "width")


def test_image_names_are_plain_paths() -> None:
    assert image_name("./a/b.jpg") == image_name("a/b.jpg") == "a/b.jpg"
    for name, match in (
        ("../a.jpg", "leads out of its folder"),
        ("/a.jpg", "absolute path"),
        ("a\\b.jpg", "backslash"),
        ("a\x1c", "control character"),
        ("\udcff.jpg", "not UTF-8"),
    ):
        with pytest.raises(DataError, match=match):
            image_name(name)


def test_the_file_and_its_blocks_pass_over_the_same_lines(path: Path) -> None:
    rows = [f"{k} {' '.join(map(str, range(k % 5)))}" for k in range(40)]
    path.write_text("\n\n".join(rows))
    with TextFile(path, block_bytes=50) as file:
        first = file.row()
        assert first is not None and (first.number, first.fields) == (1, ["0"])
        found = [line for block in file.blocks(30, "rows") for line in block.rows()]
        assert [line.number for line in found] == list(range(3, 63, 2))
        assert [line.text for line in found] == [row.strip() for row in rows[1:31]]
        # what follows the rows is still there
        following = file.row()
        assert following is not None and following.number == 63
        with pytest.raises(DataError, match=r"file\.txt:79: the file ends after 8 of 9 rows"):
            list(file.blocks(9, "rows"))
        assert file.line() is file.row() is file.block(1) is None


def test_a_line_longer_than_a_block_is_one_row(path: Path) -> None:
    path.write_text(" ".join(map(str, range(1000))) + "\n1 2\n")
    with TextFile(path, block_bytes=16) as file:
        blocks = list(file.blocks(2, "rows"))
    lengths = [block.numbers().lengths.tolist() for block in blocks]  # type: ignore[union-attr]
    assert lengths == [[1000], [2]]


def test_a_file_without_line_breaks_does_not_fill_the_memory(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(text_lines, "_MAX_LINE_BYTES", 100)
    path.write_text("1\n" + "2" * 300)
    with TextFile(path, block_bytes=10) as file:
        file.line()
        with pytest.raises(DataError, match=r"file\.txt:2: a line of more than 100 bytes"):
            file.block(5)


def numbers_of(content: bytes) -> list[list[float]] | None:
    rows = Block(Path("f"), 1, content).numbers()
    if rows is None:
        return None
    heads = rows.heads(1)[:, 0].tolist()
    tails = np.split(rows.tails(1), np.cumsum(rows.lengths - 1)[:-1]) if heads else []
    return [[head, *tail.tolist()] for head, tail in zip(heads, tails, strict=True)]


def test_rows_of_numbers_are_told_apart() -> None:
    content = b"1 2.5\t-3e2\r\n\n \n4\n  .5 +6  \n"
    assert numbers_of(content) == [[1, 2.5, -300], [4], [0.5, 6]]
    assert numbers_of(b"\n") == []
    exact = [repr(value) for value in np.random.default_rng(0).normal(size=1000).tolist()]
    assert numbers_of(" ".join(exact).encode() + b"\n") == [[float(text) for text in exact]]


@pytest.mark.parametrize(
    "text",
    [b"nan", b"-nan", b"nan(7)", b"inf", b"1e999", b"x", b"0x1", b"1_0", b"1,2", b"\0", b"#"],
)
def test_what_is_no_number_leaves_no_rows(text: bytes) -> None:
    for content in (text + b" 1\n2\n", b"1\n2 " + text + b"\n", b"1 " + text + b" 2\n3\n"):
        assert numbers_of(content) is None


def test_comments_become_blank_lines() -> None:
    block = Block(Path("f"), 5, b"# a\n1 2\n  # b 3\n4 5\n").without_comments()
    assert numbers_of(block.content) == [[1, 2], [4, 5]]
    assert [line.number for line in block.rows()] == [6, 8]


MATRIX = "0 -1 0 5\n1 0 0 2\n0 0 1 -1\n0 0 0 1"


@pytest.mark.parametrize("separator", [",", " ", " , "])
def test_a_rigid_matrix(path: Path, separator: str) -> None:
    path.write_text(MATRIX.replace(" ", separator))
    transform = read_rigid_matrix(path)
    np.testing.assert_allclose(transform.apply(np.array([[1.0, 0, 0]])), [[5, 3, -1]], atol=1e-15)


@pytest.mark.parametrize(
    ("old", "new", "line", "match"),
    [
        (" 5\n", " 5 0\n", 1, "four lines of four numbers, got line 1 with 5"),
        ("\n0 0 0 1", "", 4, "four lines of four numbers, got 3"),
        ("0 0 0 1", "0 0 0 1\n0 0 0 1", 5, "got line 5"),
        ("0 0 0 1", "0 0 0.1 1", 4, "last row is 0 0 0.1 1"),
        ("0 0 1 -1", "0 0 0.9 -1", 4, "no rotation matrix"),
        ("0 0 1 -1", "0 0 -1 -1", 4, "no rotation matrix"),
        ("0 0 1 -1", "0 0 1e300 -1", 4, "no rotation matrix"),
        ("-1\n", "-3e99\n", 4, "nowhere on earth"),
        ("-1\n", "inf\n", 3, "'inf' is not a finite number"),
        ("-1\n", "1e999\n", 3, "'1e999' is not a finite number"),
    ],
)
def test_a_broken_matrix_is_refused_with_its_line(
    path: Path, old: str, new: str, line: int, match: str
) -> None:
    assert old in MATRIX
    path.write_text(MATRIX.replace(old, new))
    with pytest.raises(DataError, match=match) as caught:
        read_rigid_matrix(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")
