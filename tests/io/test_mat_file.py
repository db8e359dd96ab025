"""MAT files against SciPy, which writes and reads them too; what is none is refused."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hn
from scipy.io import loadmat, savemat
from scipy.sparse import csr_array

from megloc_kapture.errors import DataError
from megloc_kapture.io.mat_file import read_mat, read_mat_array, write_mat_arrays


def saved(values: dict[str, Any], *, compressed: bool = False, **options: Any) -> bytes:
    out = io.BytesIO()
    savemat(out, values, do_compression=compressed, **options)
    return out.getvalue()


def cell(*values: Any) -> Any:
    found = np.empty((1, len(values)), object)
    for column, value in enumerate(values):
        found[0, column] = value
    return found


NESTED = {
    "net": {
        "layers": cell(
            {"type": "conv", "weights": cell(np.arange(24.0).reshape(2, 3, 4), np.ones((1, 3)))},
            {"type": "relu"},
        ),
        "meta": {"normalization": {"averageImage": np.full((2, 2, 3), 7, np.float32)}},
        "nothing": np.zeros((0, 3)),
    },
    "beside": np.arange(3, dtype=np.int16),
}
DTYPES = [np.dtype(f"{kind}{size}") for kind in "iu" for size in (1, 2, 4, 8)]
NUMBERS = hn.arrays(
    st.sampled_from([*DTYPES, np.dtype("f4"), np.dtype("f8")]),
    hn.array_shapes(min_dims=2, max_dims=4, min_side=1, max_side=4),
)


@given(NUMBERS, st.booleans())
def test_numbers_are_those_that_scipy_wrote_and_reads(values: Any, compressed: bool) -> None:
    content = saved({"a": values}, compressed=compressed)
    found = read_mat(content)["a"]
    expected = loadmat(io.BytesIO(content))["a"]
    assert isinstance(found, np.ndarray) and found.shape == expected.shape == values.shape
    np.testing.assert_array_equal(found, values)
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == values.dtype


@pytest.mark.parametrize("compressed", [False, True])
def test_cells_structs_and_text(compressed: bool) -> None:
    rows = np.zeros((1, 2), [("a", object), ("b", object)])
    rows[0, 0], rows[0, 1] = (1.0, "one"), (2.0, "zwei \u00fc")
    left_out = {"sparse": csr_array(np.eye(3)), "complex": np.array([1 + 2j])}
    content = {"rows": rows, **left_out, **NESTED}
    found: Any = read_mat(saved(content, compressed=compressed))
    assert list(found) == list(content)
    assert [row["b"] for row in found["rows"]] == ["one", "zwei \u00fc"]
    assert [float(row["a"][0, 0]) for row in found["rows"]] == [1, 2]
    assert found["sparse"] is None and found["complex"] is None
    first, second = found["net"]["layers"]
    assert first["type"] == "conv" and second == {"type": "relu"}
    np.testing.assert_array_equal(first["weights"][0], np.arange(24.0).reshape(2, 3, 4))
    assert first["weights"][1].shape == (1, 3)
    image = found["net"]["meta"]["normalization"]["averageImage"]
    assert image.dtype == np.float32 and image.shape == (2, 2, 3) and (image == 7).all()
    assert found["net"]["nothing"].shape == (0, 3)
    np.testing.assert_array_equal(found["beside"], [[0, 1, 2]])


def element(order: str, kind: int, body: bytes) -> bytes:
    return struct.pack(order + "II", kind, len(body)) + body + bytes(-len(body) % 8)


def test_the_other_byte_order() -> None:
    """SciPy writes only the machine's; this file is put together by hand."""
    body = element(">", 6, struct.pack(">II", 7, 0)) + element(">", 5, struct.pack(">ii", 2, 3))
    # the name stands in its tag
    body += struct.pack(">I", 1 << 16 | 1) + b"a\0\0\0"
    body += element(">", 7, struct.pack(">6f", *range(6)))
    content = b" " * 124 + struct.pack(">H", 0x0100) + b"MI" + element(">", 14, body)
    found: Any = read_mat(content)["a"]
    np.testing.assert_array_equal(found, [[0, 2, 4], [1, 3, 5]])
    np.testing.assert_array_equal(loadmat(io.BytesIO(content))["a"], found)


def packed(body: bytes) -> bytes:
    """A MAT file of one packed element."""
    whole = zlib.compress(body)
    return saved({})[:128] + struct.pack("<II", 15, len(whole)) + whole


def deep(levels: int) -> Any:
    value: Any = np.ones((1, 1))
    for _ in range(levels):
        value = cell(value)
    return value


