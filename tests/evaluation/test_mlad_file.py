"""MLAD pose files: exact round trip, the challenge's columns, and broken rows."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.evaluation.mlad_file import (
    RelativePose,
    format_mlad_file,
    read_mlad_file,
    relative_pose,
    timestamp_of,
    write_mlad_file,
)
from megloc_kapture.values import RigidTransform

HERE = RigidTransform.identity()
GOOD = "100 205 1.5 -0.2 3 0.8 0 0 0.6\n"


def unit(values: list[float]) -> tuple[float, float, float, float]:
    w, x, y, z = (np.array(values) / np.linalg.norm(values)).tolist()
    return w, x, y, z


finite = st.floats(-1e7, 1e7)
quats = (
    st.lists(st.floats(-1, 1), min_size=4, max_size=4)
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
    .map(unit)
)
poses = st.builds(RigidTransform, quats, st.tuples(finite, finite, finite))
stamps = st.integers(0, 10**19)
rows = st.lists(
    st.builds(RelativePose, stamps, stamps, poses),
    max_size=5,
    unique_by=lambda row: (row.reference, row.query),
)


@given(rows)
def test_every_bit_reads_back(
    tmp_path_factory: pytest.TempPathFactory, written: list[RelativePose]
) -> None:
    path = tmp_path_factory.getbasetemp() / "mlad_round_trip.txt"
    write_mlad_file(path, written)
    assert read_mlad_file(path) == written


def test_the_columns_of_the_challenge() -> None:
    pose = RigidTransform((0.6, 0.8, 0.0, 0.0), (1.5, -0.2, 3.0))
    text = format_mlad_file([RelativePose(1602074877390449152, 5, pose)])
    assert text == "1602074877390449152 5 1.5 -0.2 3.0 0.8 0.0 0.0 0.6\n"


def test_relative_poses_are_query_from_reference() -> None:
    rng = np.random.default_rng(0)
    turns = Rotation.random(2, random_state=0)
    centers = rng.normal(size=(2, 3)) * 1e3
    query, reference = (
        RigidTransform.from_matrix(turn.as_matrix(), -turn.apply(center))
        for turn, center in zip(turns, centers, strict=True)
    )
    found = relative_pose(query, reference)
    point = rng.normal(size=(1, 3)) * 1e3
    np.testing.assert_allclose(found.apply(reference.apply(point)), query.apply(point), atol=1e-9)
    scaled = relative_pose(query, reference, scale=2.5)
    assert scaled.quat_wxyz == found.quat_wxyz
    np.testing.assert_allclose(scaled.translation, 2.5 * np.array(found.translation))


@pytest.mark.parametrize("end", ["\n", ""])
def test_lists_of_pairs(tmp_path: Path, end: str) -> None:
    path = tmp_path / "pairs.txt"
    path.write_bytes(b"1600000000000000000 1600000000000000001\r\n\r\n3\t4" + end.encode())
    assert read_mlad_file(path) == [
        RelativePose(1600000000000000000, 1600000000000000001),
        RelativePose(3, 4),
    ]


def test_true_poses_of_training_files_without_a_last_line_end(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(GOOD + "100 206 0 0 0 0 0 0 1")
    first, second = read_mlad_file(path)
    assert first.query_from_reference == RigidTransform((0.6, 0.8, 0.0, 0.0), (1.5, -0.2, 3.0))
    assert second == RelativePose(100, 206, HERE)


def test_an_empty_file_has_no_rows(tmp_path: Path) -> None:
    write_mlad_file(tmp_path / "poses.txt", [])
    assert (tmp_path / "poses.txt").read_bytes() == b""
    assert read_mlad_file(tmp_path / "poses.txt") == []


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("100 205", "2 columns instead of 9"),
        ("100 206 0 0 0 0 0 0", "8 columns instead of 9 .src_ts tgt_ts tx"),
        ("100 206 0 0 0 0 0 0 1 1", "10 columns"),
        ("# src tgt", "3 columns"),
        ("100 206 0 0 0 0 0 0 x", "'x' is not a number"),
        ("100 206 0 0 0 0 0 0 1_0", "'1_0' is not a number"),
        ("100 206 0 0 nan 0 0 0 1", "pair 100 206: the pose is not finite"),
        ("100 206 0 0 0 0 0 0.1 1", "length 1.00499"),
        ("100 206 0 0 0 0 0 0 0", "length 0"),
        ("1e2 206 0 0 0 0 0 0 1", "'1e2' is not a timestamp"),
        ("0100 206 0 0 0 0 0 0 1", "not a timestamp"),
        ("-100 206 0 0 0 0 0 0 1", "not a timestamp"),
        ("100 205 0 0 0 0 0 0 1", "pair 100 205 is given twice"),
    ],
)
def test_broken_lines_are_named(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(f"{GOOD}\n{line}\n")
    with pytest.raises(DataError, match=words) as caught:
        read_mlad_file(path)
    assert caught.value.line == 3 and str(caught.value).startswith(f"{path}:3: ")


def test_a_pose_among_pairs(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text("1 2\n" + GOOD)
    with pytest.raises(DataError, match="9 columns instead of 2, as in the rows before"):
        read_mlad_file(path)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (RelativePose(1, 2), "pair 1 2 has no pose; MLAD wants every row"),
        (RelativePose(1, 2, RigidTransform((1, 0, 0, 0), (math.inf, 0, 0))), "not finite"),
        (RelativePose(1, 2, RigidTransform((0.9, 0, 0, 0), (0, 0, 0))), "length 0.9"),
    ],
)
def test_rows_that_must_not_be_handed_in(tmp_path: Path, row: RelativePose, words: str) -> None:
    with pytest.raises(DataError, match=words):
        write_mlad_file(tmp_path / "poses.txt", [RelativePose(1, 1, HERE), row])
    assert list(tmp_path.iterdir()) == []


def test_timestamps_are_the_names_of_images() -> None:
    assert timestamp_of("rec/cam0/1602074877390449152.png") == 1602074877390449152
    for name in ("a/frame_1.png", "0100.png", "1.5.png", "-5.png", "a/.png"):
        with pytest.raises(DataError, match="not named after a timestamp"):
            timestamp_of(name)


def test_an_unwritable_place_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        write_mlad_file(tmp_path / "file" / "poses.txt", [])


@given(st.binary(max_size=60), st.integers(0, 2 * len(GOOD)))
def test_random_damage_never_crashes(
    tmp_path_factory: pytest.TempPathFactory, junk: bytes, place: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "mlad_damaged.txt"
    good = (GOOD + GOOD.replace("205", "206")).encode()
    path.write_bytes(good[:place] + junk + good[place:])
    try:
        found = read_mlad_file(path)
    except DataError as error:
        assert str(path) in str(error) and "\n" not in str(error)
    else:
        given_poses = [row.query_from_reference for row in found if row.query_from_reference]
        assert all(np.isfinite(pose.translation).all() for pose in given_poses)
