"""Matching as a stage: what is kept, what is written, and the same bytes from any executor."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.io.kapture import FeatureConfig, FeatureWriter, ImagePair, KaptureFolder
from megloc_kapture.io.tables import read_match_counts
from megloc_kapture.matching.nearest_neighbours import NearestNeighbours, match_nearest
from megloc_kapture.matching.verification import KnownPoseOptions, TwoViewOptions
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.stages.matches import (
    FeatureCache,
    Features,
    NoVerification,
    iterate_candidates,
    match_all,
    match_pairs,
    verified,
)
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Camera

CAMERA = Camera("PINHOLE", 400, 300, (300.0, 302.0, 200.0, 150.0))


def all_pairs(first: list[str], second: list[str]) -> list[ImagePair]:
    return [ImagePair(a, b, 1.0) for a in first for b in second if a < b or second is not first]


def run(world: Any, kind: str, verification: Any, output: Path, **more: Any) -> dict[str, int]:
    images, queries = sorted(world.map_poses), sorted(world.query_poses)
    first = world.mapping() if kind == "mapping" else world.query()
    pairs = all_pairs(images, images) if kind == "mapping" else all_pairs(queries, images)
    with single_threaded():
        return match_pairs(
            first, world.mapping(), pairs, "rootsift", NearestNeighbours(), verification, output,
            **more,
        )  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "verification"),
    [("mapping", KnownPoseOptions()), ("query", TwoViewOptions()), ("query", NoVerification())],
    ids=["poses", "two-view", "none"],
)
def test_workers_write_the_same_bytes(
    world: Any,
    two_processes: Executor,
    tmp_path: Path,
    folder_bytes: Callable[[Path], dict[str, bytes]],
    kind: str,
    verification: Any,
) -> None:
    here = run(world, kind, verification, tmp_path / "here")
    there = run(world, kind, verification, tmp_path / "there", work=Work(two_processes))
    assert here == there
    assert here["pairs"] == here["pairs_with_matches"] == 10
    assert here["matches"] > 2000
    written = folder_bytes(tmp_path / "here")
    assert len(written) == 11  # of ten pairs, and the table of their numbers
    assert written == folder_bytes(tmp_path / "there")


def test_the_table_says_what_was_found_and_what_is_verified(world: Any, tmp_path: Path) -> None:
    run(world, "query", TwoViewOptions(), tmp_path / "verified")
    run(world, "query", NoVerification(), tmp_path / "all")
    verified = read_match_counts(tmp_path / "verified", "rootsift")
    everything = {(c.image, c.other): c for c in read_match_counts(tmp_path / "all", "rootsift")}
    reader = KaptureFolder(world.query().root, features_dirs=[tmp_path / "verified"])
    for count in verified:
        assert count.verified == len(reader.matches("rootsift").read(count.image, count.other)[0])
        assert count.matches == everything[count.image, count.other].verified
    assert any(count.verified < count.matches for count in verified)


def test_without_verification_all_of_the_matchers_matches_are_kept(
    world: Any, tmp_path: Path
) -> None:
    run(world, "query", NoVerification(), tmp_path)
    reader = KaptureFolder(world.mapping().root, features_dirs=[tmp_path]).matches("rootsift")
    query, image = "query/a.png", "right/2.png"
    with single_threaded():
        matches, scores = match_nearest(
            world.query().descriptors("rootsift").read(query),
            world.mapping().descriptors("rootsift").read(image),
        )
    stored, stored_scores = reader.read(query, image)
    np.testing.assert_array_equal(stored, matches)
    np.testing.assert_allclose(stored_scores, scores)
    swapped, _ = reader.read(image, query)  # kapture stores the smaller name first
    np.testing.assert_array_equal(swapped, matches[:, ::-1])


@pytest.mark.parametrize("kind", ["mapping", "query"])
def test_verified_matches_agree_with_the_true_poses(
    world: Any, tmp_path: Path, kind: str, distance_to_walls: Callable[..., Any]
) -> None:
    run(world, kind, KnownPoseOptions() if kind == "mapping" else TwoViewOptions(), tmp_path)
    reader = KaptureFolder(world.mapping().root, features_dirs=[tmp_path]).matches("rootsift")
    poses = {**world.map_poses, **world.query_poses}
    for a, b in reader.pairs:
        indices, _ = reader.read(a, b)
        rays = []
        for image, rows in zip((a, b), indices.T, strict=True):
            folder = world.query() if image in world.query_poses else world.mapping()
            keypoints = folder.keypoints("rootsift").read(image)[rows]
            directions = bearing_rays(CAMERA, keypoints) @ poses[image].rotation_matrix()
            rays.append(directions / np.linalg.norm(directions, axis=1, keepdims=True))
        # distance of the two rays in space, over the distance to the wall
        normal = np.cross(rays[0], rays[1])
        baseline = poses[b].center() - poses[a].center()
        gap = np.abs(normal @ baseline) / np.linalg.norm(normal, axis=1) / 6.0
        assert np.median(gap) < 1e-3
        assert (gap < 0.02).mean() > 0.98  # 0.02 is 6 px


def toy_folder(world: Any, root: Path, vectors: dict[str, np.ndarray]) -> KaptureFolder:
    """The map's images with keypoints in a row and the descriptors given."""
    keypoints = FeatureConfig("toy", np.dtype("float32"), 2)
    descriptors = FeatureConfig("toy", np.dtype("float32"), 4, "toy", "L2")
    with FeatureWriter(root, "keypoints", "toy", keypoints, orphan=True) as writer:
        for image, rows in vectors.items():
            xy = np.stack([np.arange(len(rows)) * 10.0 + 5, np.full(len(rows), 100.0)], axis=1)
            writer.write(image, xy.astype(np.float32))
    with FeatureWriter(root, "descriptors", "toy", descriptors, orphan=True) as writer:
        for image, rows in vectors.items():
            writer.write(image, rows.astype(np.float32))
    return KaptureFolder(world.mapping().root, features_dirs=[root])