PLAIN = saved({"a": np.arange(6.0).reshape(2, 3)})
AT_DIMS, AT_KIND = PLAIN.index(struct.pack("<IIii", 5, 8, 2, 3)) + 8, -6 * 8 - 8
REFUSED = {
    "empty": (b"", "none of level 5"),
    "web page": (b"<!DOCTYPE html>" * 20, "none of level 5"),
    "level 4": (saved({"a": np.ones(2)}, format="4"), "none of level 5"),
    "level 7.3": (PLAIN[:124] + b"\x00\x02IM" + PLAIN[128:], r"level 7\.3 \(HDF5\)"),
    "level 9": (PLAIN[:124] + b"\x00\x09IM" + PLAIN[128:], "its level is 0x900"),
    "cut short": (PLAIN[:-20], "ends too early"),
    "cut short in a tag": (PLAIN[:131], "ends too early, in the variable at byte 128"),
    "packed cut short": (packed(PLAIN[128:])[:-12], "ends too early"),
    "longer than said": (packed(PLAIN[128:] + bytes(99)), "more is packed"),
    "shorter than said": (packed(struct.pack("<II", 14, 500) + bytes(99)), "too early"),
    "two gigabytes": (packed(struct.pack("<II", 14, 1 << 31) + bytes(9)), "more than 2147483648"),
    "too much for its size": (
        packed(struct.pack("<II", 14, 1 << 20) + bytes(9)),
        "more than there",
    ),
    "another check sum": (packed(PLAIN[128:])[:-4] + b"1234", "while decompressing"),
    "without check sum": (packed(PLAIN[128:])[:-2], "ends too early"),
    "HDF5": (b"\x89HDF\r\n\x1a\n" + bytes(600), r"level 7\.3 \(HDF5\)"),
    "HDF5 behind a block": (bytes(512) + b"\x89HDF\r\n\x1a\n", r"level 7\.3 \(HDF5\)"),
    "not packed": (saved({})[:128] + struct.pack("<II", 15, 90) + bytes(90), "while decompressing"),
    "too deep": (saved({"a": deep(40)}), "more than 32 arrays in one another"),
    "shape": (PLAIN[:AT_DIMS] + struct.pack("<i", -2) + PLAIN[AT_DIMS + 4 :], r"shape \(-2, 3\)"),
    "size": (PLAIN[:AT_DIMS] + struct.pack("<i", 9) + PLAIN[AT_DIMS + 4 :], "48 bytes for an"),
    # the type that SciPy follows a wild pointer for
    "type": (PLAIN[:AT_KIND] + b"\x08" + PLAIN[AT_KIND + 1 :], "numbers of type 8"),
}


@pytest.mark.parametrize(("content", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_refused(content: bytes, message: str) -> None:
    with pytest.raises(DataError, match=rf"^not a MAT file that can be read: .*{message}"):
        read_mat(content)


def test_many_cells_in_few_bytes_are_refused_before_they_are_made() -> None:
    content = saved({"c": cell(np.ones((1, 1)), np.ones((1, 1)))})
    shape = struct.pack("<ii", 1, 2)
    huge = content.replace(shape, struct.pack("<ii", 1 << 30, 1 << 30), 1)
    assert huge != content
    with pytest.raises(DataError, match="1152921504606846976 arrays in"):
        read_mat(huge)


# --------------------------------------------------------------------------- one array of a file


def points() -> np.ndarray:
    values = np.random.default_rng(0).normal(0, 5, (5, 7, 3))
    values[1, 2] = np.nan
    return values


COLOURS = np.arange(5 * 7 * 3, dtype=np.uint8).reshape(5, 7, 3)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.jpg.mat"


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_one_array_of_what_scipy_writes(path: Path, compressed: bool, dtype: type) -> None:
    written = points().astype(dtype)
    path.write_bytes(saved({"RGBcut": COLOURS, "XYZcut": written}, compressed=compressed))
    read = read_mat_array(path, "XYZcut")
    assert read.dtype == np.float64
    np.testing.assert_array_equal(read, written)


def test_what_we_write_scipy_reads_and_the_bytes_are_the_same_each_time(path: Path) -> None:
    content = {"RGBcut": COLOURS, "XYZcut": points(), "s": COLOURS[0] / np.float32(7)}
    write_mat_arrays(path, content)
    read = loadmat(path)
    np.testing.assert_array_equal(read["XYZcut"], points())
    np.testing.assert_array_equal(read["RGBcut"], COLOURS)
    assert read["RGBcut"].dtype == np.uint8 and read["s"].dtype == np.float32
    np.testing.assert_array_equal(read_mat_array(path, "XYZcut"), points())
    assert path.read_bytes()[:124] == b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8)
    for array in (np.zeros(3), np.zeros((2, 2), np.complex128)):
        with pytest.raises(ValueError, match="cannot write"):
            write_mat_arrays(path.with_name("b.mat"), {"a": array})
    assert not path.with_name("b.mat").exists()


def test_matlab_may_store_whole_numbers_as_such(path: Path) -> None:
    parts = [(6, struct.pack("<II", 6, 0)), (5, struct.pack("<2i", 2, 2)), (1, b"XYZcut")]
    parts.append((3, struct.pack("<4h", -1, 2, 3, -4)))
    body = b"".join(element("<", *part) for part in parts)
    path.write_bytes(saved({})[:128] + element("<", 14, body))
    np.testing.assert_array_equal(read_mat_array(path, "XYZcut"), [[-1, 3], [2, -4]])
    np.testing.assert_array_equal(loadmat(path)["XYZcut"], [[-1, 3], [2, -4]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (saved({}), "no variable 'a'; it has none"),
        (saved({"b": np.ones((1, 1)), "c": "text"}), "no variable 'a'; it has 'b', 'c'"),
        (saved({"a": cell(np.ones((1, 1)))}), r"no array of real numbers \(class 1\), in the var"),
        (saved({"a": np.array([[1 + 2j]])}), "no array of real numbers"),
        (PLAIN[:-8], "96 bytes announced, 88 there, in the variable at byte 128"),
        (PLAIN[:128] + struct.pack("<IId", 9, 8, 1.0), "data type 9, not an array"),
        (packed(bytes(99)), "requires a buffer|ends too early|shape"),
    ],
)
def test_files_without_that_array_are_refused(path: Path, content: bytes, message: str) -> None:
    path.write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        read_mat_array(path, "a")
    assert str(caught.value).startswith(f"{path}: ")
    with pytest.raises(DataError, match="missing"):
        read_mat_array(path.with_name("none.mat"), "a")


def test_a_broken_variable_that_is_not_asked_for_does_no_harm(path: Path) -> None:
    broken = packed(saved({"b": np.ones((9, 9))})[128:])[:-4] + b"1234"
    path.write_bytes(broken + PLAIN[128:])
    np.testing.assert_array_equal(read_mat_array(path, "a"), np.arange(6.0).reshape(2, 3))
