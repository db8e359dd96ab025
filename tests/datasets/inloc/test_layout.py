"""Names and text files of InLoc."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.datasets.inloc import (
    Cutout,
    parse_cutout_name,
    read_transformation,
    read_wrong_scans,
)

TRANSFORMATION = """Before general icp:
1 0 0 0
0 1 0 0
0 0 1 0
0 0 0 1

After general icp:
  0 -1  0  5.0
  1  0  0  2.0
  0  0  1  -1e-1
  0  0  0  1
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "DUC_trans_024.txt"


def test_names_of_cutouts_are_parsed() -> None:
    assert parse_cutout_name("DUC_cutout_024_0_0.jpg") == Cutout("DUC", "024", 0, 0)
    cutout = parse_cutout_name("cse_cutout_000_330_-30.jpg")
    assert cutout == Cutout("cse", "000", 330, -30)
    assert cutout.image == "cse_cutout_000_330_-30.jpg"
    assert cutout.transformation == "cse_trans_000.txt"


def test_the_second_matrix_of_a_transformation_is_used(path: Path) -> None:
    for text in (TRANSFORMATION, f"comment: {TRANSFORMATION}\nfitness 0.1\n"):
        path.write_text(text)
        pose = read_transformation(path)
        np.testing.assert_allclose(pose.apply(np.array([[1.0, 0, 0]])), [[5, 3, -0.1]], atol=1e-12)


def test_numbers_of_wrong_scans_are_read(path: Path) -> None:
    path.write_text("known wrong:\n\n008\nDUC_scan_12.ptx 31\r\n2017\n")
    assert read_wrong_scans(path) == {"008", "012", "031"}
