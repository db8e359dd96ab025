"""Localization from Python, of one image and of many, in our maps and in foreign maps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture import Failure, KaptureMap, Localizer, Pose, Query
from megloc_kapture.errors import DataError
from megloc_kapture.features.r2d2 import R2D2, R2D2Options
from megloc_kapture.io.kapture import KaptureData, KaptureFolder
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.query_folders import KaptureQueries
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.values import LocalFeatures
from tests.pipeline.runs import errors


def few(*assignments: str) -> PipelineOptions:
    """Return the options that the map was made with."""
    keypoints = "local_features.options.max_keypoints=800"
    return options_of_preset(assignments=[keypoints, *assignments])


@pytest.fixture(scope="module")
def opened(workspace: Path) -> KaptureMap:
    return KaptureMap.open(workspace / "map")


@pytest.fixture(scope="module")
def localizer(opened: KaptureMap) -> Localizer:
    return Localizer(opened, options=few())


@pytest.fixture(scope="module")
def truth(scene: Path) -> KaptureData:
    return KaptureFolder(scene / "query_gt").read()


@pytest.fixture(scope="module")
def image(scene: Path) -> Path:
    """The image of the query 0004.jpg."""
    return scene / "query" / "sensors" / "records_data" / "0004.jpg"


@pytest.fixture(scope="module")
def queries(workspace: Path, scene: Path) -> list[Query]:
    """The four queries with their features."""
    folder = KaptureFolder(scene / "query", features_dirs=[workspace])
    data = folder.read()
    keypoints, descriptors = folder.keypoints("rootsift"), folder.descriptors("rootsift")
    scores = np.zeros(800, np.float32)
    return [
        Query(
            camera=data.camera_of(name),
            name=name,
            features={
                "rootsift": LocalFeatures(keypoints.read(name), scores, descriptors.read(name))
            },
        )
        for name in data.image_names()
    ]


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((10, 10, 3), np.uint8), r"is uint8 \(300, 400, 3\), got uint8 \(10, 10, 3\)"),
        (np.zeros((300, 400, 3)), r"is uint8 \(300, 400, 3\), got float64"),
    ],
    ids=["size", "float"],
)
def test_invalid_images_are_errors(
    localizer: Localizer, truth: KaptureData, image: object, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        localizer.localize(image, truth.camera_of("0004.jpg"))  # type: ignore[arg-type]


def test_masked_pixels_have_no_features(
    localizer: Localizer, image: Path, truth: KaptureData
) -> None:
    query = Query(truth.camera_of("0004.jpg"), image)
    mask = np.zeros((300, 400), bool)
    assert not localizer.localize_query(replace(query, mask=mask))
    mask[:, 180:] = True
    half = localizer.localize_query(replace(query, mask=mask))
    whole = localizer.localize_query(query)
    assert isinstance(half, Pose) and isinstance(whole, Pose)
    assert half.num_matches != whole.num_matches
    with pytest.raises(DataError, match="a mask is bool"):
        localizer.localize_query(replace(query, mask=mask[:10]))


def test_a_prior_restricts_the_candidates(
    localizer: Localizer, image: Path, truth: KaptureData
) -> None:
    camera = truth.camera_of("0004.jpg")
    found = localizer.localize(image, camera, prior=["0003.jpg", "0005.jpg", "0003.jpg"])
    assert set(found.candidates) == {"0003.jpg", "0005.jpg"}
    assert errors(found, truth.cam_from_world("0004.jpg"))[0] < 0.05
    assert localizer.localize(image, camera, prior=[]) == Failure("no map image is a candidate")
    with pytest.raises(DataError, match=r"0004\.jpg has the candidate 0001\.jpg, which is not"):
        localizer.localize(image, camera, prior=["0003.jpg", "0001.jpg"])


def test_candidates_are_ranked_by_retrieval(opened: KaptureMap, queries: list[Query]) -> None:
    narrow = Localizer(opened, options=few("query_pairs.top_k=2"))
    # neighbours along the walk, by VLAD of the local features
    neighbours = {"0007.jpg": {"0006.jpg", "0009.jpg"}, "0010.jpg": {"0008.jpg", "0009.jpg"}}
    for query in queries:
        found = narrow.localize_query(query)
        ranked = narrow.ranked(query)
        assert len(ranked) == 2 and set(found.candidates) <= set(ranked)
        assert set(ranked) == neighbours.get(query.name, set(ranked))
        # within a prior, the best of those
        kept = replace(query, prior=("0000.jpg", "0002.jpg", "0009.jpg"))
        assert set(narrow.ranked(kept)) < set(kept.prior or ())


def test_many_queries_are_localized_lazily_and_in_order(
    localizer: Localizer, queries: list[Query], truth: KaptureData
) -> None:
    read: list[str] = []

    def given() -> Iterator[Query]:
        for query in queries:
            read.append(query.name)
            yield query

    results = localizer.localize_many(given())
    assert read == []
    first = next(results)
    assert read == [queries[0].name]
    for query, found in zip(queries, [first, *results], strict=True):
        assert errors(found, truth.cam_from_world(query.name))[0] < 0.02
    assert read == [query.name for query in queries]


@pytest.mark.slow
def test_our_r2d2_localizes_as_well_as_features_of_the_foreign_map(
    virtual_gallery: Path, shared_data: Path
) -> None:
    weights = str(shared_data / "weights" / "r2d2" / "r2d2_WASF_N16.pt")
    # as the map was made
    options = R2D2Options(weights=weights, device="cpu", max_keypoints=500, min_size=600)
    extractor = R2D2(options)
    localizer = Localizer(KaptureMap.open(virtual_gallery / "map"))
    truth = KaptureFolder(virtual_gallery / "query_gt").read().poses()
    queries = KaptureQueries(KaptureFolder(virtual_gallery / "query"), localizer.map)
    chosen = [query for query in queries if "00267" in query.name or "00446" in query.name]
    assert len(chosen) == 2
    for query in chosen:
        with_theirs = errors(localizer.localize_query(query), truth[query.name])
        own = replace(query, features={"r2d2_500": extractor.extract(query.read_image())})
        with_ours = errors(localizer.localize_query(own), truth[query.name])
        assert with_ours[0] < 0.02 and with_ours[1] < 0.4, query.name
        for ours, theirs in zip(with_ours, with_theirs, strict=True):
            assert ours <= 1.5 * theirs, query.name
