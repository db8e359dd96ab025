"""3D points and their observations: what is written reads back, what is broken is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import points as observations
from megloc_kapture.io.kapture import write_ply
from megloc_kapture.io.kapture.points import (
    COVARIANCES_FILE,
    Observations,
    read_observations,
    read_point_covariances,
    read_points3d,
    write_observations,
    write_point_covariances,
    write_points3d,
)

VERSION = "# kapture format: 1.1\n"
POINTS = VERSION + "# X, Y, Z, R, G, B\n"
RNG = np.random.default_rng(0)


def file(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


# -------------------------------------------------------------------------------------- points


@pytest.mark.parametrize("columns", [3, 6])
def test_points_come_back_exactly(tmp_path: Path, columns: int) -> None:
    bits = RNG.integers(0, 2**63, (2000, columns)).view(np.float64)
    points = np.where(np.isfinite(bits), bits, 1 / 3)
    write_points3d(tmp_path, points)
    read = read_points3d(tmp_path / "reconstruction/points3d.txt")
    assert read.shape == (2000, 6) and read.dtype == np.float64
    assert np.array_equal(read[:, :columns], points)
    assert not read[:, columns:].any()


@pytest.mark.parametrize("content", ["", POINTS, POINTS + "\n\n# only comments"])
def test_no_points_are_none(tmp_path: Path, content: str) -> None:
    read = read_points3d(file(tmp_path / "p.txt", content))
    assert read.shape == (0, 6)


def test_unusual_but_good_points_are_read(tmp_path: Path) -> None:
    content = "\ufeff" + POINTS + " +1. ,\t.5,-1e+2\r\n\r\n#\n1,2,3\n00001,2E0,3"
    read = read_points3d(file(tmp_path / "p.txt", content))
    assert read[:, :3].tolist() == [[1, 0.5, -100], [1, 2, 3], [1, 2, 3]]


@pytest.mark.parametrize(
    ("row", "match"),
    [
        ("1,2,3,4,5", "expected 3 or 6 columns in all rows"),
        ("1,2,3,4,5,", "could not convert string '' to float64 at row 20"),
        ("1,2,3,4,5,nan", "point 20 is not finite"),
        ("1,2,3,4,5,1e999", "not finite"),
        ("1,2,3,4,5,0x10", "could not convert"),
        ("1,2,3,4,5,6\0", "could not convert"),
        ("1,2,3,4,5,True", "could not convert"),
    ],
)
def test_bad_points_are_named(tmp_path: Path, row: str, match: str) -> None:
    path = file(tmp_path / "p.txt", POINTS + "1,2,3,4,5,6\n" * 20 + row + "\n1,2,3,4,5,6\n")
    with pytest.raises(DataError, match=rf"p\.txt:.*{match}"):
        read_points3d(path)
    with pytest.raises(DataError, match=r"p\.txt: expected 3 or 6 columns, got 4"):
        read_points3d(file(path, "1,2,3,4\n"))


VALUES = np.arange(18.0).reshape(3, 6)


def test_covariances_are_read_as_written_and_cannot_be_changed(tmp_path: Path) -> None:
    assert read_point_covariances(tmp_path, 3) is None
    values = VALUES.copy()
    values[1] = np.nan
    write_point_covariances(tmp_path, values)
    found = read_point_covariances(tmp_path, 3)
    assert found is not None and not found.flags.writeable
    np.testing.assert_array_equal(found, values)
    np.testing.assert_array_equal(np.load(tmp_path / COVARIANCES_FILE), values)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (VALUES[:2], r"expected float64 \(3, 6\)"),
        (VALUES[:, :5], r"expected float64 \(3, 6\)"),
        (VALUES.astype(np.float32), r"expected float64 \(3, 6\)"),
        (np.array([object()] * 3), "no array"),  # a pickle
        (b"", "no array"),
        (b"no array", "no array"),
        (b"\x93NUMPY\x01\x00", "no array"),
    ],
)
def test_covariances_of_another_map_and_what_is_no_array_are_refused(
    tmp_path: Path, content: np.ndarray | bytes, match: str
) -> None:
    path = tmp_path / COVARIANCES_FILE
    path.parent.mkdir()
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content, allow_pickle=True)
    with pytest.raises(DataError, match=match):
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
    names = [line.split()[-1] for line in header.decode().splitlines() if "property" in line]
    assert names == ["x", "y", "z", "red", "green", "blue", "deviation", "kept"]
    rows = np.frombuffer(body, np.dtype("<f8, <f8, <f8, u1, u1, u1, <f4, <f4"))
    np.testing.assert_array_equal(np.stack([rows[f"f{k}"] for k in range(3)], axis=1), far)
    np.testing.assert_array_equal(rows["f6"], np.arange(100))
    write_ply(tmp_path / "points.ply", np.zeros((0, 3)), np.zeros((0, 3)))
    assert b"element vertex 0\n" in (tmp_path / "points.ply").read_bytes()


# -------------------------------------------------------------------------------- observations

OBSERVATIONS = VERSION + "# point3d_id, keypoints_type, [image_path, feature_id]*\n"


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the reader meet the borders of blocks everywhere."""
    monkeypatch.setattr(observations, "_BLOCK_CHARACTERS", 50)


