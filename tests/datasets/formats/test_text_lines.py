"""Lines, numbers and matrices: the parts that all text formats share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.datasets.text_lines import Line, read_lines, read_rigid_matrix
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
    first, second = read_lines(path, comments=True)
    assert first.comma_fields == ["1", "2", "3"]
    assert second.comma_fields == second.fields == ["x", "y", "z"]


def test_long_texts_are_cut_in_errors(path: Path) -> None:
    line = Line(path, 7, "")
    with pytest.raises(DataError) as caught:
        line.number_of("9" * 4000 + "x", "width")
    assert str(caught.value) == f"{path}:7: width '{'9' * 40}...' is not a finite number"
    with pytest.raises(DataError, match=r":7: expected 2 or 3 fields \(a b c\), got 1$"):
        line.expect(["a"], (2, 3), "a b c")


@pytest.mark.parametrize("text", ["nan", "inf", "1e999", "0x2", "2,5", "", "x"])
def test_what_is_no_finite_number(path: Path, text: str) -> None:
    assert Line(path, 1, "").number_of("-.5e1", "width") == -5
    with pytest.raises(DataError, match="is not a finite number"):
        Line(path, 1, "").number_of(text, "width")


MATRIX = "0 -1 0 5\n1 0 0 2\n0 0 1 -1\n0 0 0 1"


@pytest.mark.parametrize("separator", [",", " ", " , "])
def test_a_rigid_matrix(path: Path, separator: str) -> None:
    path.write_text(MATRIX.replace(" ", separator))
    transform = read_rigid_matrix(path)
    np.testing.assert_allclose(transform.apply(np.array([[1.0, 0, 0]])), [[5, 3, -1]], atol=1e-15)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        (" 5\n", " 5 0\n", "expected four lines of four numbers"),
        ("\n0 0 0 1", "", "expected four lines of four numbers"),
        ("0 0 0 1", "0 0 0.1 1", "last row of the matrix is not"),
        ("0 0 1 -1", "0 0 -1 -1", "not a rotation matrix"),
        ("-1\n", "inf\n", "'inf' is not a finite number"),
    ],
)
def test_a_broken_matrix_is_refused(path: Path, old: str, new: str, match: str) -> None:
    path.write_text(MATRIX.replace(old, new))
    with pytest.raises(DataError, match=match) as caught:
        read_rigid_matrix(path)
    assert str(caught.value).startswith(f"{path}:")
