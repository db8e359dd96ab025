"""Observations: one grammar, two readers that agree; files that cannot be read are named."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import observations
from megloc_kapture.io.kapture.observations import (
    Observations,
    find_observation,
    read_observations,
    write_observations,
)
from megloc_kapture.io.kapture.points import read_points3d

VERSION = "# kapture format: 1.1\n"
POINTS = VERSION + "# X, Y, Z, R, G, B\n"
OBSERVATIONS = VERSION + "# point3d_id, keypoints_type, [image_path, feature_id]*\n"
RNG = np.random.default_rng(0)

# both readers are asked everything: files of any size go to the one or to the other
PLAIN, COMPILED = 1 << 62, 0
BOTH = pytest.mark.parametrize("large_bytes", [PLAIN, COMPILED], ids=["plain", "compiled"])


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the compiled reader meet chunk borders everywhere."""
    monkeypatch.setitem(read_observations.__kwdefaults__, "chunk_bytes", 50)


def plain(observations: dict[str, Observations]) -> dict[str, list[tuple[int, str, int]]]:
    """Observations as rows of point, image and keypoint."""
    found = {}
    for keypoints_type, of_type in observations.items():
        assert of_type.keypoints_type == keypoints_type
        assert list(of_type.image_names) == sorted(set(of_type.image_names))
        dtypes = (of_type.point_ids.dtype, of_type.image_ids.dtype, of_type.keypoint_ids.dtype)
        assert dtypes == (np.int64, np.int32, np.int32)
        found[keypoints_type] = [
            (point, of_type.image_names[image], keypoint)
            for point, image, keypoint in zip(
                of_type.point_ids.tolist(),
                of_type.image_ids.tolist(),
                of_type.keypoint_ids.tolist(),
                strict=True,
            )
        ]
        assert {image for _, image, _ in found[keypoints_type]} == set(of_type.image_names)
    return found