def plain(observations: dict[str, Observations]) -> dict[str, list[tuple[int, str, int]]]:
    """Observations as rows of point, image and keypoint."""
    found = {}
    for keypoints_type, of_type in observations.items():
        assert of_type.keypoints_type == keypoints_type
        assert list(of_type.image_names) == sorted(set(of_type.image_names))
        ids = (of_type.point_ids, of_type.image_ids, of_type.keypoint_ids)
        assert tuple(array.dtype for array in ids) == (np.int64, np.int32, np.int32)
        found[keypoints_type] = [
            (point, of_type.image_names[image], keypoint)
            for point, image, keypoint in zip(*(array.tolist() for array in ids), strict=True)
        ]
        assert {image for _, image, _ in found[keypoints_type]} == set(of_type.image_names)
    return found


@pytest.mark.parametrize("read", [read_points3d, read_observations])
def test_files_that_cannot_be_read_are_named(tmp_path: Path, read: Callable[..., object]) -> None:
    path = tmp_path / "f.txt"
    with pytest.raises(DataError, match=r"f\.txt: cannot read: the file is missing"):
        read(path)
    with pytest.raises(DataError, match=r"f\.txt:1: kapture format 2\.0"):
        read(file(path, "# kapture format: 2.0\n1, t\n"))
    with pytest.raises(DataError, match=r"f\.txt: not a text file in UTF-8"):
        read_observations(file(path, b"1, t, a, 1\n1, t, \xff\xfe, 1\n"))


def random_observations(count: int, keypoints_type: str = "T 1") -> Observations:
    names = tuple(sorted(f"séquence {i % 3}/{'x' * (i % 40)}{i}.jpg" for i in range(50)))
    return Observations(
        keypoints_type,
        names,
        np.sort(RNG.integers(0, count, count)),
        np.r_[np.arange(50), RNG.integers(0, 50, count - 50)].astype(np.int32),
        np.r_[RNG.integers(0, 2**31, count - 1), 2**31 - 1].astype(np.int32),
    )


def test_observations_come_back_exactly(tmp_path: Path) -> None:
    written = {name: random_observations(3000, name) for name in ("T 1", "sift")}
    write_observations(tmp_path, written)
    path = tmp_path / "reconstruction/observations.txt"
    read = read_observations(path)
    assert list(read) == ["T 1", "sift"]
    assert plain(read) == plain(written)


def test_the_layout_of_observations_is_kapture_s(tmp_path: Path) -> None:
    of_type = Observations("t", ("a", "b"), *np.array([[7, 0, 7], [1, 0, 0], [5, 6, 2]]))
    other = Observations("s", ("c",), *np.array([[7], [0], [3]]))
    write_observations(tmp_path, {"t": of_type, "s": other})
    text = (tmp_path / "reconstruction/observations.txt").read_text()
    assert text == OBSERVATIONS + "0, t, a, 6\n7, s, c, 3\n7, t, b, 5, a, 2\n"
    write_observations(tmp_path, {})
    assert (tmp_path / "reconstruction/observations.txt").read_text() == OBSERVATIONS


def of_points(keypoints_type: str, image: str, points: range) -> Observations:
    """Observations of some points, one each, by one image."""
    zeros, rows = np.zeros(len(points), np.int32), np.arange(len(points), dtype=np.int32)
    return Observations(keypoints_type, (image,), np.asarray(points), zeros, rows)


