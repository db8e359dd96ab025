"""Depth maps: raw float32 of exactly the sensor's size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.depth_maps import read_depth_map, write_depth_map


def test_depth_comes_back(tmp_path: Path) -> None:
    depth = np.array([[1.5, -1, 0], [2, 3, np.inf]])
    write_depth_map(tmp_path / "a" / "x.depth", depth.T.copy().T)
    read = read_depth_map(tmp_path / "a" / "x.depth", width=3, height=2)
    assert read.dtype == np.float32
    assert np.array_equal(read, depth.astype(np.float32))
    read[0, 0] = 7  # the caller's own


def test_a_file_that_starts_like_a_byte_order_mark_is_whole(tmp_path: Path) -> None:
    (tmp_path / "x.depth").write_bytes(b"\xef\xbb\xbf\x3f")
    assert read_depth_map(tmp_path / "x.depth", width=1, height=1).shape == (1, 1)


def test_another_size_is_refused(tmp_path: Path) -> None:
    write_depth_map(tmp_path / "x.depth", np.ones((2, 3)))
    for width, height in ((3, 3), (2, 2), (3, 1)):
        with pytest.raises(DataError, match=r"x\.depth: 24 bytes"):
            read_depth_map(tmp_path / "x.depth", width=width, height=height)
    with pytest.raises(DataError, match=r"y\.depth: file is missing"):
        read_depth_map(tmp_path / "y.depth", width=3, height=2)


def test_only_maps_are_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="shape"):
        write_depth_map(tmp_path / "x.depth", np.ones(3))
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="file/x.depth"):
        write_depth_map(tmp_path / "file" / "x.depth", np.ones((2, 3)))
