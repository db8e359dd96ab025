"""The default of ``make eval`` is real work: retrieval errs, night is hard, verification helps."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.io.dataset_tables import read_groups
from megloc_kapture.io.images import image_size
from megloc_kapture.io.kapture import KaptureFolder, read_pairs
from megloc_kapture.pipeline.plan import Workspace
from tests.pipeline.runs import recall

pytestmark = pytest.mark.slow

FAR_M = 40.0  # two squares of the world are farther apart


def run(workspace: Path, verification: str) -> dict[str, float]:
    """Run the whole pipeline with fewer keypoints than by default; recall at 0.25 m, 2 deg."""
    arguments = ["eval", "synthetic", "--workspace", str(workspace), "--quiet"]
    arguments += ["--set", f"verification={verification}"]
    arguments += ["--set", "local_features.options.max_keypoints=2000"]
    command = "from megloc_kapture.cli.main import main; main()"
    subprocess.run([sys.executable, "-c", command, *arguments], check=True, capture_output=True)
    return {name: recall(Workspace(workspace), name)[1] for name in ("day", "night", "all")}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, float]]:
    """The workspace, and recall without verification; the last run is that with it."""
    workspace = tmp_path_factory.mktemp("synthetic") / "workspace"
    return workspace, run(workspace, "none")


def test_world_is_large_and_first_retrieved_images_are_often_wrong(
    runs: tuple[Path, dict[str, float]],
) -> None:
    workspace, _ = runs
    mapping, query = (KaptureFolder(workspace / part) for part in ("mapping", "query"))
    map_poses = mapping.read().poses()
    assert len(map_poses) >= 80
    assert len(query.read().image_names()) >= 40
    for folder in (mapping, query):
        for image in folder.read().image_names():
            width, height = image_size(folder.image_path(image))
            assert width >= 640 and height >= 480
    squares: list[np.ndarray] = []
    for center in (pose.center() for pose in map_poses.values()):
        if all(np.linalg.norm(center - square) > FAR_M for square in squares):
            squares.append(center)
    assert len(squares) >= 3

    truth = KaptureFolder(workspace / "query_gt").read().poses()
    first: dict[str, str] = {}
    for pair in read_pairs(workspace / "pairs" / "query.txt"):
        first.setdefault(pair.query, pair.map)
    wrong = [
        np.linalg.norm(truth[query].center() - map_poses[image].center()) > FAR_M
        for query, image in first.items()
    ]
    assert np.mean(wrong) >= 0.1


def test_night_is_harder_than_day_and_verification_helps(
    runs: tuple[Path, dict[str, float]],
) -> None:
    workspace, without = runs
    conditions = {group.condition for group in read_groups(workspace / "megloc").values()}
    assert {"day", "night"} <= conditions
    verified = run(workspace, "geometric")
    assert verified["day"] >= 0.95
    assert 0.2 <= verified["night"] <= verified["day"] - 0.1
    assert without["all"] <= verified["all"] - 0.05
