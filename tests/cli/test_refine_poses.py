"""``megloc refine-poses``: what it says, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import read_status

INLINE = ("--executor", "inline")


def command(finished: Path, output: Path) -> list[Any]:
    return [
        *("refine-poses", "-i", finished / "map", "--query", finished / "query"),
        *("--poses", finished / "localized", "-o", output, *INLINE),
    ]


def test_poses_without_depth_stay_and_say_so(megloc: Any, finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "refined"
    done = megloc(*command(finished, out), "--by", "icp", "-q")
    assert (done.status, done.err) == (0, "")
    assert done.out.startswith("4 poses, 0 accepted by icp; status.csv and refinement.csv in")
    before, after = (KaptureFolder(place).read().poses() for place in (finished / "localized", out))
    assert before == after
    for status in read_status(out / "status.csv").values():
        assert status.status == "localized"
        assert status.refinement.startswith("icp: ") and "depth" in status.refinement
    # the result is one to evaluate and to refine again
    again = megloc(*command(finished, tmp_path / "again")[:5], "--poses", out, "-o", tmp_path / "b")
    again.refused("no pose refiner is chosen; --by takes: field, icp, rendering")


def test_refiners_work_one_after_another(megloc: Any, finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "refined"
    done = megloc(*command(finished, out), "--by", "icp", "--by", "rendering", "-q")
    assert done.out.startswith("4 poses, 0 accepted by icp, 0 accepted by rendering;")
    for status in read_status(out / "status.csv").values():
        first, second = status.refinement.split("; ")
        assert first.startswith("icp: ") and second.startswith("rendering: ")


def test_what_is_refused(megloc: Any, finished: Path, tmp_path: Path) -> None:
    megloc(*command(finished, tmp_path / "out"), "--by", "magic").refused(
        "no plugin 'magic' in megloc_kapture.pose_refiners; registered: field, icp, rendering"
    )
    megloc(*command(finished, tmp_path / "out"), "--by", "field").refused("train-field")
    bare = [*command(finished, tmp_path / "out")]
    bare[bare.index("--poses") + 1] = finished / "query"
    megloc(*bare, "--by", "icp").refused(r"status\.csv")
    assert not (tmp_path / "out").exists()
