"""3D points and observations: one grammar, two readers, exact numbers."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from megloc_kapture.errors import DataError
from megloc_kapture.io import large_text
from megloc_kapture.io.kapture_points import (
    Observations,
    find_observation,
    read_observations,
    read_points3d,
    write_observations,
    write_points3d,
)

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
    for name in ("read_observation_arrays", "read_point_rows"):
        function = getattr(large_text, name)
        monkeypatch.setitem(function.__kwdefaults__, "chunk_bytes", 50)


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
        ("1,2,3,4,5,6\0", "not a number"),
    ],
)
@pytest.mark.usefixtures("small_chunks")
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


@BOTH
@pytest.mark.parametrize("read", [read_points3d, read_observations])
def test_files_that_cannot_be_read_are_named(
    tmp_path: Path, read: Callable[..., object], large_bytes: int
) -> None:
    path = tmp_path / "f.txt"
    with pytest.raises(DataError, match=r"f\.txt: file is missing"):
        read(path, large_bytes=large_bytes)
    os.mkfifo(path)
    with pytest.raises(DataError, match=r"f\.txt: not a plain file"):
        read(path, large_bytes=large_bytes)
    path.unlink()
    for content, line in ((b"1,2,3\n1,2,\xff\n", 2), (b"# \xff\n1,2,3\n", 1)):
        with pytest.raises(DataError, match=rf"f\.txt:{line}: not UTF-8"):
            read_points3d(file(path, content), large_bytes=large_bytes)
    with pytest.raises(DataError, match=r"f\.txt:1: kapture format 1\.0"):
        read(file(path, "# kapture format: 1.0\n1, t\n"), large_bytes=large_bytes)


NUMBERS = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.floats(-1e6, 1e6).map("{:.10f}".format),  # kapture's own writer
    st.floats(allow_nan=False, allow_infinity=False).map("{:.18e}".format),
    st.floats(allow_nan=False, allow_infinity=False).map("{:.25e}".format),
    st.decimals(
        allow_nan=False, allow_infinity=False, places=30, min_value=-100, max_value=100
    ).map("{:f}".format),
    st.builds(
        "{}{}{}{}".format,
        st.sampled_from(["", "-", "+", "0", "-00"]),
        st.from_regex(r"[0-9]{1,25}", fullmatch=True),
        st.sampled_from(["", "."]) | st.from_regex(r"\.[0-9]{1,25}", fullmatch=True),
        st.just("") | st.integers(-340, 300).map("e{}".format),
    ),
    # half-way cases, where a wrong last digit would show
    st.integers(2**53, 2**56).map(str),
    st.integers(2**52, 2**53 - 1).map(lambda m: f"{m}.5"),
    st.sampled_from(
        ["4.9e-324", "2.2250738585072011e-308", "1.7976931348623157e308", "9007199254740993"]
    ),
).filter(lambda text: np.isfinite(float(text)))


@given(st.lists(NUMBERS, min_size=3, max_size=30))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
def test_the_compiled_reader_finds_the_nearest_float(tmp_path: Path, numbers: list[str]) -> None:
    numbers = numbers[: len(numbers) // 3 * 3]
    rows = [",".join(numbers[i : i + 3]) for i in range(0, len(numbers), 3)]
    path = file(tmp_path / "p.txt", "\n".join(rows))
    read = large_text.read_point_rows(path, 3, lambda line, number: None)
    assert read is not None
    expected = np.array([float(text) for text in numbers])
    assert np.array_equal(read.ravel().view(np.uint64), expected.view(np.uint64))


@given(
    st.lists(
        st.floats(allow_nan=False, allow_infinity=False)
        | st.floats(-1e4, 1e4).map(lambda x: round(x, 3))
        | st.integers(-300, 300).map(float)
        | st.integers(-1074, 1023).map(lambda x: 2.0**x)
        | st.integers(-323, 308).map(lambda x: float(f"1e{x}")),
        min_size=1,
    ),
    st.sampled_from([3, 6]),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=200)
def test_both_writers_write_the_same_points(
    tmp_path: Path, numbers: list[float], columns: int
) -> None:
    points = np.resize(numbers, (len(numbers) // columns + 1, columns))
    path = tmp_path / "reconstruction/points3d.txt"
    write_points3d(tmp_path, points, large_rows=PLAIN)
    expected = path.read_bytes()
    write_points3d(tmp_path, points, large_rows=COMPILED)
    assert path.read_bytes() == expected


def test_the_compiled_writer_finds_the_shortest_text(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    any_bits = rng.integers(0, 2**64, 60_000, dtype=np.uint64).view(np.float64)
    edges = 2.0 ** np.arange(-1074, 1024)
    numbers = np.concatenate(
        [
            any_bits[np.isfinite(any_bits)],
            edges,
            np.nextafter(edges, 0),
            np.nextafter(edges[:-1], np.inf),
            rng.normal(0, 1e3, 60_000),
            [0.0, -0.0, 5e-324, 1.7976931348623157e308, 1e16, 9999999999999998.0, 1e-4, 1e-5, 1e23],
        ]
    )
    write_points3d(tmp_path, np.resize(numbers, (len(numbers) // 3, 3)), large_rows=COMPILED)
    text = (tmp_path / "reconstruction/points3d.txt").read_text().split("\n", 2)[2]
    found = text.replace("\n", ",").split(",")[:-1]
    assert found == [repr(number) for number in numbers[: len(found)].tolist()]


def test_points_that_cannot_be_stored_are_refused(tmp_path: Path) -> None:
    for points in (np.zeros(3), np.zeros((2, 4)), [[1, 2, np.nan]], [[1, 2, np.inf]]):
        with pytest.raises(ValueError, match="points"):
            write_points3d(tmp_path, points)
    assert list(tmp_path.iterdir()) == []


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
        ("5, t, a\0, 1", "control character"),
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


def test_image_names_that_are_not_utf8_are_refused(tmp_path: Path) -> None:
    path = file(tmp_path / "o.txt", b"0, t, a, 1\n0, t, \xff\xfe, 1\n")
    for large_bytes in (PLAIN, COMPILED):
        with pytest.raises(DataError, match=r"o\.txt:2: not UTF-8"):
            read_observations(path, large_bytes=large_bytes)


@pytest.mark.usefixtures("small_chunks")
def test_more_names_than_the_first_table_holds(tmp_path: Path) -> None:
    count = 20000  # twice the room that the compiled reader starts with
    rows = [f"{i}, t, {'deep/' * (i % 9)}{i}.jpg, {i % 7}\n" for i in range(count)]
    large_text.read_observation_arrays.__kwdefaults__["chunk_bytes"] = 1 << 20
    path = file(tmp_path / "o.txt", "".join(rows))
    assert plain(read_observations(path, large_bytes=COMPILED)) == plain(
        read_observations(path, large_bytes=PLAIN)
    )


def test_more_types_than_the_compiled_reader_takes(tmp_path: Path) -> None:
    path = file(tmp_path / "o.txt", "".join(f"{i}, type{i}, a, 1\n" for i in range(300)))
    found = read_observations(path, large_bytes=COMPILED)
    assert len(found) == 300
    assert plain(found)["type299"] == [(299, "a", 1)]


# rows that are nearly right, so that random files reach deep into both readers
FIELDS = st.sampled_from(
    ["0", "1", "17", " 5 ", "007", "-1", "x", "", "t", "u u", "a.jpg", "b/c d.jpg", "é", "..", "#"]
    + ["\u2003", "9" * 18, "9" * 19, "\t3", "a\u00a0", "\0", "2147483647", "2147483648"]
)
GOOD = st.builds(
    lambda point, kind, pairs: f"{point}, {kind}" + "".join(f", {i}, {k}" for i, k in pairs),
    st.integers(0, 40),
    st.sampled_from(["t", "u", "v w"]),
    st.lists(
        st.tuples(st.sampled_from(["a", "b/c d", "é" * 20, "x" * 70]), st.integers(0, 99)),
        max_size=5,
    ),
)
ROWS = (
    GOOD
    | st.lists(FIELDS, max_size=7).map(", ".join)
    | st.sampled_from(["", "# c", "#é", " ", "\r", "\u2003"])
)
FILES = st.builds(
    lambda rows, end, tail: end.join(rows) + tail,
    st.lists(ROWS, max_size=12),
    st.sampled_from(["\n", "\r\n"]),
    st.sampled_from(["", "\n", "\n\n"]),
).map(str.encode) | st.binary(max_size=200)


def outcome(read: Callable[..., object], path: Path, large_bytes: int) -> object:
    try:
        return read(path, large_bytes=large_bytes)
    except DataError as error:
        assert path.name in str(error)
        return DataError


@given(st.lists(GOOD, min_size=1, max_size=12).map(lambda r: "\n".join(r).encode()) | FILES)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
@pytest.mark.usefixtures("small_chunks")
def test_both_readers_of_observations_agree_on_anything(tmp_path: Path, content: bytes) -> None:
    path = file(tmp_path / "o.txt", content)
    results = [outcome(read_observations, path, large_bytes) for large_bytes in (PLAIN, COMPILED)]
    if DataError in results:
        assert results == [DataError, DataError]
    else:
        assert plain(results[0]) == plain(results[1])  # type: ignore[arg-type]


POINT_FIELDS = NUMBERS | st.sampled_from(
    ["", "x", "nan", "1e999", "1 2", " 5\t", ".", "-", "1e", "\0"]
)
POINT_ROWS = st.lists(NUMBERS, min_size=3, max_size=3) | st.lists(POINT_FIELDS, max_size=7)


@given(
    st.lists(
        POINT_ROWS.map(",".join) | st.sampled_from(["", "# c", "#é", "\u2003", "\r"]), max_size=10
    )
    .map("\n".join)
    .map(str.encode)
    | st.binary(max_size=200)
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
@pytest.mark.usefixtures("small_chunks")
def test_both_readers_of_points_agree_on_anything(tmp_path: Path, content: bytes) -> None:
    path = file(tmp_path / "p.txt", content)
    results = [outcome(read_points3d, path, large_bytes) for large_bytes in (PLAIN, COMPILED)]
    if any(result is DataError for result in results):
        assert results[0] is results[1]
    else:
        assert np.array_equal(*results)  # type: ignore[arg-type]


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
