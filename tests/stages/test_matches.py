"""Matching as a stage: stored matches, their table and rejected inputs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import PluginError
from megloc_kapture.io.kapture import ImagePair, KaptureFolder, write_sensors
from megloc_kapture.io.tables import read_match_counts
from megloc_kapture.matching.nearest_neighbours import NearestNeighbours, match_nearest
from megloc_kapture.matching.verification import KnownPoseOptions, TwoViewOptions
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.stages.matches import (
    best_pairs,
    check_given_poses,
    iterate_candidates,
    match_all,
    match_pairs,
)
from megloc_kapture.values import ImageFeatures


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


def test_all_matches_or_verified_matches_are_stored(world: Any, tmp_path: Path) -> None:
    run(world, "query", None, tmp_path / "all")
    run(world, "query", TwoViewOptions(), tmp_path / "verified")
    everything, verified = (
        world.mapping().with_features([tmp_path / name]).matches("rootsift")
        for name in ("all", "verified")
    )
    query, image = "query/a.png", "right/2.png"
    with single_threaded():
        matches, scores = match_nearest(
            world.query().descriptors("rootsift").read(query),
            world.mapping().descriptors("rootsift").read(image),
        )
    stored, stored_scores = everything.read(query, image)
    np.testing.assert_array_equal(stored, matches)
    np.testing.assert_allclose(stored_scores, scores)
    swapped, _ = everything.read(image, query)  # stored with the smaller name first
    np.testing.assert_array_equal(swapped, matches[:, ::-1])
    # the table counts the matches of each pair before and after verification
    counts = read_match_counts(tmp_path / "verified", "rootsift")
    for count in counts:
        assert count.verified == len(verified.read(count.image, count.other)[0])
        assert count.matches == len(everything.read(count.image, count.other)[0])
    assert any(count.verified < count.matches for count in counts)


def test_pairs_without_matches_are_stored_and_repeated_pairs_matched_once(
    world: Any, write_features: Any, tmp_path: Path
) -> None:
    empty, full = ("left/0.png", "left/1.png"), ("left/0.png", "right/2.png")
    rows = {"left/0.png": 4, "left/1.png": 0, "right/2.png": 4}
    descriptors = {image: np.eye(4, dtype=np.float32)[:count] for image, count in rows.items()}
    keypoints = {image: np.full((count, 2), 50, np.float32) for image, count in rows.items()}
    write_features(tmp_path, "keypoints", "toy", keypoints)
    write_features(tmp_path, "descriptors", "toy", descriptors)
    folder = world.mapping().with_features([tmp_path])
    pairs = [ImagePair(*pair, score) for pair in (empty, full) for score in (0.2, 0.9)]
    for verification, matched in ((KnownPoseOptions(), 0), (None, 4)):
        out = tmp_path / f"out{matched}"
        counts = match_pairs(folder, folder, pairs, "toy", NearestNeighbours(), verification, out)
        assert [*counts.values()] == [2, int(matched > 0), matched]
        reader = folder.with_features([out]).matches("toy")
        assert {pair: reader.length(*pair) for pair in reader.pairs} == {empty: 0, full: matched}


def test_the_best_pairs_are_those_with_most_verified_matches() -> None:
    verified = {("a", "b"): 5, ("a", "c"): 9, ("a", "d"): 5, ("b", "c"): 1, ("c", "d"): 0}
    of_first = [("a", "b"), ("a", "c"), ("b", "c"), ("c", "d")]
    assert best_pairs(verified, 2, of_both=False) == of_first
    assert best_pairs(verified, 1, of_both=True) == [("a", "b"), ("a", "c"), ("a", "d")]


@pytest.mark.parametrize(
    ("scores", "message"),
    [
        (np.ones(3), r"got float64 \(3,\), expected .*\(1\)"),
        (np.ones(1), "outside 3 and 5 keypoints"),
    ],
)
def test_wrong_matches_of_a_plugin_are_refused(scores: Any, message: str) -> None:
    class Mistaken:
        def match(self, a: Any, b: Any) -> Any:
            return np.array([[0, 5]]), scores

    def image(count: int) -> ImageFeatures:
        return ImageFeatures(np.zeros((count, 2), np.float32), np.zeros((count, 4)), 64, 48)

    with pytest.raises(PluginError, match=f"matcher Mistaken on pair a, b: .*{message}"):
        match_all(Mistaken(), image(3), [image(5)], ["pair a, b"])


def test_candidates_are_sorted_by_score_and_name() -> None:
    pairs = [
        ImagePair("q2", "m1", 0.1),
        ImagePair("q1", "m3", 0.5),
        ImagePair("q1", "m2", 0.9),
        ImagePair("q1", "m1", 0.5),
    ]
    assert list(iterate_candidates(pairs)) == [("q1", ["m2", "m1", "m3"]), ("q2", ["m1"])]


def test_a_wrong_given_pose_is_a_warning(
    world: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = world.mapping().read()
    wrong = replace(data.trajectories[0, "cam"], quat_wxyz=(0.5, -0.5, 0.5, 0.5))
    write_sensors(tmp_path, replace(data, trajectories={**data.trajectories, (0, "cam"): wrong}))
    mapping = KaptureFolder(tmp_path, features_dirs=[world.features_dir])
    images = sorted(world.map_poses)
    check_given_poses(mapping, all_pairs(images, images), "rootsift", NearestNeighbours())
    assert "matches: left/0.png" in caplog.text
