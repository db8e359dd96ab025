"""Rows of pose files, and the import they are compared with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.check.reading import Rows, read_reference, read_rows
from megloc_kapture.evaluation.pose_files import read_mlad_file, read_pose_file
from megloc_kapture.io.dataset_tables import (
    ImageGroup,
    PoseFileFormat,
    Protocol,
    write_groups,
    write_names,
    write_protocol,
)
from megloc_kapture.io.kapture import KaptureFolder, write_sensors

GOOD = "a.jpg 0.6 0.8 0 0 1.5 -0.2 3\n"
GOOD_PAIR = "100 205 1.5 -0.2 3 0.8 0 0 0.6\n"


def rows_of(tmp_path: Path, text: str, kind: PoseFileFormat = "ltvl") -> Rows:
    path = tmp_path / "poses.txt"
    path.write_text(text, encoding="utf-8", newline="")
    return read_rows(path, kind)


def problems(rows: Rows) -> list[tuple[str, int | None]]:
    return [(finding.kind, finding.line) for finding in rows.findings]


def test_good_files(tmp_path: Path) -> None:
    rows = rows_of(tmp_path, GOOD + "\r\n\tb.jpg\t1 0 0 0  0 0 1e0 \r\n")
    assert rows.keys == ("a.jpg", "b.jpg") and not rows.findings
    assert rows.named == {"a.jpg": 1, "b.jpg": 3}
    assert rows.quats.tolist() == [[0.6, 0.8, 0, 0], [1, 0, 0, 0]]
    assert rows.translations.tolist() == [[1.5, -0.2, 3], [0, 0, 1]]
    # of MLAD a file need not end its last line
    rows = rows_of(tmp_path, GOOD_PAIR + "100 206 0 0 0 0 0 0 1", "mlad")
    assert rows.keys == ("100 205", "100 206") and not rows.findings
    assert rows.quats.tolist() == [[0.8, 0, 0, 0.6], [0, 0, 0, 1]]
    assert rows.translations.tolist() == [[1.5, -0.2, 3], [0, 0, 0]]
    nothing = rows_of(tmp_path, "\n \n")
    assert nothing.keys == () and nothing.quats.shape == (0, 4)
    assert nothing.translations.shape == (0, 3)


def test_a_byte_order_mark_is_told(tmp_path: Path) -> None:
    for name in (b"", b"\xef\xbb\xbf"):
        (tmp_path / "poses.txt").write_bytes(name + b"a.jpg 1 0 0 0 0 0 0\n")
        rows = read_rows(tmp_path / "poses.txt", "ltvl")
        assert rows.keys == ("a.jpg",)
        assert [one.kind for one in rows.findings] == ["byte-order-mark"] * bool(name)


def test_files_that_are_cut_or_no_text(tmp_path: Path) -> None:
    rows = rows_of(tmp_path, GOOD + "b.jpg 1 0 0 0 1.5 -0.2 3.1")
    assert [(f.severity, f.kind, f.line) for f in rows.findings] == [("warning", "cut", 2)]
    path = tmp_path / "poses.txt"
    path.write_bytes(GOOD.encode() + b"\xff\xfe\n")
    with pytest.raises(DataError, match="UTF-8") as caught:
        read_rows(path, "ltvl")
    assert caught.value.line == 2


@pytest.mark.parametrize(
    ("line", "kind", "words"),
    [
        ("b.jpg 1 0 0 0 1.5 -0.2", "columns", "7 columns instead of 8 (name qw qx qy qz tx ty tz)"),
        ("b.jpg 1 0 0 0 1.5 -0.2 3 4", "columns", "9 columns instead of 8"),
        ("b.jpg", "columns", "1 column instead"),
        ("# name qw qx qy qz tx ty tz", "comment", "no header"),
        ("b.jpg 1 0 0 0 1.5 -0.2 x", "number", "'x' is not a number"),
        ("b.jpg 1 0 0 0 1_5 -0.2 3", "number", "'1_5'"),
        ("b.jpg 1 0 0 0 ١ -0.2 3", "number", "'١'"),
        ("b.jpg 1 0 0 0 nan -0.2 3", "not-finite", "b.jpg"),
        ("b.jpg 1 0 0 0 1e999 -0.2 3", "not-finite", "b.jpg"),
        ("b.jpg -inf 0 0 0 1 -0.2 3", "not-finite", "b.jpg"),
        ("b.jpg 0 0 0 0 1 -0.2 3", "quaternion", "length 0, not 1"),
        ("b.jpg 1e200 1e200 0 0 1 -0.2 3", "quaternion", "length"),
        ("a.jpg 1 0 0 0 1 -0.2 3", "duplicate", "given twice, first on line 1"),
    ],
)
def test_every_problem_of_a_row(tmp_path: Path, line: str, kind: str, words: str) -> None:
    rows = rows_of(tmp_path, f"{GOOD}\n{line}\n{line.replace('b.jpg', 'c.jpg')}\nd.jpg 1 0 0\n")
    assert problems(rows)[:2] in (
        [(kind, 3), (kind, 4)],
        [(kind, 3), ("columns", 5)],
        [("columns", 5), (kind, 3)],
    )
    assert ("columns", 5) in problems(rows)
    told = next(finding for finding in rows.findings if finding.line == 3)
    assert told.severity == "error" and words in told.message
    assert rows.keys == ("a.jpg",)


def test_quaternions_off_unit_length_are_used_all_the_same(tmp_path: Path) -> None:
    rows = rows_of(tmp_path, GOOD + "b.jpg 1.2 0 1.6 0 1 2 3\nc.jpg 1.0009 0 0 0 1 2 3\n")
    assert problems(rows) == [("quaternion", 2)]
    assert rows.keys == ("a.jpg", "b.jpg", "c.jpg")
    np.testing.assert_allclose(rows.quats[1:], [[0.6, 0, 0.8, 0], [1, 0, 0, 0]], atol=1e-15)


@pytest.mark.parametrize(
    "line",
    [
        "b.jpg,0.6,0.8,0,0,1.5,-0.2,3",
        "b.jpg, 0.6, 0.8, 0, 0, 1.5, -0.2, 3",
        "b.jpg 0.6, 0.8, 0, 0, 1.5 -0.2 3",
    ],
)
def test_commas_are_told_and_read(tmp_path: Path, line: str) -> None:
    rows = rows_of(tmp_path, f"{GOOD}{line}\n")
    assert problems(rows) == [("separator", 2)]
    assert rows.keys == ("a.jpg", "b.jpg")
    assert rows.quats[0].tolist() == rows.quats[1].tolist()
    assert rows.translations[0].tolist() == rows.translations[1].tolist()


def test_columns_in_the_order_of_the_other_format(tmp_path: Path) -> None:
    rows = rows_of(tmp_path, "".join(f"{n}.jpg {n} 20 30 0.6 0.8 0 0\n" for n in range(5)))
    assert problems(rows) == [("column-order", None)]
    assert "the translation stands before the quaternion in 5 rows" in rows.findings[0].message
    assert rows.quats.tolist() == [[0.6, 0.8, 0, 0]] * 5
    assert rows.translations[:, 0].tolist() == [0, 1, 2, 3, 4]
    rows = rows_of(tmp_path, "".join(f"1 {n} 0.6 0.8 0 0 {n} 20 30\n" for n in range(5)), "mlad")
    assert "the quaternion stands before the translation" in rows.findings[0].message
    assert rows.quats.tolist() == [[0.6, 0.8, 0, 0]] * 5
    assert rows.translations[:, 0].tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("line", "kind"),
    [
        ("1e2 205 1.5 -0.2 3 0.8 0 0 0.6", "timestamp"),
        ("a.png 205 1.5 -0.2 3 0.8 0 0 0.6", "timestamp"),
        ("100 -205 1.5 -0.2 3 0.8 0 0 0.6", "timestamp"),
        ("100 205", "columns"),
        ("100 204 1.5 -0.2 3 0.8 0 0", "columns"),
        ("100 205 1.5 -0.2 3 0.8 0 0 0.6", "duplicate"),
    ],
)
def test_every_problem_of_a_pair(tmp_path: Path, line: str, kind: str) -> None:
    rows = rows_of(tmp_path, f"{GOOD_PAIR}{line}\n", "mlad")
    assert (kind, 2) in problems(rows)
    assert rows.keys == ("100 205",)


@given(st.binary(max_size=40), st.integers(0, 60), st.sampled_from(["ltvl", "mlad"]))
def test_damage_is_told_exactly_where_the_strict_reader_refuses(
    tmp_path_factory: pytest.TempPathFactory, junk: bytes, place: int, kind: PoseFileFormat
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged_rows.txt"
    good = GOOD + GOOD.replace("a.jpg", "b.jpg")
    if kind == "mlad":
        good = GOOD_PAIR + GOOD_PAIR.replace("205", "206")
    content = good.encode()
    path.write_bytes(content[:place] + junk + content[place:])
    try:
        strict = read_pose_file(path) if kind == "ltvl" else read_mlad_file(path)
        # a list of pairs is no file of poses
        refused = kind == "mlad" and any(row.query_from_reference is None for row in strict)
    except DataError:
        refused = True
    try:
        rows = read_rows(path, kind)
    except DataError as error:
        assert refused and str(path) in str(error)
        return
    assert bool(rows.findings) == refused
    assert np.isfinite(rows.quats).all() and np.isfinite(rows.translations).all()
    np.testing.assert_allclose(np.linalg.norm(rows.quats, axis=1), 1.0, atol=1e-12)


@pytest.fixture
def imported(scene: Path, tmp_path: Path) -> Path:
    for part in ("mapping", "query"):
        data = KaptureFolder(scene / part).read()
        data.records_camera = {k: f"{part}/{name}" for k, name in data.records_camera.items()}
        write_sensors(tmp_path / part, data)
    return tmp_path


def test_plain_folders(imported: Path) -> None:
    found = read_reference(imported)
    queries = KaptureFolder(imported / "query").read().image_names()
    assert list(found.expected) == list(found.expected.values()) == queries
    assert not found.names and found.queries == set(queries)
    assert found.cameras is not None and len(found.cameras.images) == 7
    poses = KaptureFolder(imported / "mapping").read().poses()
    assert found.cameras.images == tuple(poses)
    centers = [pose.center() for pose in poses.values()]
    np.testing.assert_allclose(found.cameras.centers, centers, atol=1e-12)


def test_rules_and_lists(imported: Path) -> None:
    first, second, *_ = sorted(read_reference(imported).queries)
    write_protocol(imported / "megloc", Protocol(pose_file_names="basename"))
    write_groups(imported / "megloc", {first: ImageGroup(scored=False)})
    found = read_reference(imported)
    assert len(found.expected) == 3 and found.expected[second.split("/")[1]] == second
    write_names(imported / "megloc", {second: "b.png", first: "a.png"})
    found = read_reference(imported)
    assert list(found.expected.items()) == [("b.png", second), ("a.png", first)]
    assert found.names and len(found.queries) == 4


def test_parts_that_are_not_there(imported: Path, tmp_path: Path) -> None:
    (imported / "mapping").rename(tmp_path / "away")
    assert read_reference(imported).cameras is None
    (imported / "query").rename(tmp_path / "gone")
    with pytest.raises(DataError, match="none of mapping/, query/ and megloc/"):
        read_reference(imported)
    write_protocol(imported / "megloc", Protocol(dataset="aachen"))
    found = read_reference(imported)
    assert (found.protocol.dataset, found.queries, found.expected) == ("aachen", set(), {})
    (tmp_path / "away").rename(imported / "mapping")
    (imported / "mapping" / "sensors" / "trajectories.txt").write_text("broken\n")
    with pytest.raises(DataError, match="trajectories.txt"):
        read_reference(imported)
