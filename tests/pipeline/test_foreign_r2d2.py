"""R2D2 as extracted here, in a map that others made with theirs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from megloc_kapture import Failure, KaptureMap, Localizer, Pose, Query
from megloc_kapture.evaluation.metrics import pose_errors
from megloc_kapture.features.r2d2 import R2D2, R2D2Options
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.queries import KaptureQueries
from megloc_kapture.values import RigidTransform

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def gallery(shared_data: Path) -> Path:
    return shared_data / "foreign_maps" / "virtual_gallery"


@pytest.fixture(scope="module")
def localizer(gallery: Path) -> Localizer:
    return Localizer(KaptureMap.open(gallery / "map"))


@pytest.fixture(scope="module")
def extractor(shared_data: Path) -> R2D2:
    """With the options the map's makers had: the levels from 1024 to 600 pixels."""
    weights = shared_data / "weights" / "r2d2" / "r2d2_WASF_N16.pt"
    return R2D2(R2D2Options(weights=str(weights), device="cpu", max_keypoints=500, min_size=600))


def errors(found: Pose | Failure, truth: RigidTransform | None) -> tuple[float, float]:
    """Metres and degrees."""
    assert isinstance(found, Pose), found
    assert truth is not None
    result = pose_errors({"it": found.cam_from_world}, {"it": truth})
    return float(result.position_m[0]), float(result.angle_deg[0])


# two of the four: the other two, at half a minute each, come out alike
@pytest.mark.parametrize("number", ["00267", "00446"])
def test_our_features_localize_as_well_as_those_it_came_with(
    gallery: Path, localizer: Localizer, extractor: R2D2, number: str
) -> None:
    queries = KaptureQueries(KaptureFolder(gallery / "query"), localizer.map)
    query: Query = next(query for query in queries if number in query.name)
    truth = KaptureFolder(gallery / "query_gt").read().cam_from_world(query.name)
    with_theirs = errors(localizer.localize_query(query), truth)

    features = extractor.extract(query.read_image())
    with_ours = errors(
        localizer.localize_query(replace(query, features={"r2d2_500": features})), truth
    )
    assert with_ours[0] < 0.02 and with_ours[1] < 0.4
    for ours, theirs in zip(with_ours, with_theirs, strict=True):
        assert ours <= 1.5 * theirs
