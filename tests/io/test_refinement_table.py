from __future__ import annotations

from pathlib import Path

import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.refinement_table import read_refinement, write_refinement
from megloc_kapture.values import RefinementRow, RigidTransform

START = RigidTransform((0.6, 0.0, 0.8, 0.0), (1.0, -2.0, 0.1))
ROWS = [
    RefinementRow("a.jpg", "rendering", "", 0.02, 0.1, ("cost=0.1", "points=900"), START),
    RefinementRow("a.jpg", "icp", "the overlap fell, a bit", 0.0, 0.0, (), START),
    RefinementRow("b.jpg", "rendering", "no depth", 0.0, 0.0, (), RigidTransform.identity()),
]


def test_rows_read_back_by_image_with_their_steps_in_order(tmp_path: Path) -> None:
    path = tmp_path / "refinement.csv"
    write_refinement(path, [ROWS[2], *ROWS[:2]])
    assert read_refinement(path) == ROWS


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("0.020000", "far", "moved_m and turned_deg"),
        (",yes,", ",no,", "contradict"),
        (" -2.0 0.1", " -2.0", "qw qx qy qz tx ty tz"),
        ("0.6 0.0 0.8 0.0 1.0 -2.0 0.1", "", "a pose is expected"),
    ],
)
def test_a_broken_row_is_named_with_its_line(
    old: str, new: str, expected: str, tmp_path: Path
) -> None:
    path = tmp_path / "refinement.csv"
    write_refinement(path, ROWS[:1])
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(DataError, match=expected) as raised:
        read_refinement(path)
    assert f"{path}:2" in str(raised.value)
