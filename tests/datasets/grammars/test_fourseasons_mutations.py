"""Random damage to every text file of 4Seasons: a value or one clear error, nothing else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from megloc_kapture.datasets.grammars.fourseasons_calibration import read_pinhole, read_stereo
from megloc_kapture.datasets.grammars.fourseasons_keyframes import read_keyframe
from megloc_kapture.datasets.grammars.fourseasons_poses import (
    read_gnss_poses,
    read_keyframe_accuracy,
    read_poses,
)
from megloc_kapture.datasets.grammars.fourseasons_relocalization import read_relocalization
from megloc_kapture.datasets.grammars.fourseasons_times import read_times
from megloc_kapture.datasets.grammars.fourseasons_transformations import read_transformations
from megloc_kapture.errors import DataError

pytestmark = pytest.mark.fuzz

TIME = 1602074877390449152
POSE = "-0.06,0.05,-0.15,0,0.6,0,0.8"
READERS: dict[Callable[[Path], Any], str] = {
    read_pinhole: "Pinhole 501.5 502.5 421.8 167.7 0.0 0.0 0.0 0.0\n800 400\ncrop\n800 400\n",
    read_stereo: "1.0 0.0 0.0 -0.3\n0.0 1.0 0.0 0.0\n0.0 0.0 1.0 0.0\n0.0 0.0 0.0 1.0\n",
    read_gnss_poses: f"# header\n{TIME},{POSE},0.96,2\n{TIME + 1},{POSE},0.96,2,0.5\n",
    read_poses: f"{TIME},{POSE}\n{TIME + 1},{POSE}\n".replace(",", " "),
    read_keyframe_accuracy: f"{TIME}\n{TIME + 1}\n",
    read_times: f"{TIME} 1602074877.39 0.25\r\n{TIME + 1} 1602074877.39 0.25\r\n",
    read_relocalization: f"{TIME} {TIME + 1}\n{TIME} {TIME + 2} {POSE.replace(',', ' ')}\n",
    read_transformations: f"# transform_S_AS: t, q\n{POSE}\n# transform_w_gpsw: t, q\n{POSE}\n"
    f"\n# transform_e_gpsw: t, q\n{POSE}\n# GNSS scale\n0.96\n",
    read_keyframe: f"# timestamp\n{TIME}\n\n# fx, fy\n1,1,1,1,8,4,1\n\n# camToWorld:\n{POSE}\n\n"
    "# Exposure\n0.25\n\n# Point Cloud\n# u,v\n1.0,2.0,0.5,9,0,0,1\n1,2,3,4,5,6,7,8,\n",
}
# what a mutation puts in: bytes at random, and what number parsers trip over
PIECES = st.one_of(
    st.binary(max_size=30),
    st.sampled_from(
        [
            b"nan",
            b"inf",
            b"-",
            b"1e999",
            b"1e308",
            b"9" * 400,
            b"\0",
            b"\xff\xfe",
            b"\r",
            b"#",
            b",",
        ]
        + ["\u0661\u0662".encode(), b"1_0", b"0x10", b"\n\n\n", b"\n"]
    ),
)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.__name__)
def test_undamaged(tmp_path: Path, reader: Callable[[Path], Any]) -> None:
    path = tmp_path / "file.txt"
    path.write_text(READERS[reader])
    assert reader(path) is not None


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.__name__)
@given(
    edits=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 40), PIECES), min_size=1, max_size=4)
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
def test_damaged(
    tmp_path: Path, reader: Callable[[Path], Any], edits: list[tuple[float, int, bytes]]
) -> None:
    content = READERS[reader].encode()
    for part, length, piece in edits:
        start = int(part * len(content))
        content = content[:start] + piece + content[start + length :]
    path = tmp_path / "file.txt"
    path.write_bytes(content)
    try:
        reader(path)
    except DataError as error:
        assert str(error).startswith(f"{path}:")
        assert "\n" not in str(error)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.__name__)
def test_no_text_files(tmp_path: Path, reader: Callable[[Path], Any]) -> None:
    for content, match in ((b"\xff\xfe\x00", "not a text file"), (b"a\n\0", "NUL character")):
        path = tmp_path / "file.txt"
        path.write_bytes(content)
        with pytest.raises(DataError, match=match):
            reader(path)
    with pytest.raises(DataError, match="cannot read"):
        reader(tmp_path)
    if reader is not read_keyframe_accuracy:  # an empty list of accurate keyframes is one
        path.write_bytes(b"")
        with pytest.raises(DataError):
            reader(path)
