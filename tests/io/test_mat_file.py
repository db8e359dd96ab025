"""MAT files: what SciPy's writer makes of plain values comes back as plain values."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from megloc_kapture.errors import DataError
from megloc_kapture.io.mat_file import read_mat, read_mat_array, write_mat_arrays


def saved(content: dict[str, Any], *, compressed: bool = True) -> bytes:
    out = BytesIO()
    savemat(out, content, do_compression=compressed)
    return out.getvalue()


@pytest.mark.parametrize("compressed", [False, True])
def test_structs_and_cells_become_dicts_and_lists(compressed: bool) -> None:
    cell = np.empty((2, 1), object)
    cell[:, 0] = [np.ones((2, 3)), "text"]
    layers = np.empty((1, 2), object)
    layers[0] = [{"weights": cell}, {"kind": "relu"}]
    found: Any = read_mat(saved({"net": {"layers": layers, "name": "n"}}, compressed=compressed))
    net = found["net"]
    assert net["name"] == "n"
    first, second = net["layers"]
    np.testing.assert_array_equal(first["weights"][0], np.ones((2, 3)))
    assert first["weights"][1] == "text" and second == {"kind": "relu"}


def test_one_array_of_a_file_is_read_as_float64(tmp_path: Path) -> None:
    path = tmp_path / "x.mat"
    points = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    write_mat_arrays(path, {"XYZcut": points, "other": np.ones((1, 1))})
    read = read_mat_array(path, "XYZcut")
    assert read.dtype == np.float64
    np.testing.assert_array_equal(read, points)
    before = path.read_bytes()
    write_mat_arrays(path, {"XYZcut": points, "other": np.ones((1, 1))})
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "not a MAT file"),
        (b"no mat file" * 20, "not a MAT file"),
        (b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400), "not a MAT file"),
        (saved({"XYZ": np.ones((30, 30))})[:180], "not a MAT file"),
        (saved({"a": np.ones((2, 2))}), "no variable 'XYZ'"),
        (saved({"XYZ": "text"}), "no array of real numbers"),
        (saved({"XYZ": np.ones((2, 2)) * 1j}), "no array of real numbers"),
    ],
)
def test_broken_files_are_named(tmp_path: Path, content: bytes, match: str) -> None:
    path = tmp_path / "x.mat"
    path.write_bytes(content)
    with pytest.raises(DataError, match=rf"x\.mat: .*{match}"):
        read_mat_array(path, "XYZ")
