"""Tables of challenges: what is written is read, in its order; what is broken is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.challenge_tables import (
    RelocalizationPair,
    read_names,
    read_relocalization,
    write_names,
    write_relocalization,
)


def test_names_keep_their_order(tmp_path: Path) -> None:
    names = {"rain/rear/2.jpg": "rear/2.png", "dawn/rear/1.jpg": "rear/1.png"}
    write_names(tmp_path, names)
    assert list(read_names(tmp_path).items()) == list(names.items())
    assert (tmp_path / "names.csv").read_text().splitlines()[1] == "rain/rear/2.jpg,rear/2.png"


def test_pairs_keep_their_order(tmp_path: Path) -> None:
    pairs = [RelocalizationPair("b.txt", "r/2.png", "q/1.png")] * 2
    pairs.append(RelocalizationPair("a.txt", "r/1.png", "q/1.png"))
    write_relocalization(tmp_path, pairs)
    assert read_relocalization(tmp_path) == pairs


def test_absent_tables_are_empty(tmp_path: Path) -> None:
    assert read_names(tmp_path) == {} and read_relocalization(tmp_path) == []


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("a.jpg,x\na.jpg,y\n", r"names\.csv:3: 'a\.jpg' or 'y' is given twice"),
        ("a.jpg,x\nb.jpg,x\n", r"names\.csv:3: .*'x' is given twice"),
        ("a.jpg,x y\n", r"names\.csv:2: a pose file cannot hold the name 'x y'"),
        ("../a.jpg,x\n", r"names\.csv:2: "),
        ("a.jpg\n", r"names\.csv:2: "),
    ],
)
def test_broken_names(tmp_path: Path, rows: str, message: str) -> None:
    (tmp_path / "names.csv").write_text(f"image,name\n{rows}")
    with pytest.raises(DataError, match=message):
        read_names(tmp_path)


def test_a_pose_file_outside_is_refused(tmp_path: Path) -> None:
    (tmp_path / "relocalization.csv").write_text("file,reference,query\n../../x.txt,a,b\n")
    with pytest.raises(DataError, match=r"relocalization\.csv:2: "):
        read_relocalization(tmp_path)
    with pytest.raises(DataError):
        write_relocalization(tmp_path, [RelocalizationPair("/etc/x", "a", "b")])
