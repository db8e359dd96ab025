"""Lines, numbers and matrices: the parts that all text formats share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.io.text_lines import read_lines, read_rigid_matrix


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


MATRIX = "0 -1 0 5\n1 0 0 2\n0 0 1 -1\n0 0 0 1"


@pytest.mark.parametrize("separator", [",", " ", " , "])
def test_a_rigid_matrix(path: Path, separator: str) -> None:
    path.write_text(MATRIX.replace(" ", separator))
    transform = read_rigid_matrix(path)
    np.testing.assert_allclose(transform.apply(np.array([[1.0, 0, 0]])), [[5, 3, -1]], atol=1e-15)
