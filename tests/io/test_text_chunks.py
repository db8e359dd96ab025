"""Chunks of whole lines: together they are the file."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from megloc_kapture.errors import DataError
from megloc_kapture.io import text_chunks
from megloc_kapture.io.text_chunks import PADDING, read_chunks

MARK = b"\xef\xbb\xbf"


@given(
    st.lists(st.binary(max_size=60).map(lambda line: line.replace(b"\n", b"")), max_size=30),
    st.booleans(),
    st.booleans(),
    st.integers(1, 100),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_chunks_are_the_file_in_whole_lines(
    tmp_path: Path, lines: list[bytes], marked: bool, ended: bool, chunk_bytes: int
) -> None:
    content = b"".join(line + b"\n" for line in lines)
    content = content if ended else content[:-1]
    path = tmp_path / "f.txt"
    path.write_bytes((MARK if marked else b"") + content)
    found, number = b"", 1
    for chunk in read_chunks(path, chunk_bytes):
        text = chunk.text[chunk.begin : chunk.end].tobytes()
        assert text.endswith(b"\n")
        assert chunk.first_line == number
        assert len(chunk.text) % 8 == 0 and len(chunk.text) >= chunk.end + PADDING
        assert not chunk.text[chunk.end :].any()
        found += text
        number += text.count(b"\n")
    expected = content if content.endswith(b"\n") or not (content or marked) else content + b"\n"
    # what begins like a mark is taken for one
    assert found == (expected if marked or not expected.startswith(MARK) else expected[3:])


def test_a_line_that_fills_the_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(text_chunks, "MAX_LINE_BYTES", 1000)
    path = tmp_path / "f.txt"
    path.write_bytes(b"a\nb\n" + b"x" * 1000 + b"\n")
    assert sum(len(c.text[c.begin : c.end]) for c in read_chunks(path, 64)) == 1005
    path.write_bytes(b"a\nb\n" + b"x" * 5000)
    with pytest.raises(DataError, match=r"f\.txt:3: a line of more than 1000 bytes"):
        list(read_chunks(path, 64))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"f\.txt: file is missing"):
        list(read_chunks(tmp_path / "f.txt"))
    with pytest.raises(DataError, match="cannot read: Is a directory"):
        list(read_chunks(tmp_path))
