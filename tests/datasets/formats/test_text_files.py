"""Valid text files of every format, with other line ends, and files of other formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.datasets import fourseasons as fourseasons_files
from megloc_kapture.datasets import robotcar
from megloc_kapture.datasets.inloc import read_transformation, read_wrong_scans
from megloc_kapture.errors import DataError
from megloc_kapture.io.camera_list import read_camera_rows
from megloc_kapture.io.text_lines import read_rigid_matrix

TIME = 1602074877390449152
POSE = "-0.06,0.05,-0.15,0,0.6,0,0.8"
MATRIX = "0 -1 0 5.0\n1 0 0 2.0\n0 0 1 -1e-1\n0 0 0 1\n"
TEXTS: dict[Callable[[Path], Any], str] = {
    fourseasons_files.read_pinhole: "Pinhole 501.5 502.5 421.8 167.7 0.0 0.0 0.0 0.0\n800 400\n"
    "crop\n800 400\n",
    read_rigid_matrix: MATRIX,
    fourseasons_files.read_gnss_poses: f"# header\n{TIME},{POSE},0.96,2\n{TIME + 1},{POSE},1,2,5\n",
    fourseasons_files.read_poses: f"{TIME},{POSE}\n{TIME + 1},{POSE}\n".replace(",", " "),
    fourseasons_files.read_relocalization: f"{TIME} 1\n{TIME} 2 {POSE.replace(',', ' ')}\n",
    fourseasons_files.read_transformations: f"# transform_S_AS: t, q\n{POSE}\n"
    f"# transform_w_gpsw: t\n{POSE}\n\n# transform_e_gpsw: t, q\n{POSE}\n# GNSS scale\n0.96\n",
    robotcar.read_intrinsics: "fx 400.0\nfy 400.0\ncx 508.2\ncy 498.187378\n",
    robotcar.read_query_location: "dawn/left/1418721355075498.jpg\ndawn/rear/14.jpg\n",
    robotcar.read_test_list: "rear/1418721355075498.png\nrear/1418721354984638.png\n",
    robotcar.read_train_poses: "dawn/rear/1.png 1 0 0 10.0 0 1 0 0.0 0 0 1 -2.0 0 0 0 1\n",
    read_camera_rows: "query/day/a.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600 -0.0353\r\n"
    "query/b.jpg PINHOLE 768 1024 971.838 384 512 -0.00177789",
    read_transformation: f"Before general icp:\n{MATRIX}\nAfter general icp:\n{MATRIX}",
    read_wrong_scans: "known wrong:\n\n008\nDUC_scan_12.ptx 31\r\n2017\n",
}

READERS = pytest.mark.parametrize("reader", TEXTS, ids=lambda reader: reader.__name__)


@READERS
def test_line_ends_and_blanks_do_not_matter(tmp_path: Path, reader: Callable[[Path], Any]) -> None:
    text, path = TEXTS[reader].replace("\r\n", "\n"), tmp_path / "file.txt"
    path.write_bytes(text.encode())
    expected = repr(reader(path))
    for other in (
        text.replace("\n", "\r\n"),
        text.rstrip("\n"),
        text + "\n \r\n",
        "\ufeff" + text,
        "".join(f" {line}\t\n" for line in text.split("\n")),
    ):
        path.write_bytes(other.encode())
        assert repr(reader(path)) == expected, other


@READERS
def test_what_is_no_such_file(tmp_path: Path, reader: Callable[[Path], Any]) -> None:
    path = tmp_path / "file.txt"
    for content in (b"", b"\n\r\n  \n", b"\xef\xbb\xbf"):
        path.write_bytes(content)
        if reader is read_wrong_scans:
            assert not reader(path)
        else:
            with pytest.raises(DataError, match=r"file\.txt\b"):
                reader(path)
    path.write_bytes(b"1\n2 \xff")
    with pytest.raises(DataError, match=r"file\.txt:2: not a text file in UTF-8"):
        reader(path)
    path.unlink()
    with pytest.raises(DataError, match=r"file\.txt: cannot read: the file is missing"):
        reader(path)
    path.mkdir()
    with pytest.raises(DataError, match=r"file\.txt: cannot read"):
        reader(path)