def file(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@BOTH
@pytest.mark.parametrize("read", [read_points3d, read_observations])
def test_files_that_cannot_be_read_are_named(
    tmp_path: Path, read: Callable[..., object], large_bytes: int
) -> None:
    path = tmp_path / "f.txt"
    with pytest.raises(DataError, match=r"f\.txt: cannot read: the file is missing"):
        read(path, large_bytes=large_bytes)
    os.mkfifo(path)
    with pytest.raises(DataError, match=r"f\.txt: not a plain file"):
        read(path, large_bytes=large_bytes)
    path.unlink()
    for content, line in ((b"1,2,3\n1,2,\xff\n", 2), (b"# \xff\n1,2,3\n", 1)):
        with pytest.raises(DataError, match=rf"f\.txt:{line}: not a text file in UTF-8"):
            read_points3d(file(path, content), large_bytes=large_bytes)
    with pytest.raises(DataError, match=r"f\.txt:1: kapture format 1\.0"):
        read(file(path, "# kapture format: 1.0\n1, t\n"), large_bytes=large_bytes)


# -------------------------------------------------------------------------------- observations


def random_observations(count: int, keypoints_type: str = "T 1") -> Observations:
    names = tuple(sorted(f"séquence {i % 3}/{'x' * (i % 40)}{i}.jpg" for i in range(50)))
    return Observations(
        keypoints_type,
        names,
        np.sort(RNG.integers(0, count, count)),
        np.r_[np.arange(50), RNG.integers(0, 50, count - 50)].astype(np.int32),
        np.r_[RNG.integers(0, 2**31, count - 1), 2**31 - 1].astype(np.int32),
    )


@BOTH
def test_observations_come_back_exactly(tmp_path: Path, large_bytes: int) -> None:
    written = {name: random_observations(3000, name) for name in ("T 1", "sift")}
    write_observations(tmp_path, written)
    path = tmp_path / "reconstruction/observations.txt"
    read = read_observations(path, large_bytes=large_bytes)
    assert list(read) == ["T 1", "sift"]
    assert plain(read) == plain(written)


def test_both_writers_write_the_same_observations(tmp_path: Path) -> None:
    for of_type in (random_observations(3000), Observations("t", ("a",), *np.empty((3, 0), int))):
        contents = []
        for large_rows in (PLAIN, COMPILED):
            write_observations(tmp_path, {of_type.keypoints_type: of_type}, large_rows=large_rows)
            contents.append((tmp_path / "reconstruction/observations.txt").read_bytes())
        assert contents[0] == contents[1]


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
    ids = np.asarray(points)
    return Observations(
        keypoints_type,
        (image,),
        ids,
        np.zeros(len(ids), np.int32),
        np.arange(len(ids), dtype=np.int32),
    )


@BOTH
def test_types_of_disjoint_points_over_many_blocks(tmp_path: Path, large_bytes: int) -> None:
    """As maps of several keypoints types have them: each type's points behind the other's."""
    written = {
        "aliked": of_points("aliked", "a.jpg", range(90_000)),
        "sift": of_points("sift", "b.jpg", range(90_000, 200_000)),
    }
    write_observations(
        tmp_path, {**written, "none": Observations("none", (), *np.empty((3, 0), int))}
    )
    path = tmp_path / "reconstruction/observations.txt"
    assert plain(read_observations(path, large_bytes=large_bytes)) == plain(written)


def test_kapture_reads_types_of_disjoint_points(tmp_path: Path) -> None:
    from kapture.io.csv import observations_from_file

    write_observations(
        tmp_path,
        {
            "aliked": of_points("aliked", "a.jpg", range(70_000)),
            "none": Observations("none", (), *np.empty((3, 0), int)),
            "sift": of_points("sift", "b.jpg", range(69_999, 140_000)),
        },
    )
    found = observations_from_file(str(tmp_path / "reconstruction/observations.txt"))
    assert len(found) == 140_000
    assert found[69_999] == {"aliked": [("a.jpg", 69_999)], "sift": [("b.jpg", 0)]}
    assert found[139_999] == {"sift": [("b.jpg", 70_000)]}


@BOTH
@pytest.mark.usefixtures("small_chunks")
def test_unusual_but_good_observations_are_read(tmp_path: Path, large_bytes: int) -> None:
    rows = [
        "5,t,a b.jpg,0,c , 1\r",
        "",
        "  # not a comment, but no id either"[:0],
        "# a comment, with, commas, and a very long text that does not fit into one chunk" * 3,
        "3 ,  t\t,a b.jpg, 00007",
        "9, lonely",
        "4, t",
        "5, t, " + "long/" * 60 + "x.jpg, 3, c, 2",
    ]
    path = file(tmp_path / "o.txt", "\ufeff" + OBSERVATIONS + "\n".join(rows))
    assert plain(read_observations(path, large_bytes=large_bytes)) == {
        "lonely": [],
        "t": [
            (3, "a b.jpg", 7),
            (5, "a b.jpg", 0),
            (5, "c", 1),
            (5, "long/" * 60 + "x.jpg", 3),
            (5, "c", 2),
        ],
    }


@BOTH
@pytest.mark.parametrize(
    "row", ["\u00a03, t, a, 1", "3, t\u2003, a, 1", "3, t, a\u00a0, 1", "+3, t, a, 1"]
)
def test_rare_spaces_are_stripped_by_both_readers(
    tmp_path: Path, row: str, large_bytes: int
) -> None:
    path = file(tmp_path / "o.txt", f"1, t, b, 1\n{row}\n")
    found = plain(read_observations(path, large_bytes=large_bytes))
    assert found == {"t": [(1, "b", 1), (3, "a", 1)]}


@BOTH
@pytest.mark.parametrize(
    ("row", "match"),
    [
        ("5", "got 1 columns"),
        ("5, t, a", "got 3 columns"),
        ("5, t, a, 1, b", "got 5 columns"),
        ("5, t, a, 1,", "got 5 columns"),
        ("x, t, a, 1", "point id 'x' is not an integer"),
        ("-1, t, a, 1", "point id -1 is out of range"),
        ("1.0, t, a, 1", "not an integer"),
        (f"{2**62}, t, a, 1", "out of range"),
        ("99999999999999999999, t, a, 1", "out of range"),
        ("5, t, a, 1.5", "keypoint id '1.5' is not an integer"),
        ("5, t, a, -1", "keypoint id -1 is out of range"),
        (f"5, t, a, {2**31}", "out of range"),
        ("5, t, a, ", "not an integer"),
        ("5, t, a, b, 1, 2", "'b' is not an integer"),
        ("5, , a, 1", "empty"),
        ("5, t/u, a, 1", "cannot be a type name"),
        ("5, t, , 1", "empty path"),
        ("5, t, ../a, 1", "leads out"),
        ("5, t, /a, 1", "absolute"),
        ("5, t, a\0, 1", "NUL character"),
        ("5, t, a\\b, 1", "backslash"),
    ],
)
@pytest.mark.usefixtures("small_chunks")
def test_bad_observations_name_file_and_line(
    tmp_path: Path, row: str, match: str, large_bytes: int
) -> None:
    content = OBSERVATIONS + "0, t, a, 1, b, 2\n" * 20 + row + "\n3, t, a, 1\n"
    path = file(tmp_path / "o.txt", content)
    with pytest.raises(DataError, match=match) as caught:
        read_observations(path, large_bytes=large_bytes)
    assert f"{path}:23: " in str(caught.value)


def test_a_line_that_fills_the_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(observations, "_MAX_LINE_BYTES", 2000)
    path = file(tmp_path / "o.txt", "1, t, a, 1\n2, t, " + "x" * 1000 + ", 1")
    found = read_observations(path, large_bytes=COMPILED, chunk_bytes=64)
    assert plain(found) == {"t": [(1, "a", 1), (2, "x" * 1000, 1)]}
    file(path, "1, t, a, 1\n2, t, " + "x" * 5000)
    with pytest.raises(DataError, match=r"o\.txt:2: a line of more than 2000 bytes"):
        read_observations(path, large_bytes=COMPILED, chunk_bytes=64)


def test_image_names_that_are_not_utf8_are_refused(tmp_path: Path) -> None:
    path = file(tmp_path / "o.txt", b"0, t, a, 1\n0, t, \xff\xfe, 1\n")
    for large_bytes in (PLAIN, COMPILED):
        with pytest.raises(DataError, match=r"o\.txt:2: not a text file in UTF-8"):
            read_observations(path, large_bytes=large_bytes)


def test_names_of_several_chunks(tmp_path: Path) -> None:
    count = 20000
    rows = [f"{i}, t, {'deep/' * (i % 9)}{i}.jpg, {i % 7}\n" for i in range(count)]
    path = file(tmp_path / "o.txt", "".join(rows))
    assert plain(read_observations(path, large_bytes=COMPILED, chunk_bytes=1 << 18)) == plain(
        read_observations(path, large_bytes=PLAIN)
    )


def test_many_types(tmp_path: Path) -> None:
    path = file(tmp_path / "o.txt", "".join(f"{i}, type{i}, a, 1\n" for i in range(300)))
    found = read_observations(path, large_bytes=COMPILED)
    assert len(found) == 300
    assert plain(found)["type299"] == [(299, "a", 1)]


def test_an_observation_s_line_is_found(tmp_path: Path) -> None:
    path = file(tmp_path / "o.txt", OBSERVATIONS + "0, t, a, 1\n5, u, a, 1\n5, t, b, 1, a, 1\n")
    assert find_observation(path, "t", 5, "a", 1) == 5
    assert find_observation(path, "t", 5, "a", 2) is None


@pytest.mark.parametrize(
    "changes",
    [
        {"point_ids": np.array([0, -1])},
        {"point_ids": np.array([0])},
        {"point_ids": np.array([0.0, 1.0])},
        {"image_ids": np.array([0, 1], np.int32)},
        {"keypoint_ids": np.array([-1, 0], np.int32)},
        {"keypoint_ids": np.array([0, 2**31])},
        {"image_names": ("../a",)},
        {"image_names": ("a,b",)},
        {"keypoints_type": "a/b"},
    ],
)
def test_observations_that_cannot_be_read_back_are_refused(
    tmp_path: Path, changes: dict[str, object]
) -> None:
    good: dict[str, object] = {
        "keypoints_type": "t",
        "image_names": ("a",),
        "point_ids": np.array([0, 1]),
        "image_ids": np.zeros(2, np.int32),
        "keypoint_ids": np.zeros(2, np.int32),
    }
    observations = Observations(**{**good, **changes})  # type: ignore[arg-type]
    with pytest.raises((ValueError, DataError)):
        write_observations(tmp_path, {observations.keypoints_type: observations})
    assert list(tmp_path.iterdir()) == []
