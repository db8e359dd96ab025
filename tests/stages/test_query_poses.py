"""Queries of known pose, localized from stored matches; failures are marked, never invented."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

import kapture.io.csv
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.io.kapture_store import ImagePair, KaptureFolder
from megloc_kapture.io.status_table import STATUS_FILE, read_status
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions
from megloc_kapture.localization.map_index import MapIndex
from megloc_kapture.stages.image_pairs import QueryPairsOptions, pair_queries
from megloc_kapture.stages.query_poses import (
    LocalizationOptions,
    gather_correspondences,
    index_map,
    localize_from_matches,
    pose_from_matches,
    write_localized,
)
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform

Results = list[tuple[str, Pose | Failure, float]]


def localize(world: Any, pairs: list[ImagePair] | None = None, **more: Any) -> Results:
    if pairs is None:
        pairs = pair_queries(
            world.mapping(), world.query(), QueryPairsOptions(), global_type="vlad_rootsift"
        )
    options = more.pop("options", LocalizationOptions())
    return list(
        localize_from_matches(
            world.map(),
            world.query(),
            world.with_matches("query"),
            pairs,
            "rootsift",
            options,
            **more,
        )  # fmt: skip
    )


def test_queries_are_localized_where_they_are(world: Any) -> None:
    results = localize(world)
    assert [image for image, _, _ in results] == sorted(world.query_poses)
    for image, result, seconds in results:
        truth = world.query_poses[image]
        assert isinstance(result, Pose)
        delta = result.cam_from_world.rotation_matrix() @ truth.rotation_matrix().T
        assert np.linalg.norm(result.cam_from_world.center() - truth.center()) < 0.005
        assert np.degrees(Rotation.from_matrix(delta).magnitude()) < 0.05
        assert result.num_inliers > 100 and seconds >= 0
        assert set(result.candidates) <= set(world.map_poses)


def test_errors_are_within_their_covariance(world: Any) -> None:
    for image, result, _ in localize(world):
        assert isinstance(result, Pose) and result.covariance is not None
        delta = world.query_poses[image] @ result.cam_from_world.inverse()
        vector = Rotation.from_matrix(delta.rotation_matrix()).as_rotvec()
        error = np.concatenate([vector, delta.translation])
        # six degrees of freedom; the map's own errors are not in it, hence the room
        assert error @ np.linalg.solve(result.covariance, error) < 100


def test_workers_find_the_same_poses(world: Any, two_processes: Executor) -> None:
    here, there = localize(world), localize(world, executor=two_processes)
    for (image_a, a, _), (image_b, b, _) in zip(here, there, strict=True):
        assert isinstance(a, Pose) and isinstance(b, Pose)
        assert (image_a, a.cam_from_world, a.num_inliers) == (
            image_b,
            b.cam_from_world,
            b.num_inliers,
        )


def test_a_query_without_candidates_fails_and_says_so(world: Any) -> None:
    only_b = [ImagePair("query/b.png", "right/2.png", 1.0)]
    (_, first, _), (_, second, _) = localize(world, only_b)
    assert first == Failure("no map image is a candidate")
    assert isinstance(second, Pose) and second.candidates == ("right/2.png",)


def test_a_query_with_too_few_inliers_fails_and_keeps_its_numbers(world: Any) -> None:
    options = LocalizationOptions(pose=AbsolutePoseOptions(min_inliers=5000))
    for _, result, _ in localize(world, options=options):
        assert isinstance(result, Failure)
        assert "at least 5000 are needed" in result.reason
        assert result.num_matches > 100 and result.candidates


def written(world: Any, output: Path, results: Results, **more: Any) -> KaptureFolder:
    write_localized(output, world.query(), results, **more)
    return KaptureFolder(output)


def test_localized_queries_are_a_kapture(world: Any, tmp_path: Path) -> None:
    results = localize(world)
    folder = written(world, tmp_path, results, timing=tmp_path / "timing.csv")
    folder.validate(deep=True)  # the images are there too
    poses = folder.read().poses()
    assert poses == {image: result.cam_from_world for image, result, _ in results}  # type: ignore[union-attr]
    theirs = kapture.io.csv.kapture_from_dir(str(tmp_path))
    assert len(theirs.trajectories) == 2 and len(list(theirs.records_camera.key_pairs())) == 2
    status = read_status(tmp_path / STATUS_FILE)
    for image, result, _ in results:
        row = status[image]
        assert (row.status, row.reason, row.fallback) == ("localized", "", "none")
        assert (row.num_inliers, row.candidates) == (result.num_inliers, result.candidates)
    lines = (tmp_path / "timing.csv").read_text().splitlines()
    assert lines[0] == "image,step,seconds" and len(lines) == 3


def half_failed(world: Any) -> Results:
    (first, _, seconds), second = localize(world)
    return [(first, Failure("no map image matches"), seconds), second]


def test_a_failed_query_has_no_pose(world: Any, tmp_path: Path) -> None:
    results = half_failed(world)
    counts = write_localized(tmp_path, world.query(), results)
    assert counts == {"queries": 2, "localized": 1, "failed": 1, "fallbacks": 0}
    folder = KaptureFolder(tmp_path)
    assert set(folder.read().poses()) == {"query/b.png"}
    assert folder.read().image_names() == sorted(world.query_poses)  # but its record
    row = read_status(tmp_path / STATUS_FILE)["query/a.png"]
    assert (row.status, row.reason, row.fallback) == ("failed", "no map image matches", "none")


def test_a_fallback_is_marked_as_such(world: Any, tmp_path: Path) -> None:
    guess = world.map_poses["left/1.png"]
    counts = write_localized(
        tmp_path, world.query(), half_failed(world), fallback="retrieval",
        first_candidates={image: ("left/1.png", guess) for image in world.query_poses},
    )  # fmt: skip
    assert counts == {"queries": 2, "localized": 1, "failed": 1, "fallbacks": 1}
    poses = KaptureFolder(tmp_path).read().poses()
    assert poses["query/a.png"] == guess
    assert poses["query/b.png"] != guess  # a localized query needs no guess
    status = read_status(tmp_path / STATUS_FILE)
    a, b = status["query/a.png"], status["query/b.png"]
    assert (a.status, a.fallback, a.num_inliers) == ("failed", "retrieval", 0)
    assert (b.status, b.fallback) == ("localized", "none")


def test_no_fallback_unless_asked_for(world: Any, tmp_path: Path) -> None:
    guess = {image: ("left/1.png", RigidTransform.identity()) for image in world.query_poses}
    counts = write_localized(tmp_path, world.query(), half_failed(world), first_candidates=guess)
    assert counts["fallbacks"] == 0
    assert set(KaptureFolder(tmp_path).read().poses()) == {"query/b.png"}


def test_a_query_that_retrieved_nothing_has_no_fallback(world: Any, tmp_path: Path) -> None:
    counts = write_localized(
        tmp_path, world.query(), half_failed(world), fallback="retrieval", first_candidates={}
    )
    assert counts["fallbacks"] == 0
    assert read_status(tmp_path / STATUS_FILE)["query/a.png"].fallback == "none"


def test_the_index_is_of_one_keypoints_type(world: Any) -> None:
    index = index_map(world.map(), "rootsift")
    observations = world.map().observations()["rootsift"]
    assert len(index.keypoint_ids) == len(observations.point_ids)
    rows = observations.image_ids == 2
    points = index.points_of_keypoints("right/2.png", observations.keypoint_ids[rows])
    np.testing.assert_array_equal(points, observations.point_ids[rows])


def test_matches_become_correspondences_through_the_observations() -> None:
    index = MapIndex.build(
        np.arange(9.0).reshape(3, 3),
        ("a", "b"),
        image_ids=np.array([0, 0, 1]),
        keypoint_ids=np.array([5, 7, 5]),
        point_ids=np.array([0, 1, 2]),
    )
    found = gather_correspondences(
        index,
        [
            ("a", np.array([[10, 5], [11, 6], [12, 7]]), np.array([0.9, 0.9, 0.9])),
            ("b", np.array([[13, 5], [10, 9]]), np.array([0.5, 0.5])),
            ("c", np.array([[14, 5]]), np.array([0.5])),  # not in the map
        ],
    )
    pairs = list(zip(found.keypoint_ids.tolist(), found.point_ids.tolist(), strict=True))
    assert pairs == [(10, 0), (12, 1), (13, 2)]
    assert len(gather_correspondences(index, []).point_ids) == 0


def test_a_map_image_that_observes_nothing_gives_too_few_matches() -> None:
    empty = np.zeros(0, dtype=np.int64)
    index = MapIndex.build(np.zeros((0, 3)), (), empty, empty, empty)
    camera = Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))
    matches = [("a", np.array([[0, 0]]), np.array([1.0]))]
    keypoints = np.zeros((1, 2), np.float32)
    result = pose_from_matches(index, keypoints, camera, matches, AbsolutePoseOptions())
    assert isinstance(result, Failure)
    assert result.reason == "0 2D-3D matches, at least 12 are needed"
    assert result.candidates == ("a",)
    assert pose_from_matches(index, keypoints, camera, [], AbsolutePoseOptions()) == Failure(
        "no map image matches"
    )


def test_keypoints_with_more_columns_are_taken(world: Any) -> None:
    query, image = "query/a.png", "left/1.png"
    keypoints = world.query().keypoints("rootsift").read(query)
    wide = np.concatenate([keypoints, np.full((len(keypoints), 4), 7, np.float32)], axis=1)
    index = index_map(world.map(), "rootsift")
    matches = [(image, *world.with_matches("query").matches("rootsift").read(query, image))]
    camera = world.query().read().camera_of(query)
    first = pose_from_matches(index, keypoints, camera, matches, AbsolutePoseOptions())
    second = pose_from_matches(index, wide, camera, matches, AbsolutePoseOptions())
    assert isinstance(first, Pose) and isinstance(second, Pose)
    assert first.cam_from_world == second.cam_from_world
    assert replace(first, inliers=None, covariance=None).num_inliers == second.num_inliers


@pytest.fixture(scope="module")
def fountain(
    shared_data: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[], dict[str, float]]:
    """Localizes fountain_p11's queries; their errors in metres."""
    from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
    from megloc_kapture.io.colmap import TriangulationOptions
    from megloc_kapture.matching.nearest_neighbours import NearestNeighbours
    from megloc_kapture.matching.verification import KnownPoseOptions, TwoViewOptions
    from megloc_kapture.pipeline.executors import single_threaded
    from megloc_kapture.stages.image_pairs import MappingPairsOptions, pair_map_images
    from megloc_kapture.stages.local_features import extract_local_features
    from megloc_kapture.stages.matches import match_pairs
    from megloc_kapture.stages.triangulation import triangulate_map

    scene = shared_data / "scenes" / "fountain_p11"
    root = tmp_path_factory.mktemp("fountain")

    def run() -> dict[str, float]:
        mapping = KaptureFolder(scene / "mapping", features_dirs=[root / "features"])
        query = KaptureFolder(scene / "query", features_dirs=[root / "features"])
        extractor, matcher = RootSift(RootSiftOptions(max_keypoints=1500)), NearestNeighbours()
        extract_local_features([mapping, query], extractor, root / "features")
        map_pairs = pair_map_images(mapping, MappingPairsOptions(by=("poses",)), global_type=None)
        pairs = pair_queries(mapping, query, QueryPairsOptions(by="exhaustive"), global_type=None)
        match_pairs(
            mapping,
            mapping,
            map_pairs,
            "rootsift",
            matcher,
            KnownPoseOptions(),
            root / "map_matches",
        )
        match_pairs(
            query, mapping, pairs, "rootsift", matcher, TwoViewOptions(), root / "query_matches"
        )
        matches = [
            KaptureFolder(mapping.root, features_dirs=[root / name])
            for name in ("map_matches", "query_matches")
        ]
        triangulate_map(mapping, matches[0], "rootsift", root / "map", TriangulationOptions())
        results = localize_from_matches(
            KaptureFolder(root / "map"), query, matches[1], pairs, "rootsift", LocalizationOptions()
        )
        truth = KaptureFolder(scene / "query_gt").read().poses()
        errors = {}
        for image, result, _ in results:
            assert isinstance(result, Pose), (image, result)
            centre = result.cam_from_world.center()
            errors[image] = float(np.linalg.norm(centre - truth[image].center()))
        return errors

    with single_threaded():
        errors = run()
    return lambda: errors


def test_real_photographs_are_localized_within_a_centimetre(
    fountain: Callable[[], dict[str, float]],
) -> None:
    errors = fountain()
    assert len(errors) == 4
    assert max(errors.values()) < 0.01
