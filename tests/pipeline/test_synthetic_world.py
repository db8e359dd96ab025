"""The default of ``make eval`` is real work: retrieval errs, night is hard, verification helps."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.io.dataset_tables import read_groups
from megloc_kapture.io.images import image_size
from megloc_kapture.io.kapture import KaptureFolder, read_pairs

pytestmark = pytest.mark.slow

MIDDLE = 1  # of the thresholds: 0.25 m, 2 deg


def run(workspace: Path, verification: str) -> dict[str, Any]:
    """Run the whole pipeline with fewer keypoints than by default; recall rows by name."""
    arguments = ["eval", "synthetic", "--workspace", str(workspace), "--quiet"]
    arguments += ["--set", f"verification={verification}"]
    arguments += ["--set", "local_features.options.max_keypoints=2000"]
    command = "from megloc_kapture.cli.main import main; main()"
    subprocess.run([sys.executable, "-c", command, *arguments], check=True, capture_output=True)
    rows = json.loads((workspace / "evaluation" / "recall.json").read_text())["rows"]
    return {row["name"]: row for row in rows}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], dict[str, Any]]:
    workspace = tmp_path_factory.mktemp("synthetic") / "workspace"
    without = run(workspace, "none")
    return workspace, without, run(workspace, "geometric")


def test_world_is_large_enough(runs: tuple[Path, dict[str, Any], dict[str, Any]]) -> None:
    workspace = runs[0]
    mapping, query = (KaptureFolder(workspace / part) for part in ("mapping", "query"))
    assert len(mapping.read().poses()) >= 80
    assert len(query.read().image_names()) >= 40
    for folder in (mapping, query):
        for image in folder.read().image_names():
            width, height = image_size(folder.image_path(image))
            assert width >= 640
            assert height >= 480
    centers = np.array([pose.center() for pose in mapping.read().poses().values()])
    places: list[np.ndarray] = []
    for center in centers:
        if all(np.linalg.norm(center - place) > 40 for place in places):
            places.append(center)
    assert len(places) >= 3


def test_first_retrieved_image_is_often_wrong(
    runs: tuple[Path, dict[str, Any], dict[str, Any]],
) -> None:
    workspace = runs[0]
    truth = KaptureFolder(workspace / "query_gt").read().poses()
    mapping = KaptureFolder(workspace / "mapping").read().poses()
    first: dict[str, str] = {}
    for pair in read_pairs(workspace / "pairs" / "query.txt"):
        first.setdefault(pair.query, pair.map)
    wrong = [
        np.linalg.norm(truth[query].center() - mapping[image].center()) > 40
        for query, image in first.items()
    ]
    assert np.mean(wrong) >= 0.1


def test_night_is_harder_than_day(runs: tuple[Path, dict[str, Any], dict[str, Any]]) -> None:
    workspace, _, verified = runs
    conditions = {group.condition for group in read_groups(workspace / "megloc").values()}
    assert {"day", "night"} <= conditions
    day, night = (verified[name]["recall"][MIDDLE]["recall"] for name in ("day", "night"))
    assert day >= 0.95
    assert 0.2 <= night <= day - 0.1


def test_without_verification_recall_is_lower(
    runs: tuple[Path, dict[str, Any], dict[str, Any]],
) -> None:
    _, without, verified = runs
    recall = [rows["all"]["recall"][MIDDLE]["recall"] for rows in (without, verified)]
    assert recall[0] <= recall[1] - 0.05
