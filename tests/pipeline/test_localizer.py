"""Localizing from Python: one image, many, several of a rig; in maps of ours and of others."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import megloc_kapture
from megloc_kapture import Camera, Failure, KaptureMap, Localizer, OptionError, Pose, Query
from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.metrics import pose_errors
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureData, KaptureFolder
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.values import LocalFeatures, RigidTransform

FEW = options_of_preset(assignments=["local_features.options.max_keypoints=800"])


@pytest.fixture(scope="module")
def localizer(workspace: Path) -> Localizer:
    return Localizer(KaptureMap.open(workspace / "map"), options=FEW)


@pytest.fixture(scope="module")
def truth(fountain: Path) -> KaptureData:
    return KaptureFolder(fountain / "query_gt").read()


@pytest.fixture(scope="module")
def queries(workspace: Path, fountain: Path) -> list[Query]:
    """The four queries with their features."""
    folder = KaptureFolder(fountain / "query", features_dirs=[workspace])
    data = folder.read()
    keypoints, descriptors = folder.keypoints("rootsift"), folder.descriptors("rootsift")
    return [
        Query(
            camera=data.camera_of(name),
            name=name,
            features={
                "rootsift": LocalFeatures(
                    keypoints.read(name), np.zeros(800, np.float32), descriptors.read(name)
                )
            },
        )
        for name in data.image_names()
    ]


def errors(found: Pose | Failure, truth: RigidTransform | None) -> tuple[float, float]:
    """Metres and degrees."""
    assert isinstance(found, Pose), found
    assert truth is not None
    result = pose_errors({"it": found.cam_from_world}, {"it": truth})
    return float(result.position_m[0]), float(result.angle_deg[0])


def same(first: Pose | Failure, second: Pose | Failure) -> bool:
    """Whether two results are equal to the last bit."""
    if isinstance(first, Failure) or isinstance(second, Failure):
        return first == second
    return (
        first.cam_from_world == second.cam_from_world
        and first.num_inliers == second.num_inliers
        and first.candidates == second.candidates
        and np.array_equal(first.covariance, second.covariance)  # type: ignore[arg-type]
    )


# ------------------------------------------------------------------ one image


def test_the_readme_names_are_there() -> None:
    assert megloc_kapture.Localizer is Localizer and megloc_kapture.KaptureMap is KaptureMap
    with pytest.raises(AttributeError, match="no attribute 'Loclizer'"):
        _ = megloc_kapture.Loclizer


def test_an_image_file_and_an_array_give_the_same(
    localizer: Localizer, fountain: Path, truth: KaptureData
) -> None:
    camera = truth.camera_of("0004.jpg")
    path = fountain / "query" / "sensors" / "records_data" / "0004.jpg"
    found = localizer.localize(path, camera)
    metres, degrees = errors(found, truth.cam_from_world("0004.jpg"))
    assert metres < 0.01 and degrees < 0.05
    assert isinstance(found, Pose) and found
    assert found.num_matches >= found.num_inliers > 50
    assert found.inliers is not None and found.inliers.sum() == found.num_inliers
    assert set(found.candidates) <= set(localizer.map.images)
    assert same(localizer.localize(read_image_rgb(path), camera), found)
    assert same(localizer.localize(str(path), camera), found)


def test_the_covariance_is_of_the_size_of_the_error(
    localizer: Localizer, queries: list[Query], truth: KaptureData
) -> None:
    for query in queries:
        found = localizer.localize_query(query)
        assert isinstance(found, Pose) and found.covariance is not None
        assert found.covariance.shape == (6, 6)
        np.testing.assert_allclose(found.covariance, found.covariance.T)
        assert (np.linalg.eigvalsh(found.covariance) > 0).all()
        metres, degrees = errors(found, truth.cam_from_world(query.name))
        # the map's own error comes on top: an order of magnitude is all that can be asked
        sigma_deg = np.degrees(np.sqrt(np.trace(found.covariance[:3, :3])))
        assert sigma_deg / 10 < degrees < 30 * sigma_deg
        assert np.sqrt(np.trace(found.covariance[3:, 3:])) < 1.0


def test_a_black_image_fails_and_says_why(localizer: Localizer, truth: KaptureData) -> None:
    camera = truth.camera_of("0004.jpg")
    found = localizer.localize(np.zeros((1024, 1536, 3), np.uint8), camera)
    assert not found and found == Failure("no map image matches")


def test_too_few_matches_fail_and_are_counted(localizer: Localizer, queries: list[Query]) -> None:
    features = queries[1].features["rootsift"]
    # of an empty map region: descriptors of another place
    noise = np.random.default_rng(0).random((20, 128), dtype=np.float32)
    noise /= np.linalg.norm(noise, axis=1, keepdims=True)
    few = LocalFeatures(features.keypoints_px[:20], features.scores[:20], noise)
    found = localizer.localize_query(replace(queries[1], features={"rootsift": few}))
    assert isinstance(found, Failure) and found.reason


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((10, 10, 3), np.uint8), "the image is 10x10, its camera says 1536x1024"),
        (
            np.zeros((1024, 1536), np.uint8),
            r"an image is uint8 \(H, W, 3\), got uint8 \(1024, 1536",
        ),
        (np.zeros((1024, 1536, 3)), r"an image is uint8 \(H, W, 3\), got float64"),
        ("nowhere.jpg", "nowhere.jpg: no such image"),
        (Path(__file__), "test_localizer.py: not an image"),
    ],
    ids=["size", "grey", "float", "absent", "text"],
)
def test_what_is_no_image_is_an_error_and_no_failure(
    localizer: Localizer, truth: KaptureData, image: object, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        localizer.localize(image, truth.camera_of("0004.jpg"))  # type: ignore[arg-type]


def test_a_mask_keeps_features_away(
    localizer: Localizer, fountain: Path, truth: KaptureData
) -> None:
    path = fountain / "query" / "sensors" / "records_data" / "0004.jpg"
    query = Query(truth.camera_of("0004.jpg"), path)
    mask = np.zeros((1024, 1536), bool)
    assert not localizer.localize_query(replace(query, mask=mask))
    mask[:, 700:] = True
    half = localizer.localize_query(replace(query, mask=mask))
    whole = localizer.localize_query(query)
    assert isinstance(half, Pose) and isinstance(whole, Pose)
    assert half.num_matches != whole.num_matches
    with pytest.raises(DataError, match="a mask is bool"):
        localizer.localize_query(replace(query, mask=mask[:10]))


# ------------------------------------------------------------------ which map images


def test_a_prior_restricts_the_candidates(
    localizer: Localizer, fountain: Path, truth: KaptureData
) -> None:
    path = fountain / "query" / "sensors" / "records_data" / "0004.jpg"
    camera = truth.camera_of("0004.jpg")
    found = localizer.localize(path, camera, prior=["0003.jpg", "0005.jpg", "0003.jpg"])
    assert set(found.candidates) == {"0003.jpg", "0005.jpg"}
    metres, _ = errors(found, truth.cam_from_world("0004.jpg"))
    assert metres < 0.05
    assert localizer.localize(path, camera, prior=[]) == Failure("no map image is a candidate")
    with pytest.raises(DataError, match=r"0004\.jpg is to be matched with 0001\.jpg, which is no"):
        localizer.localize(path, camera, prior=["0003.jpg", "0001.jpg"])


def test_retrieval_ranks_where_there_are_more_images_than_candidates(
    workspace: Path, queries: list[Query]
) -> None:
    options = FEW.model_copy(
        update={"query_pairs": FEW.query_pairs.model_copy(update={"top_k": 2})}
    )
    narrow = Localizer(KaptureMap.open(workspace / "map"), options=options)
    # neighbours along the facade, told by our VLAD, for the queries bring no vectors
    neighbours = {"0001.jpg": {"0000.jpg", "0002.jpg"}, "0004.jpg": {"0003.jpg", "0005.jpg"}}
    for query in queries:
        found = narrow.localize_query(query)
        ranked = narrow.ranked(query)
        assert len(ranked) == 2 and set(found.candidates) <= set(ranked)
        if query.name in neighbours:
            assert set(ranked) == neighbours[query.name]
        # within a prior, the best of those
        kept = replace(query, prior=("0000.jpg", "0002.jpg", "0009.jpg"))
        assert set(narrow.ranked(kept)) < set(kept.prior or ())
    assert narrow.describe_retrieval([]) == "VLAD over the map's descriptors"
    assert narrow.describe_retrieval(["vlad_rootsift"]) == "global features vlad_rootsift"


def test_given_candidates_are_all_taken_in_their_order(
    workspace: Path, queries: list[Query]
) -> None:
    options = FEW.model_copy(
        update={"query_pairs": FEW.query_pairs.model_copy(update={"top_k": 1})}
    )
    narrow = Localizer(KaptureMap.open(workspace / "map"), options=options)
    chosen = ["0005.jpg", "0003.jpg", "0002.jpg"]
    given = {query.name: chosen for query in queries[1:]}
    found = list(narrow.localize_many(queries, candidates=given))
    assert found[0] == Failure("no map image is a candidate")
    assert found[1].candidates == tuple(chosen)


def test_candidates_in_turn_end_where_the_pose_is_sure(
    workspace: Path, queries: list[Query], localizer: Localizer, truth: KaptureData
) -> None:
    opened = KaptureMap.open(workspace / "map")
    assert len(opened.images) > 5
    for query in queries:
        every = localizer.localize_query(query)
        assert isinstance(every, Pose) and every.confidence is not None
        for sure, taken in ((0.6, 5), (1.0, len(opened.images))):
            changed = options_of_preset(
                "classic",
                assignments=[
                    "local_features.options.max_keypoints=800",
                    f"localization.sure_confidence={sure}",
                ],
            )
            one = Localizer(opened, options=changed)
            found = one.localize_query(query)
            ranked = one.ranked(query)
            assert set(found.candidates) <= set(ranked[:taken])
            assert errors(found, truth.cam_from_world(query.name)) < (0.05, 1.0)
            if sure == 1.0:  # never so sure
                assert same(found, every)


# ------------------------------------------------------------------ many


def test_many_are_localized_lazily_and_in_order(
    localizer: Localizer, queries: list[Query], truth: KaptureData
) -> None:
    asked: list[str] = []

    def given() -> Iterator[Query]:
        for query in queries:
            asked.append(query.name)
            yield query

    results = localizer.localize_many(given())
    assert asked == []
    first = next(results)
    assert asked == [queries[0].name]
    for query, found in zip(queries, [first, *results], strict=True):
        metres, _ = errors(found, truth.cam_from_world(query.name))
        assert metres < 0.02
    assert asked == [query.name for query in queries]


@pytest.mark.parametrize("workers", [1, 2, 4])
def test_threads_change_nothing(
    localizer: Localizer, queries: list[Query], workspace: Path, workers: int
) -> None:
    alone = list(localizer.localize_many(queries * 2))
    fresh = Localizer(KaptureMap.open(workspace / "map"), options=FEW)
    with ThreadPoolExecutor(workers) as executor:
        together = list(fresh.localize_many(queries * 2, executor))
    assert len(together) == 8
    assert all(same(a, b) for a, b in zip(alone, together, strict=True))


def test_images_and_cameras_in_pairs(
    localizer: Localizer, fountain: Path, truth: KaptureData
) -> None:
    path = fountain / "query" / "sensors" / "records_data" / "0007.jpg"
    camera = truth.camera_of("0007.jpg")
    black = np.zeros((1024, 1536, 3), np.uint8)
    found = list(localizer.localize_many([(black, camera), (path, camera)]))
    assert not found[0] and found[1]


def test_a_kapture_folder_as_queries(
    localizer: Localizer, workspace: Path, fountain: Path, queries: list[Query]
) -> None:
    folder = KaptureFolder(fountain / "query", features_dirs=[workspace])
    found = dict(localizer.localize_kapture(folder))
    assert list(found) == [query.name for query in queries]
    for query in queries:
        assert same(found[query.name], localizer.localize_query(query))


# ------------------------------------------------------------------ a rig


def made_up_rig(truth: KaptureData) -> tuple[RigidTransform, dict[str, RigidTransform]]:
    """``rig_from_world`` of a rig that two queries are cameras of, and their ``cam_from_rig``."""
    poses = {name: truth.cam_from_world(name) for name in ("0004.jpg", "0007.jpg")}
    base = poses["0004.jpg"]
    assert base is not None
    turned = RigidTransform((0.8, 0.0, 0.6, 0.0), (0.3, -0.2, 1.0))
    rig_from_world = turned @ base
    return rig_from_world, {
        name: pose @ rig_from_world.inverse() for name, pose in poses.items() if pose is not None
    }


def test_a_rig_is_localized_as_one(
    localizer: Localizer, queries: list[Query], truth: KaptureData
) -> None:
    rig_from_world, cams = made_up_rig(truth)
    views = [(query, cams[query.name]) for query in queries if query.name in cams]
    found = localizer.localize_rig(views)
    metres, degrees = errors(found, rig_from_world)
    assert metres < 0.01 and degrees < 0.05
    alone = [localizer.localize_query(query) for query, _ in views]
    assert found.num_matches == sum(single.num_matches for single in alone)
    assert set(found.candidates) == set(alone[0].candidates) | set(alone[1].candidates)


def test_a_blind_camera_of_a_rig_does_no_harm(
    localizer: Localizer, queries: list[Query], truth: KaptureData
) -> None:
    rig_from_world, cams = made_up_rig(truth)
    blind = Query(queries[0].camera, np.zeros((1024, 1536, 3), np.uint8), "blind")
    views = [(query, cams[query.name]) for query in queries if query.name in cams]
    found = localizer.localize_rig([(blind, RigidTransform.identity()), *views])
    metres, _ = errors(found, rig_from_world)
    assert metres < 0.01
    assert not localizer.localize_rig([(blind, RigidTransform.identity())])
    assert not localizer.localize_rig([])


# ------------------------------------------------------------------ maps of others


def test_the_foreign_map_from_python(virtual_gallery: Path) -> None:
    localizer = Localizer(KaptureMap.open(virtual_gallery / "map"), preset="classic")
    truth = KaptureFolder(virtual_gallery / "query_gt").read()
    found = dict(localizer.localize_kapture(virtual_gallery / "query"))
    assert list(found) == truth.image_names()
    deviations = [errors(pose, truth.cam_from_world(name)) for name, pose in found.items()]
    metres, degrees = np.median(deviations, axis=0)
    assert metres <= 0.010 and degrees <= 0.16


def test_its_queries_cannot_be_extracted_without_the_networks_weights(
    virtual_gallery: Path,
) -> None:
    localizer = Localizer(KaptureMap.open(virtual_gallery / "map"))
    camera = Camera("SIMPLE_PINHOLE", 1536, 1024, (1000.0, 768.0, 512.0))
    with pytest.raises(DataError, match="the weights r2d2_WASF_N16 are missing.*megloc weights"):
        localizer.localize(np.zeros((1024, 1536, 3), np.uint8), camera)


@pytest.mark.slow
def test_a_map_without_descriptors_is_extracted_again(
    localizer: Localizer, map_copy: Path, queries: list[Query]
) -> None:
    shutil.rmtree(map_copy / "reconstruction" / "descriptors")
    again = Localizer(KaptureMap.open(map_copy), options=FEW)
    for query in queries:
        assert same(again.localize_query(query), localizer.localize_query(query))
    # few as they are, its images are not ranked where nothing is at hand to rank them by
    shutil.rmtree(map_copy / "reconstruction" / "global_features")
    unranked = Localizer(KaptureMap.open(map_copy), options=FEW).localize_query(queries[0])
    assert unranked and set(unranked.candidates) <= set(localizer.map.images)
    # with other options of the extractor most is found again, and that is enough
    usual = Localizer(KaptureMap.open(map_copy))
    assert all(usual.localize_many(queries))
    (map_copy / "sensors" / "records_data").unlink()
    with pytest.raises(DataError, match="no descriptors of type 'rootsift', and no images"):
        Localizer(KaptureMap.open(map_copy))


def test_a_map_in_a_tar(localizer: Localizer, map_copy: Path, queries: list[Query]) -> None:
    import tarfile

    for kind, suffix in (("keypoints", ".kpt"), ("descriptors", ".desc")):
        folder = map_copy / "reconstruction" / kind / "rootsift"
        with tarfile.open(folder / f"{kind}.tar", "w") as tar:
            for file in sorted(folder.glob(f"*{suffix}")):
                tar.add(file, file.name)
                file.unlink()
    again = Localizer(KaptureMap.open(map_copy), options=FEW)
    with ThreadPoolExecutor(2) as executor:
        results = list(again.localize_many(queries, executor))
    for query, found in zip(queries, results, strict=True):
        assert same(found, localizer.localize_query(query))


def test_without_verification_poses_are_found_too(
    workspace: Path, queries: list[Query], truth: KaptureData
) -> None:
    options: PipelineOptions = FEW.model_copy(update={"verification": "none"})
    bold = Localizer(KaptureMap.open(workspace / "map"), options=options)
    found = bold.localize_query(queries[1])
    metres, _ = errors(found, truth.cam_from_world(queries[1].name))
    assert metres < 0.05
    verified = Localizer(KaptureMap.open(workspace / "map"), options=FEW)
    assert found.num_matches > verified.localize_query(queries[1]).num_matches


def test_an_unknown_preset(workspace: Path) -> None:
    with pytest.raises(OptionError, match="unknown preset 'best'"):
        Localizer(KaptureMap.open(workspace / "map"), preset="best")
