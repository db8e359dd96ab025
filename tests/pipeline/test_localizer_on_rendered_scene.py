"""Localizing from Python in a map made of rendered images; no data from elsewhere."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from megloc_kapture import KaptureMap, Localizer, Pose, Query
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.presets import options_of_preset
from tests.pipeline.runs import errors, evaluated

OPTIONS = options_of_preset(assignments=["local_features.options.max_keypoints=800"])


@pytest.fixture(scope="module")
def opened(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> KaptureMap:
    root = tmp_path_factory.mktemp("rendered") / "workspace"
    return KaptureMap.open(evaluated(root, scene, OPTIONS, last="map").path("map"))


@pytest.fixture(scope="module")
def localizer(opened: KaptureMap) -> Localizer:
    return Localizer(opened, options=OPTIONS)


@pytest.fixture(scope="module")
def queries(scene: Path) -> list[Query]:
    folder = KaptureFolder(scene / "query")
    data = folder.read()
    return [Query(data.camera_of(n), folder.image_path(n), n) for n in data.image_names()]


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
    assert len(queries) == 4
    for query in queries:
        assert query.image is not None
        found = localizer.localize(query.image, query.camera)  # type: ignore[arg-type]
        metres, degrees = errors(found, truth[query.name])
        assert metres < 0.01 and degrees < 0.05


@pytest.fixture(scope="module")
def alone(localizer: Localizer, queries: list[Query]) -> list[tuple[object, ...]]:
    return [content(localizer.localize_query(query)) for query in queries]


@pytest.mark.parametrize("workers", [1, 4])
def test_a_pool_of_threads_changes_no_bit(
    opened: KaptureMap, queries: list[Query], alone: list[tuple[object, ...]], workers: int
) -> None:
    fresh = Localizer(opened, options=OPTIONS)  # the threads make what it keeps
    # this thread has used the limits of the libraries' threads before, and keeps its own
    with threadpool_limits(limits=2):
        before = threadpool_info()
        with ThreadPoolExecutor(workers) as pool:
            together = [content(found) for found in fresh.localize_many(queries * 2, pool)]
        assert threadpool_info() == before
    assert together == alone * 2


def test_a_black_image_fails_and_says_why(localizer: Localizer, queries: list[Query]) -> None:
    found = localizer.localize(np.zeros((300, 400, 3), np.uint8), queries[0].camera)
    assert not found and found.reason == "no map image matches"
