"""Localizing from Python in a map made of rendered images; no data from elsewhere."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from megloc_kapture import KaptureMap, Localizer, Pose, Query
from megloc_kapture.evaluation.metrics import pose_errors
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.datasets import choose_dataset
from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.plan import run_plan
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.run import Run
from megloc_kapture.pipeline.workspace import Workspace

OPTIONS = options_of_preset(assignments=["local_features.options.max_keypoints=800"])


@pytest.fixture(scope="module")
def localizer(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Localizer:
    workspace = Workspace(tmp_path_factory.mktemp("rendered") / "workspace")
    with workspace.lock():
        run = Run(choose_dataset("kapture", scene), "classic", OPTIONS, workspace)
        run_plan(plan_evaluation(run), workspace, last="map")
    return Localizer(KaptureMap.open(workspace.root / "map"), options=OPTIONS)


@pytest.fixture(scope="module")
def queries(scene: Path) -> list[Query]:
    folder = KaptureFolder(scene / "query")
    data = folder.read()
    return [
        Query(data.camera_of(name), folder.image_path(name), name) for name in data.image_names()
    ]


def content(found: object) -> tuple[object, ...]:
    """The numbers of a pose, to the last bit."""
    assert isinstance(found, Pose)
    assert found.covariance is not None and found.inliers is not None
    arrays = (found.covariance.tobytes(), found.inliers.tobytes())
    return (found.cam_from_world, found.candidates, *arrays)


def test_queries_are_found_within_millimetres(
    localizer: Localizer, queries: list[Query], scene: Path
) -> None:
    truth = KaptureFolder(scene / "query_gt").read().poses()
    found = {query.name: localizer.localize(query.image, query.camera) for query in queries}
    poses = {name: pose.cam_from_world for name, pose in found.items() if pose}
    errors = pose_errors(poses, truth)
    assert len(poses) == 4
    assert max(errors.position_m) < 0.01 and max(errors.angle_deg) < 0.05


@pytest.mark.parametrize("workers", [1, 2])
def test_a_pool_of_threads_changes_no_bit(
    localizer: Localizer, queries: list[Query], workers: int
) -> None:
    alone = [content(localizer.localize_query(query)) for query in queries]
    # this thread has used the limits of the libraries' threads before, and keeps its own
    with threadpool_limits(limits=2):
        before = threadpool_info()
        with ThreadPoolExecutor(workers) as pool:
            together = [content(found) for found in localizer.localize_many(queries * 3, pool)]
        assert threadpool_info() == before
    assert together == alone * 3


def test_a_black_image_fails_and_says_why(localizer: Localizer, queries: list[Query]) -> None:
    found = localizer.localize(np.zeros((300, 400, 3), np.uint8), queries[0].camera)
    assert not found and found.reason == "no map image matches"
