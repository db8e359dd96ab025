"""CSV tables and poses in cells: what is written reads back; what is broken names its line."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.csv_table import POSE, Table, or_empty, read_csv_table, write_csv_table
from megloc_kapture.values import RigidTransform

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


angles = st.floats(-math.pi, math.pi)
metres = st.floats(-1e7, 1e7)


class Row(NamedTuple):
    pose: RigidTransform | None


POSES = Table(Row, {"pose": or_empty(POSE)})


@given(st.tuples(angles, angles, angles), st.tuples(metres, metres, metres))
def test_a_pose_reads_back_with_every_digit(
    tmp_path_factory: pytest.TempPathFactory,
    vector: tuple[float, float, float],
    translation: tuple[float, float, float],
) -> None:
    x, y, z, w = Rotation.from_rotvec(vector).as_quat().tolist()
    path = tmp_path_factory.getbasetemp() / "any_pose.csv"
    pose = RigidTransform((w, x, y, z), translation)
    POSES.write(path, [Row(pose)])
    assert list(POSES.read(path)) == [Row(pose)]


def test_no_pose_is_an_empty_cell() -> None:
    assert or_empty(POSE).write(None) == ""
    assert or_empty(POSE).read("") is None


@pytest.mark.parametrize(
    "text",
    [
        "1 0 0 0 1 2",
        "1 0 0 0 1 2 3 4",
        "1 0 0 zero 1 2 3",
        "0 0 0 0 1 2 3",
        "2 0 0 0 1 2 3",
        "nan 0 0 0 1 2 3",
        "1 0 0 0 1 inf 3",
    ],
)
def test_what_is_no_pose_is_named_with_its_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "t.csv"
    path.write_text(f"pose\n1 0 0 0 1 2 3\n{text}\n")
    expected = rf"t\.csv:3: pose '{text}' is not a pose qw qx qy qz tx ty tz: a unit quaternion"
    with pytest.raises(DataError, match=expected):
        list(POSES.read(path))
