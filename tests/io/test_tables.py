"""CSV tables of a workspace: round trips and variants."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import read_csv_table, read_records, write_csv_table, write_records
from megloc_kapture.io.tables import (
    ConsistencyRow,
    read_refinement,
    read_status,
    write_clusters,
    write_refinement,
    write_status,
)
from megloc_kapture.values import Failure, LocalizationResult, Pose, PoseRefinement, RigidTransform

COLUMNS = ("image", "reason")


def test_pandas_reads_a_written_table(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    write_csv_table(path, ["image", 'of "a, b"'], [("a.jpg", "1")])
    assert pd.read_csv(path).columns.tolist() == ["image", 'of "a, b"']
    write_csv_table(path, COLUMNS, [("a b.jpg", "few, far"), ("c.jpg", "")])
    assert path.read_bytes() == b'image,reason\na b.jpg,"few, far"\nc.jpg,\n'


def test_line_ends_byte_order_mark_and_order_of_columns_do_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    for text in ("image,reason\r\na,b\r\n", "\ufeffimage,reason\na,b", "reason,image\nb,a\n\n"):
        path.write_text(text, encoding="utf-8", newline="")
        assert [row for _, row in read_csv_table(path, COLUMNS)] == [{"image": "a", "reason": "b"}]


# ------------------------------------------------------------------------ tables of a workspace


def test_the_status_table_reads_back(tmp_path: Path) -> None:
    nothing = {"num_matches": 0, "num_inliers": 0}
    reason = 'few, "far"\nmatches'
    results = [
        LocalizationResult(name="q/a.jpg", reason=reason, fallback="retrieval", **nothing),
        LocalizationResult(
            name="q/b é.jpg",
            num_matches=310,
            num_inliers=120,
            cluster=1,
            candidates=("m/1.jpg", "m/2.jpg"),
            remarks=("guided pyramid matching: no image",),
        ),
        LocalizationResult(name="q/c.jpg", reason="none", fallback="none", **nothing),
    ]
    write_status(tmp_path / "status.csv", results)
    read = read_status(tmp_path / "status.csv")
    assert list(map(vars, read.values())) == list(map(vars, results))


POSE = RigidTransform((0.5, -0.5, 0.1, 0.7), (1 / 3, -2e-9, 1e7))
LOCALIZED = Pose(POSE, 40, 30, candidates=("m/1.png", "m/2.png"), score=30.25)
LOST = Failure("7 2D-3D matches, at least 12 are needed", 7, candidates=("m/3.png",))


def test_the_clusters_table_has_a_row_per_cluster(tmp_path: Path) -> None:
    path = tmp_path / "clusters.csv"
    chosen = LocalizationResult(name="a", clusters=(LOST, LOCALIZED), cluster=1)
    write_clusters(path, [Failure("none", name="b", clusters=(LOST,)), chosen, Failure("x")])
    lost = ',no,7,0,,"7 2D-3D matches, at least 12 are needed",m/3.png,'
    assert path.read_text().splitlines() == [
        "image,cluster,chosen,num_matches,num_inliers,score,reason,images,cam_from_world",
        f"a,0{lost}",
        'a,1,yes,40,30,30.25,,"m/1.png,m/2.png",'
        "0.5 -0.5 0.1 0.7 0.3333333333333333 -2e-09 10000000.0",
        f"b,0{lost}",
    ]


START = RigidTransform((0.6, 0.0, 0.8, 0.0), (1.0, -2.0, 0.1))


def step(method: str, end: RigidTransform, reason: str = "", **known: Any) -> PoseRefinement:
    return PoseRefinement(end, reason, method=method, before=START, **known)


MOVED = step("rendering", POSE, measures={"cost": 0.1, "points": 900}, moved_m=0.02, turned_deg=0.1)
RESULTS = [
    LocalizationResult(name="b.jpg", refinements=(step("rendering", START, "no depth"),)),
    LocalizationResult(
        name="a.jpg", refinements=(step("icp", START, "the overlap fell, a bit"), MOVED)
    ),
]


def test_refinements_read_back_by_image_with_their_steps_in_order(tmp_path: Path) -> None:
    path = tmp_path / "refinement.csv"
    write_refinement(path, RESULTS)
    read = read_refinement(path, {"a.jpg": POSE})
    assert list(read) == ["a.jpg", "b.jpg"]
    for result in RESULTS:
        assert list(map(vars, read[result.name])) == list(map(vars, result.refinements))


ROW = ConsistencyRow("DUC1", "rendering", 13, 2, 0.016, 0.25, 1.5, 0.024, 0.3, 11.5, "")


def test_the_consistency_table_reads_back_with_empty_unknown_values(tmp_path: Path) -> None:
    path = tmp_path / "map_consistency.csv"
    rows = [ROW, replace(ROW, frame="", reason="the depth maps, of one scan, disagree")]
    unknown = ConsistencyRow("", "rendering", 0, 0, *6 * [float("nan")], "no depth")
    write_records(path, ConsistencyRow, [*rows, unknown])
    assert path.read_text().splitlines()[-1] == ",rendering,0,0,,,,,,,no depth"
    *measured, last = read_records(path, ConsistencyRow)
    assert measured == rows and last.reason == "no depth" and last.moved_m != last.moved_m


def test_a_status_table_without_confidences_reads(tmp_path: Path) -> None:
    path = tmp_path / "status.csv"
    path.write_text(
        "image,status,reason,num_matches,num_inliers,cluster,fallback,candidates,refinement\n"
        "q/b.jpg,localized,,310,120,0,none,map/1.jpg,\n"
    )
    row = read_status(path)["q/b.jpg"]
    assert row.confidence is None and row.remarks == () and row.num_inliers == 120
    path.write_text("image,status,confidence\nq/b.jpg,localized,0.5\n")
    with pytest.raises(DataError, match="the columns should be"):
        read_status(path)
