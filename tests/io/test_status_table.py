"""status.csv: round trip, order, and what contradicts itself."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from megloc_kapture.errors import DataError
from megloc_kapture.io.status_table import QueryStatus, read_status, write_status

HEADER = (
    "image,status,reason,num_matches,num_inliers,cluster,fallback,candidates,refinement,remarks\n"
)
LOCALIZED = QueryStatus(
    image="q/b.jpg",
    status="localized",
    num_matches=310,
    num_inliers=120,
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
        f'{HEADER}q/a.jpg,failed,"7 inliers, 12 needed",0,0,,retrieval,,,\n'
        'q/b.jpg,localized,,310,120,0,none,"map/2; left.jpg,map/1.jpg",icp: accepted,\n'
    )


def test_two_rows_for_one_query(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="two statuses"):
        write_status(tmp_path / "status.csv", [FAILED, FAILED])
    (tmp_path / "status.csv").write_text(HEADER + 2 * "a.jpg,localized,,9,9,,none,,,\n")
    with pytest.raises(DataError, match="named twice") as caught:
        read_status(tmp_path / "status.csv")
    assert caught.value.line == 3


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("a.jpg,lost,,0,0,,none,", "status"),
        ("a.jpg,localized,,x,0,,none,", "num_matches"),
        ("a.jpg,localized,,-1,0,,none,", "num_matches"),
        ("a.jpg,localized,,3,1.5,,none,", "num_inliers"),
        ("a.jpg,localized,,3,1,one,none,", "cluster"),
        ("a.jpg,failed,why,0,0,,identity,", "fallback"),
        ("a.jpg,failed,,0,0,,none,", "needs a reason"),
        ("a.jpg,localized,,3,1,,retrieval,", "no fallback"),
        ("a.jpg,localized,why,3,1,,none,", "no reason"),
        ('a.jpg,localized,,3,1,,none,"x,,y"', "candidate"),
        ("../a.jpg,localized,,3,1,,none,", "leads out"),
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
