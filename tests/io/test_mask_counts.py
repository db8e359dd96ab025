"""The table of keypoints that masks removed."""

from __future__ import annotations

from pathlib import Path

import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.mask_counts import mask_counts_path, read_mask_counts, write_mask_counts


def test_counts_come_back(tmp_path: Path) -> None:
    counts = {"b/2.jpg": 0, 'a/"1".jpg': 1234}
    write_mask_counts(tmp_path, "rootsift", counts)
    assert read_mask_counts(tmp_path, "rootsift") == counts
    rows = mask_counts_path(tmp_path, "rootsift").read_text().splitlines()
    assert rows == ["image,num_masked", '"a/""1"".jpg",1234', "b/2.jpg,0"]
    assert read_mask_counts(tmp_path, "aliked-n16") == {}


@pytest.mark.parametrize("number", ["", "-1", "1.5", "many"])
def test_what_is_no_number_is_refused_by_line(tmp_path: Path, number: str) -> None:
    write_mask_counts(tmp_path, "rootsift", {"a.jpg": 1})
    path = mask_counts_path(tmp_path, "rootsift")
    path.write_text(f"image,num_masked\na.jpg,3\nb.jpg,{number}\n")
    with pytest.raises(DataError, match=r"masked\.csv:3: num_masked"):
        read_mask_counts(tmp_path, "rootsift")
