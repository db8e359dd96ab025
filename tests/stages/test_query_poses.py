"""Queries of known pose, localized from stored matches; failures are marked, never invented."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import PluginError
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import ImagePair, KaptureFolder
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions
from megloc_kapture.localization.map_index import MapIndex, QueryView, TypedMatches
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import POSE_RANKERS, PluginChoice, RankingScene
from megloc_kapture.stages.candidates import QueryPairsOptions, Retrieval
from megloc_kapture.stages.image_pairs import pair_queries
from megloc_kapture.stages.query_poses import (
    LocalizationOptions,
    localize_from_matches,
    localize_views,
)
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform

Results = list[tuple[str, Pose | Failure]]


def localize(world: Any, pairs: list[ImagePair] | None = None, **more: Any) -> Results:
    if pairs is None:
        pairs = pair_queries(
            world.mapping(),
            world.query(),
            QueryPairsOptions(),
            retrieval=Retrieval(("vlad_rootsift",)),
        )
    options = more.pop("options", LocalizationOptions())
    return list(
        localize_from_matches(
            world.map(),
            world.query(),
            world.with_matches("query"),
            pairs,
            ["rootsift"],
            options,
            **more,
        )  # fmt: skip
    )


def test_queries_are_localized_where_they_are(world: Any) -> None:
    results = localize(world)
    assert [image for image, _ in results] == sorted(world.query_poses)
    for image, result in results:
        truth = world.query_poses[image]
        assert isinstance(result, Pose)
        delta = result.cam_from_world.rotation_matrix() @ truth.rotation_matrix().T
        assert np.linalg.norm(result.cam_from_world.center() - truth.center()) < 0.005
        assert np.degrees(Rotation.from_matrix(delta).magnitude()) < 0.05
        assert result.num_inliers > 100 and set(result.seconds) >= {"reading", "estimation"}
        assert set(result.candidates) <= set(world.map_poses)


def test_errors_are_within_their_covariance(world: Any) -> None:
    for image, result in localize(world):
        assert isinstance(result, Pose) and result.covariance is not None
        delta = world.query_poses[image] @ result.cam_from_world.inverse()
        vector = Rotation.from_matrix(delta.rotation_matrix()).as_rotvec()
        error = np.concatenate([vector, delta.translation])
        # six degrees of freedom; the map's own errors are not in it, hence the room
        assert error @ np.linalg.solve(result.covariance, error) < 100


def test_workers_find_the_same_poses(world: Any, two_processes: Executor) -> None:
    here, there = localize(world), localize(world, work=Work(two_processes))
    for (image_a, a), (image_b, b) in zip(here, there, strict=True):
        assert isinstance(a, Pose) and isinstance(b, Pose)
        assert (image_a, a.cam_from_world, a.num_inliers) == (
            image_b,
            b.cam_from_world,
            b.num_inliers,
        )


def test_a_query_without_candidates_fails_and_says_so(world: Any) -> None:
    only_b = [ImagePair("query/b.png", "right/2.png", 1.0)]
    (_, first), (_, second) = localize(world, only_b)
    assert first == Failure("no map image is a candidate")
    assert isinstance(second, Pose) and second.candidates == ("right/2.png",)


def test_a_query_with_too_few_inliers_fails_and_keeps_its_numbers(world: Any) -> None:
    options = LocalizationOptions(pose=AbsolutePoseOptions(min_inliers=5000))
    for _, result in localize(world, options=options):
        assert isinstance(result, Failure)
        assert "at least 5000 are needed" in result.reason
        assert result.num_matches > 100 and result.candidates


RANKER = """
import numpy as np

class Brightness:
    def score(self, hypotheses, scene):
        found = []
        for hypothesis in hypotheses:
            (view,) = hypothesis.views
            first = hypothesis.images[0]
            assert scene.map_image(first).shape == (300, 400, 3)
            assert scene.map_camera(first).width == 400
            assert scene.map_pose(first) is not None
            found.append(scene.query_image(view.name).mean())
        return np.array(found)
"""


def test_a_ranker_of_another_package_sees_poses_and_images(
    world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "outside_ranker.py").write_text(RANKER)
    metadata = tmp_path / "outside_ranker-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: outside_ranker\nVersion: 1.0\n"
    )
    (metadata / "entry_points.txt").write_text(
        "[megloc_kapture.pose_rankers]\nbrightness = outside_ranker:Brightness\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    options = LocalizationOptions(rank=PluginChoice(name="brightness"))
    for image, result in localize(world, options=options):
        assert isinstance(result, Pose)
        pixels = read_image_rgb(world.query().image_path(image))
        assert result.clusters[0].score == pytest.approx(pixels.mean())


def test_an_unknown_ranker_is_refused_before_the_first_query(world: Any) -> None:
    with pytest.raises(PluginError, match="no plugin 'no-such' in megloc_kapture.pose_rankers"):
        localize(world, options=LocalizationOptions(rank=PluginChoice(name="no-such")))


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
        map_pairs = pair_map_images(mapping, MappingPairsOptions(by=("poses",)), retrieval=None)
        pairs = pair_queries(mapping, query, QueryPairsOptions(by="exhaustive"), retrieval=None)
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
            KaptureFolder(root / "map"),
            query,
            matches[1],
            pairs,
            ["rootsift"],
            LocalizationOptions(),
        )
        truth = KaptureFolder(scene / "query_gt").read().poses()
        errors = {}
        for image, result in results:
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


@pytest.mark.parametrize("first", ["wrong", "right"])
def test_every_cluster_gives_a_pose_whichever_retrieval_ranks_first(first: str) -> None:
    """Two places that look alike; the query matches more of one, which may be retrieved last."""
    rng = np.random.default_rng(0)
    camera = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
    place = rng.uniform((-2, -2, 4), (2, 2, 8), (100, 3))
    names, rows = ("right/1", "right/2", "wrong/1", "wrong/2"), np.arange(100)
    index = MapIndex.build(
        np.concatenate([place, place + [50.0, 0.0, 0.0]]),
        names,
        np.repeat(np.arange(4), 100),
        np.tile(rows, 4),
        np.concatenate([rows, rows, rows + 100, rows + 100]),
    )
    truth = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.2, -0.1, 0.4))
    matches = [
        (name, np.stack([rows[:count]] * 2, axis=1), np.full(count, 0.9))
        for name, count in zip(names, (80, 90, 60, 50), strict=True)
    ]
    seen = project(camera, truth, place).astype(np.float32)
    found = localize_views(
        [QueryView("q", camera, (TypedMatches(index, seen, matches),))],
        sorted(names, key=lambda name: not name.startswith(first)),
        [""] * 4,
        LocalizationOptions(),
        centers={
            name: np.array([0.0 if name.startswith("right") else 50.0, 0.0, 0.0]) for name in names
        },
        ranker=load_plugin(POSE_RANKERS, "inliers"),
        scene=cast(RankingScene, None),  # that ranker asks for no picture
    ).result
    assert isinstance(found, Pose)
    assert len(found.clusters) == 2
    np.testing.assert_allclose(found.cam_from_world.center(), truth.center(), atol=1e-5)
