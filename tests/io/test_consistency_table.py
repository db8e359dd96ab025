from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.consistency_table import (
    ConsistencyRow,
    read_consistency,
    write_consistency,
)

ROW = ConsistencyRow("DUC1", "rendering", 13, 2, 0.016, 0.25, 1.5, 0.024, 0.3, 11.5, "")
NAN = float("nan")


def test_rows_read_back_in_order(tmp_path: Path) -> None:
    path = tmp_path / "map_consistency.csv"
    rows = [ROW, replace(ROW, frame="", reason="the map, of all, contradicts itself")]
    write_consistency(path, rows)
    assert read_consistency(path) == rows


def test_what_was_not_measured_is_empty(tmp_path: Path) -> None:
    path = tmp_path / "map_consistency.csv"
    write_consistency(
        path, [ConsistencyRow("", "rendering", 0, 0, NAN, NAN, NAN, NAN, NAN, NAN, "no depth")]
    )
    assert path.read_text().splitlines()[-1] == ",rendering,0,0,,,,,,,no depth"
    (row,) = read_consistency(path)
    assert row.reason == "no depth" and row.moved_m != row.moved_m


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [(",13,", ",some,", "images 'some' is no count"), ("0.016", "far", "numbers or empty")],
)
def test_a_broken_row_is_named_with_its_line(
    old: str, new: str, expected: str, tmp_path: Path
) -> None:
    path = tmp_path / "map_consistency.csv"
    write_consistency(path, [ROW])
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(DataError, match=expected) as raised:
        read_consistency(path)
    assert f"{path}:2" in str(raised.value)
