"""3D points: one grammar, two readers, exact numbers; covariances beside them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hostile import NUMBERS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import points as module
from megloc_kapture.io.kapture import write_ply
from megloc_kapture.io.kapture.points import (
    COVARIANCES_FILE,
    read_point_covariances,
    read_points3d,
    write_point_covariances,
    write_points3d,
)

VERSION = "# kapture format: 1.1\n"
POINTS = VERSION + "# X, Y, Z, R, G, B\n"
OBSERVATIONS = VERSION + "# point3d_id, keypoints_type, [image_path, feature_id]*\n"
RNG = np.random.default_rng(0)

# both readers are asked everything: files of any size go to the one or to the other
PLAIN, PANDAS = 1 << 62, 0
BOTH = pytest.mark.parametrize("large_bytes", [PLAIN, PANDAS], ids=["plain", "pandas"])


def file(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


# -------------------------------------------------------------------------------------- points


@BOTH
@pytest.mark.parametrize("columns", [3, 6])
def test_points_come_back_exactly(tmp_path: Path, columns: int, large_bytes: int) -> None:
    bits = RNG.integers(0, 2**63, (2000, columns)).view(np.float64)
    points = np.where(np.isfinite(bits), bits, 1 / 3)
    write_points3d(tmp_path, points)
    read = read_points3d(tmp_path / "reconstruction/points3d.txt", large_bytes=large_bytes)
    assert read.shape == (2000, 6) and read.dtype == np.float64
    assert np.array_equal(read[:, :columns], points)
    assert not read[:, columns:].any()


def test_the_layout_of_points_is_kapture_s(tmp_path: Path) -> None:
    write_points3d(tmp_path, [[0.1, -2, 3e-20, 255, 0, 7.5]])
    text = (tmp_path / "reconstruction/points3d.txt").read_text()
    assert text == POINTS + "0.1,-2.0,3e-20,255.0,0.0,7.5\n"
    write_points3d(tmp_path, np.zeros((0, 3)))
    text = (tmp_path / "reconstruction/points3d.txt").read_text()
    assert text == VERSION + "# X, Y, Z\n"


@BOTH
@pytest.mark.parametrize("content", ["", VERSION, POINTS, POINTS + "\n \n# only comments"])
def test_no_points_are_none(tmp_path: Path, content: str, large_bytes: int) -> None:
    read = read_points3d(file(tmp_path / "p.txt", content), large_bytes=large_bytes)
    assert read.shape == (0, 6)


@BOTH
def test_unusual_but_good_points_are_read(tmp_path: Path, large_bytes: int) -> None:
    content = "\ufeff" + POINTS + " +1. ,\t.5,-1e+2\r\n\r\n#\n1,2,3\u00a0\n00001,2E0,3"
    read = read_points3d(file(tmp_path / "p.txt", content), large_bytes=large_bytes)
    assert read[:, :3].tolist() == [[1, 0.5, -100], [1, 2, 3], [1, 2, 3]]


@BOTH
@pytest.mark.parametrize(
    ("row", "match"),
    [
        ("1,2,3,4,5", "expected 6 columns, got 5"),
        ("1,2,3,4,5,6,7", "expected 6 columns, got 7"),
        ("1,2,3", "expected 6 columns, got 3"),
        ("1,2,3,4,5,", "'' is not a number"),
        ("1,2,3,4,5,x", "'x' is not a number"),
        ("1,2,3,4,5,nan", "'nan' is not finite"),
        ("1,2,3,4,5,-inf", "not finite"),
        ("1,2,3,4,5,1e999", "not finite"),
        ("1,2,3,4,5,0x10", "not a number"),
        ("1,2,3,4,5,1_0", "not a number"),
        ("1,2,3,4,5,1 0", "not a number"),
        ("1,2,3,4,5,1e", "not a number"),
        ("1,2,3,4,5,.", "not a number"),
        ("1,2,3,4,5,--1", "not a number"),
        ("1,2,3,4,5,6\0", "NUL character"),
        ('1,2,3,4,5,"6"', "not a number"),
        ("1,2,3,4,5,True", "not a number"),
        ("1,2,3,4,5,6\r1,2,3,4,5,6", "expected 6 columns, got 11"),
        ("1,2,3,4,5,6 # six", "not a number"),
        (" # six", "comment must begin in the first column"),
    ],
)
def test_bad_points_name_file_and_line(
    tmp_path: Path, row: str, match: str, large_bytes: int
) -> None:
    path = file(tmp_path / "p.txt", POINTS + "1,2,3,4,5,6\n" * 20 + row + "\n1,2,3,4,5,6\n")
    with pytest.raises(DataError, match=match) as caught:
        read_points3d(path, large_bytes=large_bytes)
    assert f"{path}:23: " in str(caught.value)


@BOTH
def test_points_have_three_or_six_columns(tmp_path: Path, large_bytes: int) -> None:
    with pytest.raises(DataError, match=r"p\.txt:1: expected 3 or 6 columns, got 4"):
        read_points3d(file(tmp_path / "p.txt", "1,2,3,4\n"), large_bytes=large_bytes)


@given(st.lists(NUMBERS, min_size=3, max_size=30))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=100)
def test_pandas_finds_the_nearest_float(tmp_path: Path, numbers: list[str]) -> None:
    numbers = numbers[: len(numbers) // 3 * 3]
    rows = [",".join(numbers[i : i + 3]) for i in range(0, len(numbers), 3)]
    read = module._read_plain(file(tmp_path / "p.txt", "\n".join(rows)))
    assert read is not None
    expected = np.array([float(text) for text in numbers])
    assert np.array_equal(read.ravel().view(np.uint64), expected.view(np.uint64))


def test_points_that_cannot_be_stored_are_refused(tmp_path: Path) -> None:
    for wrong in (np.zeros(3), np.zeros((2, 4)), [[1, 2, np.nan]], [[1, 2, np.inf]]):
        with pytest.raises(ValueError, match="points"):
            write_points3d(tmp_path, wrong)
    assert list(tmp_path.iterdir()) == []


VALUES = np.arange(18.0).reshape(3, 6)


def test_they_are_read_as_written_and_cannot_be_changed(tmp_path: Path) -> None:
    values = VALUES.copy()
    values[1] = np.nan
    write_point_covariances(tmp_path, values)
    found = read_point_covariances(tmp_path, 3)
    assert found is not None and not found.flags.writeable
    np.testing.assert_array_equal(found, values)
    np.testing.assert_array_equal(np.load(tmp_path / COVARIANCES_FILE), values)


def test_a_map_without_has_none(tmp_path: Path) -> None:
    assert read_point_covariances(tmp_path, 3) is None


@pytest.mark.parametrize("values", [VALUES[:2], VALUES[:, :5], VALUES.astype(np.float32)])
def test_those_of_another_map_are_refused(tmp_path: Path, values: np.ndarray) -> None:
    path = tmp_path / COVARIANCES_FILE
    path.parent.mkdir()
    np.save(path, values)
    with pytest.raises(DataError, match=r"expected float64 \(3, 6\)"):
        read_point_covariances(tmp_path, 3)


@pytest.mark.parametrize("content", [b"", b"no array", b"\x93NUMPY\x01\x00"])
def test_what_is_no_array_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / COVARIANCES_FILE
    path.parent.mkdir()
    path.write_bytes(content)
    with pytest.raises(DataError, match="no array"):
        read_point_covariances(tmp_path, 3)


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    path = tmp_path / COVARIANCES_FILE
    path.parent.mkdir()
    np.save(path, np.array([object()] * 3), allow_pickle=True)
    with pytest.raises(DataError):
        read_point_covariances(tmp_path, 3)


# ---------------------------------------------------------------------------------------------- PLY

XYZ = np.random.default_rng(0).normal(size=(100, 3))
COLOURS = np.random.default_rng(1).integers(0, 256, (100, 3)).astype(np.uint8)


def test_colmap_reads_what_was_written(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    write_ply(tmp_path / "points.ply", XYZ, COLOURS, deviation=np.arange(100))
    reconstruction = pycolmap.Reconstruction()
    reconstruction.import_PLY(str(tmp_path / "points.ply"))
    points = [reconstruction.points3D[number] for number in sorted(reconstruction.points3D)]
    # COLMAP keeps them in single precision
    np.testing.assert_allclose([point.xyz for point in points], XYZ, rtol=1e-6)
    np.testing.assert_array_equal([point.color for point in points], COLOURS)


def test_points_far_from_the_origin_keep_their_digits(tmp_path: Path) -> None:
    far = XYZ + [4.2e6, 6.6e5, 4.7e6]
    write_ply(tmp_path / "points.ply", far, COLOURS, deviation=np.arange(100), kept=np.ones(100))
    header, _, body = (tmp_path / "points.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[1:] for line in header.decode().splitlines() if "property" in line]
    assert names == [
        *(["double", axis] for axis in "xyz"),
        *(["uchar", colour] for colour in ("red", "green", "blue")),
        ["float", "deviation"],
        ["float", "kept"],
    ]
    rows = np.frombuffer(body, np.dtype("<f8, <f8, <f8, u1, u1, u1, <f4, <f4"))
    np.testing.assert_array_equal(np.stack([rows[f"f{k}"] for k in range(3)], axis=1), far)
    np.testing.assert_array_equal(rows["f6"], np.arange(100))


def test_no_point_is_a_file_as_well(tmp_path: Path) -> None:
    write_ply(tmp_path / "points.ply", np.zeros((0, 3)), np.zeros((0, 3)))
    assert b"element vertex 0\n" in (tmp_path / "points.ply").read_bytes()


def test_different_lengths_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="differ in length"):
        write_ply(tmp_path / "points.ply", XYZ, COLOURS, deviation=[1.0])
    assert not (tmp_path / "points.ply").exists()
