"""The four rendered twins, small, from their official layout to a recall table and a pose file."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from megloc_kapture.evaluation.check.reading import read_reference
from megloc_kapture.evaluation.check.submission import check_submission
from megloc_kapture.pipeline.datasets import TWIN_PREFIX, choose_dataset, twin_of
from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.executors import open_executor, single_threaded
from megloc_kapture.pipeline.plan import all_kept, run_plan
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.run import Run, find_benchmark
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.work import Work

pytestmark = pytest.mark.slow

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
# conditions that are hard by design: a failure there is reported, not hidden
DARK = {"night", "night-rain", "night-all", "all"}


@pytest.fixture(scope="module", params=list(SMALL))
def finished(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Workspace, Callable[[], list[Any]]]:
    """A twin's name, the workspace of its finished run, and what runs it again."""
    name = str(request.param)
    dataset = f"{TWIN_PREFIX}{name}"
    benchmark = find_benchmark(dataset)
    source = choose_dataset(dataset, None, import_options=benchmark.import_options)
    source = replace(source, twin=twin_of(name, **SMALL[name]))
    workspace = Workspace(tmp_path_factory.mktemp(name) / "workspace")
    changes = [
        "local_features.options.max_keypoints=1500",
        "global_features.options.num_clusters=32",
    ]
    options = options_of_preset(changes=[benchmark.options], assignments=changes)

    def again() -> list[Any]:
        with workspace.lock(), single_threaded(), open_executor("processes", 2) as executor:
            run = Run(source, "classic", options, workspace, benchmark)
            return run_plan(plan_evaluation(run), workspace, Work(executor))

    again()
    return name, workspace, again


def test_day_queries_are_localized_and_dark_ones_are_reported(finished: Any) -> None:
    name, workspace, _ = finished
    found = json.loads(workspace.path("evaluation/recall.json").read_text())
    rows = {row["name"]: row for row in found["rows"]}
    assert rows["all"]["num_queries"] > 0
    day = {key: row for key, row in rows.items() if key not in DARK and "dusk" not in key}
    assert name == "inloc" or day
    for key, row in day.items():
        assert row["recall"][1]["recall"] == 1.0, (key, row)
    for row in rows.values():
        assert row["num_localized"] + row["num_fallback"] + row["num_missing"] == row["num_queries"]


def test_what_is_handed_in_passes_the_check(finished: Any) -> None:
    name, workspace, _ = finished
    stem = workspace.path(f"submissions/{TWIN_PREFIX}{name}_eval_megloc-classic")
    place = stem if stem.is_dir() else stem.with_name(f"{stem.name}.txt")
    report = check_submission(place, dataset=name, reference=read_reference(workspace.root))
    assert report.poses > 0
    assert not report.has_problems, report.lines()


def test_a_second_run_has_nothing_to_do(finished: Any) -> None:
    assert all_kept(finished[2]())