def test_a_pair_without_matches_is_known_to_be_done(world: Any, tmp_path: Path) -> None:
    folder = toy_folder(
        world,
        tmp_path / "features",
        {"left/0.png": np.eye(4), "left/1.png": np.zeros((0, 4)), "right/2.png": np.eye(4)},
    )
    pairs = [
        ImagePair("left/0.png", "left/1.png", 1.0),
        ImagePair("left/0.png", "right/2.png", 1.0),
    ]
    counts = match_pairs(
        folder, folder, pairs, "toy", NearestNeighbours(), KnownPoseOptions(), tmp_path / "out"
    )
    assert counts == {"pairs": 2, "pairs_with_matches": 0, "matches": 0}
    reader = KaptureFolder(world.mapping().root, features_dirs=[tmp_path / "out"]).matches("toy")
    assert reader.pairs == [(pair.query, pair.map) for pair in pairs]
    assert all(len(reader.read(*pair)[0]) == 0 for pair in reader.pairs)


def test_a_pair_that_is_asked_for_twice_is_matched_once(world: Any, tmp_path: Path) -> None:
    folder = toy_folder(
        world, tmp_path / "features", {"left/0.png": np.eye(4), "left/1.png": np.eye(4)}
    )
    pairs = [ImagePair("left/0.png", "left/1.png", score) for score in (0.2, 0.9)]
    counts = match_pairs(
        folder, folder, pairs, "toy", NearestNeighbours(), NoVerification(), tmp_path / "out"
    )
    assert counts == {"pairs": 1, "pairs_with_matches": 1, "matches": 4}


def test_no_pairs(world: Any, tmp_path: Path) -> None:
    counts = match_pairs(
        world.mapping(), world.mapping(), [], "rootsift", NearestNeighbours(), NoVerification(),
        tmp_path / "out",
    )  # fmt: skip
    assert counts == {"pairs": 0, "pairs_with_matches": 0, "matches": 0}
    folder = KaptureFolder(world.mapping().root, features_dirs=[tmp_path / "out"])
    assert folder.matches("rootsift").pairs == []


def test_what_has_no_features_is_named(world: Any, tmp_path: Path) -> None:
    def match(image: str, local_type: str) -> None:
        match_pairs(
            world.mapping(), world.mapping(), [ImagePair("left/0.png", image, 1.0)], local_type,
            NearestNeighbours(), NoVerification(), tmp_path,
        )  # fmt: skip

    with pytest.raises(DataError, match="no keypoints of type 'r2d2' .* there are: rootsift"):
        match("left/1.png", "r2d2")
    with pytest.raises(DataError, match=r"nowhere\.png"):
        match("nowhere.png", "rootsift")


def features(count: int) -> Features:
    return Features.of(CAMERA, np.zeros((count, 2), np.float32), np.zeros((count, 4), np.float32))


def test_the_matchers_rows_are_those_that_verification_judges() -> None:
    class Fixed:
        def match(self, a: Any, b: Any) -> tuple[np.ndarray, np.ndarray]:
            return np.array([[0, 2], [1, 1], [3, 0]]), np.array([0.9, 0.8, 0.7], np.float32)

    seen = []

    def verify(a: Features, b: Features, matches: np.ndarray) -> np.ndarray:
        seen.append(matches.tolist())
        return np.array([True, False, True])

    a, b = features(4), features(3)
    matches, scores, found = verified(a, b, match_all(Fixed(), a, [b], ["b"])[0], verify)
    assert seen == [[[0, 2], [1, 1], [3, 0]]]
    assert matches.tolist() == [[0, 2], [3, 0]]
    np.testing.assert_allclose(scores, [0.9, 0.7])
    assert found == 3


def test_the_cache_is_bounded_and_forgets_what_was_used_longest_ago() -> None:
    one = features(100)
    # rays and their slopes are made when they are needed, and counted from the start
    slopes = 100 * 2 * 2 * 8
    size = one.descriptors.nbytes + one.keypoints_px.nbytes + one.rays.nbytes + slopes
    cache = FeatureCache(max_bytes=3 * size)
    loaded: list[str] = []

    def get(key: str) -> None:
        def load() -> Features:
            loaded.append(key)
            return features(100)

        cache.get(key, load)

    for key in "abcab":
        get(key)
    assert loaded == ["a", "b", "c"]
    get("d")  # c was used longest ago
    for key in "abd":
        get(key)
    assert loaded == ["a", "b", "c", "d"]
    get("c")
    assert loaded == ["a", "b", "c", "d", "c"]


def test_candidates_come_best_first_and_ties_by_name() -> None:
    pairs = [
        ImagePair("q2", "m1", 0.1),
        ImagePair("q1", "m3", 0.5),
        ImagePair("q1", "m2", 0.9),
        ImagePair("q1", "m1", 0.5),
    ]
    assert list(iterate_candidates(pairs)) == [("q1", ["m2", "m1", "m3"]), ("q2", ["m1"])]
