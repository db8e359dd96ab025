"""CSV tables beside kapture: what is written reads back; what is broken names its line."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.csv_table import read_csv_table, write_csv_table

COLUMNS = ("image", "reason")

fields = st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=12)


@given(rows=st.lists(st.tuples(fields, fields), max_size=6))
def test_any_text_reads_back(tmp_path_factory: pytest.TempPathFactory, rows: list) -> None:
    path = tmp_path_factory.getbasetemp() / "any_text.csv"
    write_csv_table(path, COLUMNS, rows)
    read = [(row["image"], row["reason"]) for _, row in read_csv_table(path, COLUMNS)]
    assert read == rows


def test_what_is_written_is_plain(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    write_csv_table(path, COLUMNS, [("a b.jpg", "few, far"), ("c.jpg", "")])
    assert path.read_bytes() == b'image,reason\na b.jpg,"few, far"\nc.jpg,\n'


@pytest.mark.parametrize(
    "text",
    [
        "image,reason\r\na,b\r\n",
        "\ufeffimage,reason\na,b\n",
        "reason,image\nb,a\n\n",
        "image,reason\na,b",
    ],
    ids=["crlf", "byte order mark", "other order, empty line", "no final newline"],
)
def test_variants_are_taken(tmp_path: Path, text: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text(text, encoding="utf-8", newline="")
    assert [row for _, row in read_csv_table(path, COLUMNS)] == [{"image": "a", "reason": "b"}]


@pytest.mark.parametrize(
    ("content", "line", "words"),
    [
        (b"", None, "empty"),
        (b"image\na\n", 1, "header"),
        (b"image,reason,extra\na,b,c\n", 1, "header"),
        (b"image,reason\na,b\nc\n", 3, "1 fields"),
        (b"image,reason\na,b,c\n", 2, "3 fields"),
        (b'image,reason\na,"b\nc,d\n', 3, "broken CSV"),
        (b"image,reason\na,\xff\n", 2, "UTF-8"),
        (b"image,reason\n\na,\0\n", 3, "NUL"),
    ],
)
def test_broken_tables_name_file_and_line(
    tmp_path: Path, content: bytes, line: int | None, words: str
) -> None:
    path = tmp_path / "table.csv"
    path.write_bytes(content)
    with pytest.raises(DataError, match=words) as caught:
        list(read_csv_table(path, COLUMNS))
    assert caught.value.line == line
    assert str(path) in str(caught.value)


def test_absent_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot read"):
        list(read_csv_table(tmp_path / "none.csv", COLUMNS))


def test_a_field_that_no_reader_takes_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    with pytest.raises(OutputError, match="column reason"):
        write_csv_table(path, COLUMNS, [("a", "x" * (csv.field_size_limit() + 1))])
    assert not path.exists()
