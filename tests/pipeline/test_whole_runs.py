"""Whole runs: the rendered twins of the datasets, and a preset with learned features."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture import KaptureMap, Localizer
from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.check import check_submission, read_reference
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.datasets import TWIN_PREFIX
from megloc_kapture.pipeline.evaluation_plan import recall_rows
from megloc_kapture.pipeline.plan import Workspace, all_kept
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.results import Results
from megloc_kapture.stages.options import PipelineOptions
from tests.pipeline.runs import errors, evaluated, run_twin

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
# conditions that are hard by design
DARK = {"night", "night-rain", "night-all", "all"}


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


def modern(*assignments: str) -> PipelineOptions:
    """Return the preset with small images and few keypoints."""
    small = ("preprocessing.max_size_px=640", "global_features.options.num_clusters=16")
    few = "local_features.aliked.options.max_keypoints=600"
    return options_of_preset("modern", assignments=[*assignments, few, *small])


def test_modern_maps_smaller_images_and_localizes_whole_ones(
    fountain: Path, shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(shared_data / "weights"))
    options = modern()
    workspace = evaluated(tmp_path / "workspace", fountain, options)
    # localized queries have their original size
    for folder, width in (("map", 640), ("localized", 1536)):
        data = KaptureFolder(workspace.path(folder)).read()
        assert {data.camera_of(image).width for image in data.image_names()} == {width}
    opened = KaptureMap.open(workspace.path("map"))
    assert opened.pixel_origin.intrinsics == "corner"
    truth = KaptureFolder(fountain / "query_gt").read().poses()
    found = Results(Localizer(opened, options=options), fountain / "query")
    assert np.median([errors(pose, truth[name])[0] for name, pose in found.items()]) < 0.02
    with pytest.raises(OptionError, match=r"Query\(mask=...\)"):
        Localizer(opened, options=modern("preprocessing.masks.unchanging=true"))
