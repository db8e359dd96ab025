"""``megloc refine-map`` on a map of another tool, and what ``megloc info`` says of the result."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from kapture.io.csv import kapture_from_dir

from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.kapture.points import read_point_covariances


def rows_of(text: str) -> dict[str, tuple[int, int]]:
    """The table's rows: points and observations by name."""
    found = re.findall(r"(before|after|[a-z]+(?: [a-z]+)?) +(-?\d+) +(-?\d+)$", text, re.MULTILINE)
    return {name: (int(points), int(seen)) for name, points, seen in found}


def test_a_foreign_map_is_refined_and_localized_in(
    megloc: Any,
    shared_data: Path,
    tmp_path: Path,
    contents: Callable[[Path], dict[str, bytes]],
) -> None:
    place = shared_data / "foreign_maps" / "virtual_gallery"
    before = contents(place)
    out = tmp_path / "refined"
    keep = ("--set", "refinement.uncertainty.keep_quantile=0.9")
    close = ("--set", "refinement.consistency.max_reprojection_error_px=3")
    done = megloc("refine-map", "-i", place / "map", "-o", out, *keep, *close, "--ply")
    assert done.status == 0
    assert contents(place) == before
    told = megloc("info", out).out
    rows = rows_of(told)
    assert rows == rows_of(done.err)
    assert list(rows) == ["before", "reprojection error", "uncertainty", "after"]
    sums = np.array(list(rows.values()))
    np.testing.assert_array_equal(sums[:-1].sum(axis=0), sums[-1])
    assert (sums[1:-1] < 0).any(axis=0).all()
    old, new = KaptureFolder(place / "map"), KaptureFolder(out)
    assert rows["before"] == (len(old.points3d()), sum(map(len, old.observations().values())))
    assert rows["after"] == (len(new.points3d()), sum(map(len, new.observations().values())))
    left = {tuple(row) for row in new.points3d().tolist()}
    assert left < {tuple(row) for row in old.points3d().tolist()}
    covariances = read_point_covariances(out, len(new.points3d()))
    assert covariances is not None
    known = int(np.isfinite(covariances).all(axis=1).sum())
    assert f"known of {known} points" in told
    theirs = kapture_from_dir(str(out))
    assert len(theirs.points3d) == len(left)
    localized = megloc("localize", "-i", out, "--query", place / "query", "-o", tmp_path / "poses")
    assert localized.out.startswith("4 of 4 queries localized in ")


def test_info_of_a_map_that_was_not_refined_says_nothing_of_it(
    megloc: Any, shared_data: Path
) -> None:
    told = megloc("info", shared_data / "foreign_maps" / "virtual_gallery" / "map").out
    assert "refinement" not in told
    assert "uncertainty" not in told


def test_what_cannot_be_refined_is_refused(megloc: Any, gallery: Path, tmp_path: Path) -> None:
    out = tmp_path / "refined"
    query = megloc("refine-map", "-i", gallery / "query", "-o", out)
    query.refused("no map to refine", "points3d.txt")
    unknown = ("--set", "refinement.uncertainty.max_sigma=1")
    megloc("refine-map", "-i", gallery / "map", "-o", out, *unknown).refused(
        "unknown option refinement.uncertainty.max_sigma; did you mean 'max_robust_sigmas'. known "
        "here: .*keep_quantile"
    )
    assert not out.exists()
    (gallery / "full").mkdir()
    (gallery / "full" / "file").touch()
    megloc("refine-map", "-i", gallery / "map", "-o", gallery / "full").refused("is not empty")


def test_a_broken_report_is_named(megloc: Any, gallery: Path) -> None:
    report = gallery / "map" / "reconstruction" / "refinement.json"
    report.write_text('{"points_before": "many"}')
    done = megloc("info", gallery / "map")
    assert done.status == 2
    assert "refinement.json" in done.err