def test_types_of_disjoint_points_over_many_blocks(tmp_path: Path) -> None:
    """As maps of several keypoints types have them: each type's points behind the other's."""
    from kapture.io.csv import observations_from_file

    written = {
        "aliked": of_points("aliked", "a.jpg", range(90_000)),
        "sift": of_points("sift", "b.jpg", range(89_999, 180_000)),
    }
    none = Observations("none", (), *np.empty((3, 0), int))
    write_observations(tmp_path, {**written, "none": none})
    path = tmp_path / "reconstruction/observations.txt"
    assert plain(read_observations(path)) == plain(written)
    found = observations_from_file(str(path))
    assert len(found) == 180_000
    assert found[89_999] == {"aliked": [("a.jpg", 89_999)], "sift": [("b.jpg", 0)]}
    assert found[179_999] == {"sift": [("b.jpg", 90_000)]}


@pytest.mark.usefixtures("small_blocks")
def test_unusual_but_good_observations_are_read(tmp_path: Path) -> None:
    rows = [
        "5,t,a b.jpg,0,c , 1\r",
        "",
        "# a comment, with, commas, and a very long text that does not fit into one chunk" * 3,
        "3 ,  t\t,a b.jpg, 00007",
        "9, lonely",
        "4, t",
        "5, t, " + "long/" * 60 + "x.jpg, 3, c, 2",
    ]
    path = file(tmp_path / "o.txt", "\ufeff" + OBSERVATIONS + "\n".join(rows))
    assert plain(read_observations(path)) == {
        "lonely": [],
        "t": [
            (3, "a b.jpg", 7),
            (5, "a b.jpg", 0),
            (5, "c", 1),
            (5, "long/" * 60 + "x.jpg", 3),
            (5, "c", 2),
        ],
    }


@pytest.mark.parametrize("row", ["3, t\u2003, a, 1", "3, t, a\u00a0, 1", "+3, t, a, 1"])
def test_rare_spaces_around_names_are_stripped(tmp_path: Path, row: str) -> None:
    path = file(tmp_path / "o.txt", f"1, t, b, 1\n{row}\n")
    found = plain(read_observations(path))
    assert found == {"t": [(1, "b", 1), (3, "a", 1)]}


@pytest.mark.parametrize(
    ("row", "match"),
    [
        ("5", "expected point3d_id"),
        ("5, t, a", "expected point3d_id"),
        ("5, t, a, 1, b", "expected point3d_id"),
        ("x, t, a, 1", "expected point3d_id"),
        ("-1, t, a, 1", "ids from 0 on"),
        ("5, t, a, 1.5", "ids from 0 on"),
        ("5, t, a, -1", "ids from 0 on"),
        (f"5, t, a, {2**31}", "ids from 0 on"),
        ("5, , a, 1", "empty"),
        ("5, t/u, a, 1", "cannot be a type name"),
        ("5, t, , 1", "empty path"),
        ("5, t, ../a, 1", "leads out"),
        ("5, t, a\0, 1", "control character"),
    ],
)
@pytest.mark.usefixtures("small_blocks")
def test_bad_observations_name_file_and_line(tmp_path: Path, row: str, match: str) -> None:
    content = OBSERVATIONS + "0, t, a, 1, b, 2\n" * 20 + row + "\n3, t, a, 1\n"
    path = file(tmp_path / "o.txt", content)
    with pytest.raises(DataError, match=match) as caught:
        read_observations(path)
    assert f"{path}:23: " in str(caught.value)


@pytest.mark.usefixtures("small_blocks")
def test_names_and_types_of_several_blocks(tmp_path: Path) -> None:
    rows = [f"{i}, type{i % 300}, {'deep/' * (i % 9)}{i}.jpg, {i % 7}\n" for i in range(20_000)]
    path = file(tmp_path / "o.txt", "".join(rows))
    found = plain(read_observations(path))
    assert len(found) == 300
    assert found["type7"][0] == (7, "deep/" * 7 + "7.jpg", 0)
    assert sum(map(len, found.values())) == 20_000


@pytest.mark.parametrize(
    ("field", "value"),
    [("image_names", ("../a",)), ("image_names", ("a,b",)), ("keypoints_type", "a/b")],
)
def test_names_that_cannot_be_read_back_are_refused(
    tmp_path: Path, field: str, value: object
) -> None:
    broken = replace(of_points("t", "a", range(2)), **{field: value})
    with pytest.raises(DataError):
        write_observations(tmp_path, {broken.keypoints_type: broken})
    assert list(tmp_path.iterdir()) == []
