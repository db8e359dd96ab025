"""MATLAB files, against scipy's reader and writer; broken ones; random mutations."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from megloc_kapture.datasets.grammars.mat_file import read_mat_array, write_mat_arrays
from megloc_kapture.errors import DataError


def points() -> np.ndarray:
    values = np.random.default_rng(0).normal(0, 5, (5, 7, 3))
    values[1, 2] = np.nan
    return values


COLOURS = np.arange(5 * 7 * 3, dtype=np.uint8).reshape(5, 7, 3)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.jpg.mat"


def mat(version: bytes = b"\x00\x01IM", *elements: bytes) -> bytes:
    return b"MATLAB 5.0 MAT-file".ljust(124) + version + b"".join(elements)


def element(kind: int, data: bytes, order: str = "<") -> bytes:
    return struct.pack(f"{order}II", kind, len(data)) + data + bytes(-len(data) % 8)


def matrix(
    *, flags: int = 6, shape: tuple[int, ...] = (2, 2), data: bytes = bytes(32), kind: int = 9
) -> bytes:
    return element(
        14,
        element(6, struct.pack("<II", flags, 0))
        + element(5, struct.pack(f"<{len(shape)}i", *shape))
        + element(1, b"XYZcut")
        + element(kind, data),
    )


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_what_scipy_writes_is_read(path: Path, compressed: bool, dtype: type) -> None:
    written = points().astype(dtype)
    content = {"RGBcut": COLOURS, "XYZcut": written}
    scipy.io.savemat(path, content, do_compression=compressed)
    read = read_mat_array(path, "XYZcut")
    assert read.dtype == np.float64
    np.testing.assert_array_equal(read, written)


def test_what_we_write_scipy_reads(path: Path) -> None:
    write_mat_arrays(path, {"RGBcut": COLOURS, "XYZcut": points(), "s": COLOURS[0] / np.float32(7)})
    read = scipy.io.loadmat(path)
    np.testing.assert_array_equal(read["XYZcut"], points())
    np.testing.assert_array_equal(read["RGBcut"], COLOURS)
    assert read["RGBcut"].dtype == np.uint8 and read["s"].dtype == np.float32
    np.testing.assert_array_equal(read_mat_array(path, "XYZcut"), points())
    first = path.read_bytes()
    write_mat_arrays(path, {"RGBcut": COLOURS, "XYZcut": points(), "s": COLOURS[0] / np.float32(7)})
    assert path.read_bytes() == first


def test_matlab_may_store_whole_numbers_as_such(path: Path) -> None:
    data = struct.pack("<4h", -1, 2, 3, -4)
    path.write_bytes(mat(b"\x00\x01IM", matrix(data=data, kind=3)))
    np.testing.assert_array_equal(read_mat_array(path, "XYZcut"), [[-1, 3], [2, -4]])
    np.testing.assert_array_equal(scipy.io.loadmat(path)["XYZcut"], [[-1, 3], [2, -4]])


def test_files_of_big_endian_machines(path: Path) -> None:
    body = (
        element(6, struct.pack(">II", 6, 0), ">")
        + element(5, struct.pack(">2i", 1, 2), ">")
        + struct.pack(">HH", 3, 1)
        + b"XYZ\0"  # a name this short stands in its tag
        + element(9, struct.pack(">2d", 1.5, -2.5), ">")
    )
    path.write_bytes(mat(b"\x01\x00MI", element(14, body, ">")))
    np.testing.assert_array_equal(read_mat_array(path, "XYZ"), [[1.5, -2.5]])
    np.testing.assert_array_equal(scipy.io.loadmat(path)["XYZ"], [[1.5, -2.5]])


def test_version_7_3_is_named(path: Path) -> None:
    for content in (
        b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n",
        b"\x89HDF\r\n\x1a\n" + bytes(600),
        bytes(512) + b"\x89HDF\r\n\x1a\n",
    ):
        path.write_bytes(content)
        with pytest.raises(DataError, match=r"a\.jpg\.mat: a MATLAB 7\.3 \(HDF5\) file"):
            read_mat_array(path, "XYZcut")


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "not a MATLAB file of version 5 to 7"),
        (b"\xff\xd8\xff\xe0" * 40, "not a MATLAB file of version 5 to 7"),
        (mat(), "no variable 'XYZcut'; it has none"),
        (mat(b"\x00\x01IM", b"123"), "truncated, in the variable at byte 128"),
        (mat(b"\x00\x01IM", element(9, bytes(8))), "data type 9, not an array"),
        (mat(b"\x00\x01IM", matrix()[:-8]), "88 bytes announced, 80 there"),
        (mat(b"\x00\x01IM", matrix(flags=1)), "no array of real numbers"),
        (mat(b"\x00\x01IM", matrix(flags=6 | 0x800)), "no array of real numbers"),
        (mat(b"\x00\x01IM", matrix(shape=(2, 3))), r"its 32 bytes are not \(2, 3\) numbers"),
        (mat(b"\x00\x01IM", matrix(shape=(-2, -2))), r"not \(-2, -2\) numbers"),
        (mat(b"\x00\x01IM", matrix(shape=(2**31 - 1,) * 4)), "numbers, in the variable"),
        (mat(b"\x00\x01IM", matrix(shape=(4,))), "its dimensions take 4 bytes"),
        (mat(b"\x00\x01IM", matrix(kind=16)), "its numbers have the data type 16"),
        (mat(b"\x00\x01IM", element(15, b"no zlib")), "cannot be unpacked"),
        (mat(b"\x00\x01IM", element(15, zlib.compress(b"1234"))), "truncated"),
        (mat(b"\x00\x01IM", element(15, zlib.compress(bytes(99)))), "data type 0"),
    ],
)
def test_broken_files_are_refused(path: Path, content: bytes, match: str) -> None:
    path.write_bytes(content)
    with pytest.raises(DataError, match=match) as caught:
        read_mat_array(path, "XYZcut")
    assert str(caught.value).startswith(f"{path}: ")


def test_a_compressed_array_must_be_whole(path: Path) -> None:
    packed = zlib.compress(matrix())
    for content, match in (
        (packed[:-9], "88 bytes announced, [0-9]+ there"),
        (packed[:-2], "truncated"),
        (packed[:-4] + b"1234", "cannot be unpacked"),  # a wrong check sum
        (zlib.compress(matrix()[:-8]), "88 bytes announced, 80 there"),
        (zlib.compress(matrix() + bytes(8)), "88 bytes announced, 88 and more there"),
        # a count that no stream of this size can hold, and nothing is allocated for
        (zlib.compress(struct.pack("<II", 14, 2**32 - 1) + matrix()[8:]), "more than there can be"),
    ):
        path.write_bytes(mat(b"\x00\x01IM", struct.pack("<II", 15, len(content)) + content))
        with pytest.raises(DataError, match=match):
            read_mat_array(path, "XYZcut")


def test_what_is_no_file_is_refused(path: Path) -> None:
    with pytest.raises(DataError, match="missing"):
        read_mat_array(path, "XYZcut")
    with pytest.raises(DataError, match="not a plain file"):
        read_mat_array(path.parent, "XYZcut")


def test_the_names_that_are_there_are_told(path: Path) -> None:
    write_mat_arrays(path, {"RGBcut": COLOURS})
    with pytest.raises(DataError, match="no variable 'XYZcut'; it has 'RGBcut'"):
        read_mat_array(path, "XYZcut")


def test_what_cannot_be_written_is_refused(path: Path) -> None:
    for array in (np.zeros(3), np.zeros((2, 2), np.int64)):
        with pytest.raises(ValueError, match="cannot write"):
            write_mat_arrays(path, {"a": array})
    assert not path.exists()


@pytest.mark.fuzz
@given(st.booleans(), st.integers(0, 1200), st.integers(0, 20), st.binary(max_size=20))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=400)
def test_mutations_are_read_or_refused(
    path: Path, compressed: bool, start: int, length: int, new: bytes
) -> None:
    if compressed:
        write_mat_arrays(path, {"RGBcut": COLOURS, "XYZcut": points()})
    else:
        scipy.io.savemat(path, {"XYZcut": points()})
    content = path.read_bytes()
    path.write_bytes(content[:start] + new + content[start + length :])
    try:
        read = read_mat_array(path, "XYZcut")
    except DataError as error:
        assert str(error).startswith(f"{path}: ")
        assert "\n" not in str(error)
    else:
        assert read.dtype == np.float64 and read.size * 8 <= len(content) * 1032
