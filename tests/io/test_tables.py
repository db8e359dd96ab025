"""The tables of a workspace: round trips, order, and what contradicts itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from megloc_kapture.errors import DataError
from megloc_kapture.io.tables import (
    ConsistencyRow,
    QueryStatus,
    mask_counts_path,
    read_clusters,
    read_consistency,
    read_mask_counts,
    read_refinement,
    read_status,
    write_clusters,
    write_consistency,
    write_mask_counts,
    write_refinement,
    write_status,
)
from megloc_kapture.values import ClusterPose, RefinementRow, RigidTransform

HEADER = (
    "image,status,reason,num_matches,num_inliers,confidence,cluster,fallback,candidates,"
    "refinement,remarks\n"
)
LOCALIZED = QueryStatus(
    image="q/b.jpg",
    status="localized",
    num_matches=310,
    num_inliers=120,
    confidence=0.9766,
    cluster=0,
    candidates=("map/2; left.jpg", "map/1.jpg"),
    refinement="icp: accepted",
)
FAILED = QueryStatus(
    image="q/a.jpg", status="failed", reason="7 inliers, 12 needed", fallback="retrieval"
)

names = st.text(
    st.characters(exclude_characters="\0\\/,", exclude_categories=["Cc", "Cs"]), min_size=1
).filter(lambda name: name not in (".", ".."))
statuses = st.one_of(
    st.builds(
        QueryStatus,
        image=names,
        status=st.just("localized"),
        num_matches=st.integers(0, 10**6),
        num_inliers=st.integers(0, 10**6),
        cluster=st.none() | st.integers(0, 50),
        candidates=st.lists(names, max_size=4).map(tuple),
        refinement=st.sampled_from(["", "icp: accepted", "icp: it, then, moved 1 m"]),
        remarks=st.sampled_from(["", "guided pyramid matching: no image"]),
    ),
    st.builds(
        QueryStatus,
        image=names,
        status=st.just("failed"),
        reason=st.text(st.characters(exclude_characters="\0", codec="utf-8")).filter(str.strip),
        fallback=st.sampled_from(["none", "retrieval"]),
    ),
)


@given(st.lists(statuses, max_size=5, unique_by=lambda status: status.image))
def test_reads_back(tmp_path_factory: pytest.TempPathFactory, written: list[QueryStatus]) -> None:
    path = tmp_path_factory.getbasetemp() / "any_status.csv"
    write_status(path, written)
    assert read_status(path) == {status.image: status for status in written}


def test_rows_are_sorted_whatever_the_order(tmp_path: Path) -> None:
    first, second = tmp_path / "1.csv", tmp_path / "2.csv"
    write_status(first, [LOCALIZED, FAILED])
    write_status(second, [FAILED, LOCALIZED])
    assert first.read_bytes() == second.read_bytes()
    assert first.read_text() == (
        f'{HEADER}q/a.jpg,failed,"7 inliers, 12 needed",0,0,,,retrieval,,,\n'
        'q/b.jpg,localized,,310,120,0.9766,0,none,"map/2; left.jpg,map/1.jpg",icp: accepted,\n'
    )


def test_two_rows_for_one_query(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is given twice"):
        write_status(tmp_path / "status.csv", [FAILED, FAILED])
    (tmp_path / "status.csv").write_text(HEADER + 2 * "a.jpg,localized,,9,9,,,none,,,\n")
    with pytest.raises(DataError, match="is given twice") as caught:
        read_status(tmp_path / "status.csv")
    assert caught.value.line == 3


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("a.jpg,lost,,0,0,,,none,", "status"),
        ("a.jpg,localized,,x,0,,,none,", "num_matches"),
        ("a.jpg,localized,,-1,0,,,none,", "num_matches"),
        ("a.jpg,localized,,3,1.5,,,none,", "num_inliers"),
        ("a.jpg,localized,,3,1,,one,none,", "cluster"),
        ("a.jpg,failed,why,0,0,,,identity,", "fallback"),
        ("a.jpg,failed,,0,0,,,none,", "needs a reason"),
        ("a.jpg,localized,,3,1,,,retrieval,", "no fallback"),
        ("a.jpg,localized,why,3,1,,,none,", "no reason"),
        ("a.jpg,localized,,3,1,1.5,,none,", "confidence"),
        ('a.jpg,localized,,3,1,,,none,"x,,y"', "candidate"),
        ("../a.jpg,localized,,3,1,,,none,", "leads out"),
    ],
)
def test_broken_rows_name_line_and_field(tmp_path: Path, row: str, words: str) -> None:
    path = tmp_path / "status.csv"
    path.write_text(f"{HEADER}{row},,\n")
    with pytest.raises(DataError, match=words) as caught:
        read_status(path)
    assert caught.value.line == 2


def test_absent_table_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot read"):
        read_status(tmp_path / "status.csv")


def test_a_candidate_that_would_split_in_two() -> None:
    with pytest.raises(ValidationError, match="candidate"):
        QueryStatus(image="a.jpg", status="localized", candidates=("x,y.jpg",))


CLUSTERS_HEADER = (
    "image,cluster,chosen,num_matches,num_inliers,score,reason,images,cam_from_world\n"
)
POSE = RigidTransform((0.5, -0.5, 0.1, 0.7), (1 / 3, -2e-9, 1e7))
FOUND = ClusterPose(("m/1.png", "m/2.png"), 40, 30, POSE, 30.25)
LOST = ClusterPose(("m/3.png",), 7, reason="7 2D-3D matches, at least 12 are needed")


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "clusters.csv"
    write_clusters(path, [("b", (LOST,), None), ("a", (LOST, FOUND), 1), ("c", (), None)])
    found = read_clusters(path)
    assert list(found) == ["a", "b"]
    lost, chosen = found["a"]
    assert (lost.chosen, lost.score, lost.reason) == ("no", None, LOST.reason)
    assert (chosen.chosen, chosen.cluster, chosen.score) == ("yes", 1, 30.25)
    assert (chosen.num_matches, chosen.num_inliers, chosen.images) == (40, 30, FOUND.images)
    assert found["b"][0].chosen == "no"
    assert chosen.cam_from_world == FOUND.cam_from_world and lost.cam_from_world is None


def test_a_broken_row_is_named_by_its_line(tmp_path: Path) -> None:
    path = tmp_path / "clusters.csv"
    path.write_text(CLUSTERS_HEADER + "a,0,yes,many,3,1.5,,m/1.png,\n")
    with pytest.raises(DataError, match="num_matches") as caught:
        read_clusters(path)
    assert caught.value.line == 2


def test_a_broken_pose_is_named_by_its_line(tmp_path: Path) -> None:
    path = tmp_path / "clusters.csv"
    path.write_text(CLUSTERS_HEADER + "a,0,yes,4,3,1.5,,m/1.png,1 0 0 0 1 2\n")
    with pytest.raises(
        DataError, match=r"clusters\.csv:2: cam_from_world '1 0 0 0 1 2' is not a pose qw"
    ):
        read_clusters(path)


START = RigidTransform((0.6, 0.0, 0.8, 0.0), (1.0, -2.0, 0.1))
ROWS = [
    RefinementRow("a.jpg", "rendering", "", 0.02, 0.1, ("cost=0.1", "points=900"), START),
    RefinementRow("a.jpg", "icp", "the overlap fell, a bit", 0.0, 0.0, (), START),
    RefinementRow("b.jpg", "rendering", "no depth", 0.0, 0.0, (), RigidTransform.identity()),
]


def test_rows_read_back_by_image_with_their_steps_in_order(tmp_path: Path) -> None:
    path = tmp_path / "refinement.csv"
    write_refinement(path, [ROWS[2], *ROWS[:2]])
    assert read_refinement(path) == ROWS


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("0.020000", "far", "moved_m 'far' is not a number"),
        (",yes,", ",no,", "contradict"),
        (" -2.0 0.1", " -2.0", "qw qx qy qz tx ty tz"),
        ("0.6 0.0 0.8 0.0 1.0 -2.0 0.1", "", "before '' is not a pose"),
    ],
)
def test_a_broken_row_is_named_with_its_line(
    old: str, new: str, expected: str, tmp_path: Path
) -> None:
    path = tmp_path / "refinement.csv"
    write_refinement(path, ROWS[:1])
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(DataError, match=expected) as raised:
        read_refinement(path)
    assert f"{path}:2" in str(raised.value)


def test_counts_come_back(tmp_path: Path) -> None:
    counts = {"b/2.jpg": 0, 'a/"1".jpg': 1234}
    write_mask_counts(tmp_path, "rootsift", counts)
    assert read_mask_counts(tmp_path, "rootsift") == counts
    rows = mask_counts_path(tmp_path, "rootsift").read_text().splitlines()
    assert rows == ["image,num_masked", '"a/""1"".jpg",1234', "b/2.jpg,0"]
    assert read_mask_counts(tmp_path, "aliked-n16") == {}


@pytest.mark.parametrize("number", ["", "-1", "1.5", "many"])
def test_what_is_no_number_is_refused_by_line(tmp_path: Path, number: str) -> None:
    write_mask_counts(tmp_path, "rootsift", {"a.jpg": 1})
    path = mask_counts_path(tmp_path, "rootsift")
    path.write_text(f"image,num_masked\na.jpg,3\nb.jpg,{number}\n")
    with pytest.raises(DataError, match=r"masked\.csv:3: num_masked"):
        read_mask_counts(tmp_path, "rootsift")


ROW = ConsistencyRow("DUC1", "rendering", 13, 2, 0.016, 0.25, 1.5, 0.024, 0.3, 11.5, "")
NAN = float("nan")


def test_rows_read_back_in_order(tmp_path: Path) -> None:
    path = tmp_path / "map_consistency.csv"
    rows = [ROW, replace(ROW, frame="", reason="the map, of all, contradicts itself")]
    write_consistency(path, rows)
    assert read_consistency(path) == rows


def test_what_was_not_measured_is_empty(tmp_path: Path) -> None:
    path = tmp_path / "map_consistency.csv"
    write_consistency(
        path, [ConsistencyRow("", "rendering", 0, 0, NAN, NAN, NAN, NAN, NAN, NAN, "no depth")]
    )
    assert path.read_text().splitlines()[-1] == ",rendering,0,0,,,,,,,no depth"
    (row,) = read_consistency(path)
    assert row.reason == "no depth" and row.moved_m != row.moved_m


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (",13,", ",some,", "images 'some' is not a whole number from 0 on"),
        ("0.016", "far", "moved_m 'far' is not a number, or empty"),
    ],
)
def test_a_broken_row_is_named_with_its_line_of_consistency(
    old: str, new: str, expected: str, tmp_path: Path
) -> None:
    path = tmp_path / "map_consistency.csv"
    write_consistency(path, [ROW])
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(DataError, match=expected) as raised:
        read_consistency(path)
    assert f"{path}:2" in str(raised.value)


def test_a_table_of_before_confidences_reads(tmp_path: Path) -> None:
    path = tmp_path / "status.csv"
    path.write_text(
        "image,status,reason,num_matches,num_inliers,cluster,fallback,candidates,refinement\n"
        "q/b.jpg,localized,,310,120,0,none,map/1.jpg,\n"
    )
    row = read_status(path)["q/b.jpg"]
    assert row.confidence is None and row.remarks == "" and row.num_inliers == 120
    path.write_text("image,status,confidence\nq/b.jpg,localized,0.5\n")
    with pytest.raises(DataError, match="the header must name the columns"):
        read_status(path)
