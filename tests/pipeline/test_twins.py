"""The four rendered twins, from their official layout to a recall table and a pose file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.evaluation.check import check_submission, read_reference
from megloc_kapture.pipeline.datasets import TWIN_PREFIX
from megloc_kapture.pipeline.evaluation_plan import recall_rows
from megloc_kapture.pipeline.plan import Workspace, all_kept
from tests.pipeline.runs import run_twin

SMALL: dict[str, dict[str, Any]] = {
    "aachen": {
        "num_places": 2,
        "stations_per_place": 7,
        "day_queries": 4,
        "night_queries": 2,
        "width": 480,
        "height": 360,
    },
    "robotcar": {"num_locations": 2, "size_px": 360, "moments_per_condition": 2},
    "4seasons": {"num_places": 2, "map_keyframes": 24, "winter_keyframes": 6, "dusk_keyframes": 2},
    "inloc": {"queries": 6},
}
# conditions that are hard by design
DARK = {"night", "night-rain", "night-all", "all"}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_a_twin_from_its_layout_to_a_pose_file(name: str, tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "workspace")
    run_twin(workspace, name, SMALL[name])
    rows = recall_rows(workspace.root)
    assert rows["all"]["num_queries"] > 0
    day = {key: row for key, row in rows.items() if key not in DARK and "dusk" not in key}
    assert name == "inloc" or day
    for key, row in day.items():
        assert row["recall"][1]["recall"] == 1.0, (key, row)
    for row in rows.values():
        assert row["num_localized"] + row["num_fallback"] + row["num_missing"] == row["num_queries"]

    stem = workspace.path(f"submissions/{TWIN_PREFIX}{name}_eval_megloc-classic")
    place = stem if stem.is_dir() else stem.with_name(f"{stem.name}.txt")
    report = check_submission(place, dataset=name, reference=read_reference(workspace.root))
    assert report.poses > 0
    assert not report.has_problems, report.lines()

    assert all_kept(run_twin(workspace, name, SMALL[name]).values()), "a second run did something"
