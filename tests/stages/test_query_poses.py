"""Queries localized from stored matches, and the folder of their results."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import kapture.io.csv
import numpy as np
import pandas
import pytest
from poses import error_vector

from megloc_kapture.geometry.cameras import project
from megloc_kapture.geometry.poses import movement
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.tables import (
    CLUSTERS_FILE,
    COVARIANCE_FILE,
    POSES_FILE,
    STATUS_FILE,
    read_covariances,
    read_status,
)
from megloc_kapture.localization.cluster_poses import ClusterOptions
from megloc_kapture.localization.map_index import MapIndex, QueryView, TypedMatches
from megloc_kapture.pipeline.executors import open_executor
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import POSE_RANKERS, PoseHypothesis, RankingScene
from megloc_kapture.stages.query_poses import (
    LocalizationOptions,
    localize_query,
    localize_unit,
    write_localized,
)
from megloc_kapture.stages.scene import KaptureScene
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Camera, Pose, RigidTransform


def test_queries_are_localized_accurately(world: Any) -> None:
    results = world.localized()
    assert [result.name for result in results] == sorted(world.query_poses)
    for result in results:
        truth = world.query_poses[result.name]
        assert isinstance(result, Pose) and result.covariance is not None
        error_m, error_deg = movement(truth, result.cam_from_world)
        assert error_m < 0.005 and error_deg < 0.05
        assert result.num_inliers > 100 and set(result.seconds) >= {"reading", "estimation"}
        assert set(result.candidates) <= set(world.map_poses)
        error = error_vector(result.cam_from_world, truth)
        # six degrees of freedom, with room for errors of the map
        assert error @ np.linalg.solve(result.covariance, error) < 100
    with open_executor("processes", 2) as executor:
        in_processes = world.localized(work=Work(executor))
    for a, b in zip(results, in_processes, strict=True):
        assert (a.cam_from_world, a.num_inliers) == (b.cam_from_world, b.num_inliers)


class Brightness:
    """Ranks by the brightness of the query and reads the map images."""

    def score(self, hypotheses: Sequence[PoseHypothesis], scene: RankingScene) -> np.ndarray:
        for hypothesis in hypotheses:
            first = hypothesis.images[0]
            assert scene.map_image(first).shape == (300, 400, 3)
            assert scene.map_camera(first).width == 400
            assert scene.map_pose(first) is not None
        return np.array([scene.query_image(one.views[0].name).mean() for one in hypotheses])


def test_a_ranker_sees_poses_and_images(world: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LocalizationOptions, "make_ranker", lambda *_: Brightness())
    for result in world.localized():
        pixels = read_image_rgb(world.query().image_path(result.name))
        assert result.clusters[0].score == pytest.approx(pixels.mean())


class Candidates:
    """A query source whose pose becomes more confident with more candidates."""

    def __init__(self, count: int, in_turn: bool) -> None:
        self.candidates = [str(number) for number in range(count)]
        self.in_turn = in_turn
        self.asked: list[int] = []

    def view(self, count: int) -> QueryView:
        self.asked.append(count)
        return QueryView("q", cast(Camera, None), ())


@pytest.mark.parametrize(
    ("count", "sure", "in_turn", "expected"),
    [
        (50, 0.9, True, [8, 16, 32]),
        (25, 0.9, True, [8, 16, 25]),
        (50, 1.0, True, [8, 16, 32, 50]),
        (50, None, True, [50]),
        (50, 0.9, False, [50]),
    ],
)
def test_candidates_are_added_until_the_pose_is_confident(
    count: int,
    sure: float | None,
    in_turn: bool,
    expected: list[int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    source = Candidates(count, in_turn)

    def solve(*_: Any, **__: Any) -> list[Pose]:
        results = {8: (0.99, 29), 16: (0.89, 30), 32: (0.9, 30)}
        confidence, inliers = results.get(source.asked[-1], (0.95, 99))
        return [Pose(RigidTransform.identity(), 100, inliers, confidence=confidence)]

    monkeypatch.setattr("megloc_kapture.stages.query_poses.localize_unit", solve)
    nothing: Any = None
    localize_query(
        [source],
        LocalizationOptions(sure_confidence=sure),
        frame_of=lambda _: "",
        centers={},
        ranker=nothing,
        scene=nothing,
    )
    assert source.asked == expected


def test_map_points_of_an_image_are_those_it_observes(world: Any) -> None:
    folder = world.map()
    scene, xyz = KaptureScene(folder), folder.points3d()[:, :3]
    for image in sorted(world.map_poses):
        seen: set[int] = set()
        for observed in folder.observations().values():
            names = np.array(observed.image_names)[observed.image_ids]
            seen |= set(observed.point_ids[names == image].tolist())
        assert seen
        np.testing.assert_array_equal(scene.map_points(image), xyz[sorted(seen)])
    assert scene.map_points("elsewhere.png").shape == (0, 3)


@pytest.mark.parametrize(("frames", "clusters"), [(["", ""], 1), (["DUC1", "DUC2"], 2)])
def test_clusters_with_equal_poses_are_merged_within_a_frame(
    frames: list[str], clusters: int
) -> None:
    camera, rows = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0)), np.arange(100)
    points = np.random.default_rng(0).uniform((-2, -2, 4), (2, 2, 8), (100, 3))
    index = MapIndex.build(points, ("a", "b"), np.repeat([0, 1], 50), rows, rows)
    pose = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.2, -0.1, 0.4))
    halves = zip("ab", np.split(rows, 2), strict=True)
    matches = [(name, np.stack([half] * 2, axis=1), np.full(50, 0.9)) for name, half in halves]
    seen_px = project(camera, pose, points).astype(np.float32)
    (found,) = localize_unit(
        [QueryView("q", camera, (TypedMatches(index, seen_px, matches),))],
        ["a", "b"],
        LocalizationOptions(clusters=ClusterOptions(by="poses", radius=1.0)),
        frame_of=dict(zip("ab", frames, strict=True)).__getitem__,
        centers={"a": np.zeros(3), "b": np.full(3, 9.0)},
        ranker=load_plugin(POSE_RANKERS, "inliers"),
        scene=cast(RankingScene, None),  # this ranker reads no image
    )
    assert isinstance(found, Pose)
    assert (len(found.clusters), found.num_matches) == (clusters, 100 // clusters)


def test_localized_queries_are_written_as_kapture_and_tables(world: Any, tmp_path: Path) -> None:
    results = world.localized()
    write_localized(tmp_path, world.query(), results, timing=tmp_path / "timing.csv")
    folder = KaptureFolder(tmp_path)
    folder.validate(deep=True)
    assert folder.read().poses() == {found.name: found.cam_from_world for found in results}
    poses = pandas.read_csv(tmp_path / POSES_FILE, index_col="image")
    for result in results:
        pose, row = result.cam_from_world, poses.loc[result.name]
        np.testing.assert_allclose(row[["qw", "qx", "qy", "qz"]].astype(float), pose.quat_wxyz)
        np.testing.assert_allclose(row[["tx", "ty", "tz"]].astype(float), pose.translation)
        centre = row[["center_x", "center_y", "center_z"]].astype(float)
        np.testing.assert_allclose(centre, pose.center(), atol=1e-9)
    theirs = kapture.io.csv.kapture_from_dir(str(tmp_path))
    assert len(theirs.trajectories) == 2 and len(list(theirs.records_camera.key_pairs())) == 2
    status = read_status(tmp_path / STATUS_FILE)
    clusters = pandas.read_csv(tmp_path / CLUSTERS_FILE, index_col="image")
    for result in results:
        row = status[result.name]
        assert (row.status, row.reason, row.fallback) == ("localized", "", "none")
        assert (row.num_inliers, row.candidates) == (result.num_inliers, result.candidates)
        ((_, chosen),) = clusters.loc[[result.name]].query("chosen == 'yes'").iterrows()
        assert chosen.cluster == row.cluster and chosen.images == ",".join(result.candidates)
        assert chosen.score > 100
    covariances = read_covariances(tmp_path / COVARIANCE_FILE)
    for result in results:
        np.testing.assert_array_equal(covariances[result.name], result.covariance)
    lines = (tmp_path / "timing.csv").read_text().splitlines()
    assert lines[0] == "image,step,seconds"
    assert {line.split(",")[1] for line in lines[1:]} >= {"reading", "estimation", "refinement"}
