"""Queries localized from stored matches, refined poses, and the folder of their results."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import kapture.io.csv
import numpy as np
import pandas
import pytest
from poses import error_vector

from megloc_kapture.errors import PluginError
from megloc_kapture.evaluation.report.content import consistency_sentence
from megloc_kapture.geometry.cameras import project
from megloc_kapture.geometry.poses import movement
from megloc_kapture.io.csv_table import read_records
from megloc_kapture.io.dataset_tables import ImageGroup, SideTables
from megloc_kapture.io.files import link_images
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder, Sensor, write_sensors
from megloc_kapture.io.tables import (
    CLUSTERS_FILE,
    CONSISTENCY_FILE,
    COVARIANCE_FILE,
    POSES_FILE,
    STATUS_FILE,
    ConsistencyRow,
    read_covariances,
    read_refinement,
    read_status,
)
from megloc_kapture.localization.cluster_poses import ClusterOptions
from megloc_kapture.localization.map_index import MapIndex, QueryView, TypedMatches
from megloc_kapture.pipeline.executors import open_executor
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import POSE_RANKERS, PoseHypothesis, PoseRefinement, RankingScene
from megloc_kapture.refinement.references import DISPLACEMENT
from megloc_kapture.stages.localized_folder import write_localized
from megloc_kapture.stages.pose_refinement import PoseRefinementOptions, refine_poses
from megloc_kapture.stages.query_poses import LocalizationOptions, StoredSource, localize_query
from megloc_kapture.stages.scene import KaptureScene
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform
from tests.worlds import folder_bytes


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
        index = MapIndex.build(np.zeros((0, 3)), (), *np.zeros((3, 0), np.int32))
        matches = [("0", np.zeros((1, 2), np.int64), np.ones(1))]
        return QueryView("q", cast(Camera, None), (TypedMatches(index, np.zeros((0, 2)), matches),))


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

    def solve(*_: Any, **__: Any) -> tuple[Pose, None]:
        results = {8: (0.99, 29), 16: (0.89, 30), 32: (0.9, 30)}
        confidence, inliers = results.get(source.asked[-1], (0.95, 99))
        return Pose(RigidTransform.identity(), 100, inliers, confidence=confidence), None

    monkeypatch.setattr("megloc_kapture.stages.query_poses.localize_in_clusters", solve)
    nothing: Any = None
    localize_query(
        [source],
        LocalizationOptions(sure_confidence=sure, clusters=ClusterOptions(by="none")),
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
    view = QueryView("q", camera, (TypedMatches(index, seen_px, matches),))
    (found,) = localize_query(
        [StoredSource(view, ["a", "b"])],
        LocalizationOptions(clusters=ClusterOptions(by="poses", radius=1.0)),
        frame_of=dict(zip("ab", frames, strict=True)).__getitem__,
        centers={"a": np.zeros(3), "b": np.full(3, 9.0)},
        ranker=load_plugin(POSE_RANKERS, "inliers"),
        scene=cast(RankingScene, None),  # this ranker reads no image
    )
    assert isinstance(found, Pose)
    assert (len(found.clusters), found.num_matches) == (clusters, 100 // clusters)


@pytest.mark.parametrize(("error_m", "correct"), [(0.0, 150), (0.6, 150), (0.6, 60)])
def test_a_rig_that_contradicts_most_matches_is_localized_camera_by_camera(
    error_m: float, correct: int
) -> None:
    camera, rows = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0)), np.arange(200)
    points = np.random.default_rng(0).uniform((-2, -2, 4), (2, 2, 8), (200, 3))
    index = MapIndex.build(points, ("a",), np.zeros(200, np.int32), rows, rows)
    truth = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.2, -0.1, 0.4))
    side = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.1, 0.0, 0.0))
    given = replace(side, translation=(0.1 + error_m, 0.0, 0.0))
    sources = []
    for name, count, pose in (("front", 200, truth), ("side", 150, side @ truth)):
        seen_px = project(camera, pose, points).astype(np.float32)
        if name == "side":  # the other matches are wrong
            seen_px[correct:] = np.random.default_rng(1).uniform(0, 480, seen_px[correct:].shape)
        pairs = [("a", np.stack([rows[:count]] * 2, axis=1), np.full(count, 0.9))]
        typed = TypedMatches(index, seen_px, pairs)
        of_rig = RigidTransform.identity() if name == "front" else given
        sources.append(StoredSource(QueryView(name, camera, (typed,), of_rig), ["a"]))
    results = localize_query(
        sources,
        LocalizationOptions(min_confidence=0.0),
        frame_of=lambda _: "",
        centers={"a": np.zeros(3)},
        ranker=load_plugin(POSE_RANKERS, "inliers"),
        scene=cast(RankingScene, None),
    )
    split = ["joint localization" in " ".join(result.remarks) for result in results]
    assert split == [error_m > 0 and correct == 150] * 2
    for result, pose in zip(results, (truth, side @ truth), strict=True):
        if result.name == "front" or correct == 150:
            assert isinstance(result, Pose) and movement(pose, result.cam_from_world)[0] < 1e-3


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


COVARIANCE = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 1 / 3])
SHIFT = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.25))


class Shift:
    """Moves every pose by 0.25 along the optical axis, but not that of image ``stays``."""

    name = "shift"

    def __init__(self, stays: str = "") -> None:
        self.stays = stays
        self.asked: dict[str, list[str]] = {}

    def refine(
        self,
        query: str,
        camera: Camera,
        cam_from_world: RigidTransform,
        references: Sequence[str],
        scene: Any,
    ) -> Any:
        self.asked[query] = list(references)
        assert scene.query_image(query).shape[:2] == (camera.height, camera.width)
        if query == self.stays:
            return PoseRefinement(cam_from_world, "nothing overlaps", {"overlap": 0.125})
        return PoseRefinement(SHIFT @ cam_from_world, measures={"overlap": 0.5})


class Sure(Shift):
    """Moves poses in frames whose map is consistent; FRAMES has the inconsistency."""

    name = "sure"

    def __init__(self, require_consistent_map: bool = True) -> None:
        super().__init__()
        self.require_consistent_map = require_consistent_map

    def hold_out(self, image: str, images: Any, scene: Any) -> dict[str, float] | None:
        assert scene.map_pose(image) is not None and image in images.names
        off = FRAMES["good" if int(image.removesuffix(".png")) < 6 else "bad"]
        return dict(zip(DISPLACEMENT, (0.02, 0.2, 3.0, 0.001, 0.01, off), strict=True))


# frame of a map image: standardised error of held-out map images
FRAMES = {"good": 1.0, "bad": 1e4}


class Chosen(PoseRefinementOptions):
    refiners: tuple[Any, ...] = ()

    def make_refiners(self, placement: Any = None) -> list[Any]:
        return list(self.refiners)


def status_table(localized: Path) -> pandas.DataFrame:
    return pandas.read_csv(localized / "status.csv", index_col="image", keep_default_na=False)


@pytest.fixture
def localized(world: Any, tmp_path: Path) -> KaptureFolder:
    """One query at its true pose, from the map's first image; the other failed."""
    first, second = sorted(world.query_poses)
    image = min(world.map_poses)
    pose = world.query_poses[first]
    found = Pose(pose, 50, 40, name=first, candidates=(image,), covariance=COVARIANCE)
    folder = tmp_path / "localized"
    write_localized(folder, world.query(), [found, Failure("too dark", name=second)])
    return KaptureFolder(folder)


def test_refiners_are_applied_in_order_and_failures_stay(
    world: Any, localized: KaptureFolder, tmp_path: Path
) -> None:
    first, second = sorted(world.query_poses)
    options = Chosen(refiners=(Shift(), Shift(stays=first), Shift()))
    arguments = world.mapping(), world.query(), localized
    counts = refine_poses(*arguments, tmp_path / "out", options)
    assert counts["queries"] == 1
    refined = KaptureFolder(tmp_path / "out").read().poses()
    expected = SHIFT @ SHIFT @ world.query_poses[first]
    assert refined.keys() == {first}
    np.testing.assert_allclose(refined[first].translation, expected.translation)
    status = status_table(tmp_path / "out")
    steps = "shift: accepted; shift: nothing overlaps; shift: accepted"
    assert status.refinement[first] == steps
    assert (status.refinement[second], status.reason[second]) == ("", "too dark")
    steps = read_refinement(tmp_path / "out" / "refinement.csv", refined)[first]
    assert [step.accepted for step in steps] == [True, False, True]
    assert [step.moved_m for step in steps] == pytest.approx([0.25, 0, 0.25])
    assert steps[1].measures == {"overlap": 0.125}
    assert localized.read().poses()[first] == world.query_poses[first]
    with ThreadPoolExecutor(2) as executor:
        refine_poses(*arguments, tmp_path / "threads", options, work=Work(executor))
    assert folder_bytes(tmp_path / "out") == folder_bytes(tmp_path / "threads")


def test_rejected_refinements_keep_the_covariance(
    world: Any, localized: KaptureFolder, tmp_path: Path
) -> None:
    first = min(world.query_poses)
    kept = {}
    for name, stays in (("stays", first), ("moved", "")):
        options = Chosen(refiners=(Shift(stays=stays),))
        refine_poses(world.mapping(), world.query(), localized, tmp_path / name, options)
        kept[name] = read_covariances(tmp_path / name / "covariance.csv")
    np.testing.assert_array_equal(kept["stays"][first], COVARIANCE)
    assert kept["moved"] == {}  # the refiner returns no covariance
    # the references are the candidates of the pose
    assert options.refiners[0].asked[first] == [min(world.map_poses)]


def test_a_query_with_a_broken_file_keeps_its_pose(
    world: Any, localized: KaptureFolder, tmp_path: Path
) -> None:
    first, broken = min(world.query_poses), tmp_path / "query"
    write_sensors(broken, world.query().read())
    folders = world.mapping(), KaptureFolder(broken), localized
    refine_poses(*folders, tmp_path / "out", Chosen(refiners=(Shift(),)))
    assert KaptureFolder(tmp_path / "out").read().poses()[first] == world.query_poses[first]
    assert "not refined: " in status_table(tmp_path / "out").remarks[first]
    assert first in status_table(tmp_path / "out").remarks[first]


def test_a_pose_is_refined_with_the_focal_length_that_was_estimated_with_it(
    world: Any, tmp_path: Path
) -> None:
    first = min(world.query_poses)
    data = world.query().read()
    camera = data.camera_of(first)
    unknown = Sensor("", "camera", ("UNKNOWN_CAMERA", str(camera.width), str(camera.height)))
    query, result = tmp_path / "query", tmp_path / "localized"
    write_sensors(query, replace(data, sensors=dict.fromkeys(data.sensors, unknown)))
    link_images(world.query().root, query)
    pose = Pose(world.query_poses[first], 50, 40, name=first, camera=camera)
    write_localized(result, KaptureFolder(query), [pose])
    folders = world.mapping(), KaptureFolder(query), KaptureFolder(result)
    refine_poses(*folders, tmp_path / "out", Chosen(refiners=(Shift(),)))
    assert status_table(tmp_path / "out").refinement[first] == "shift: accepted"


def test_wrong_refiners_are_refused(
    world: Any, localized: KaptureFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders, options = (world.mapping(), world.query(), localized), Chosen(refiners=(Shift(),))
    for answer, message in (
        (None, "refine returned NoneType"),
        (PoseRefinement(replace(SHIFT, translation=(0, np.nan, 0))), ".* an invalid pose"),
        (PoseRefinement(replace(SHIFT, quat_wxyz=(1, 1, 0, 0))), ".* an invalid pose: Rig"),
    ):
        monkeypatch.setattr(Shift, "refine", lambda *_, answer=answer: answer)
        with pytest.raises(PluginError, match=f"'shift' on image .*: {message}"):
            refine_poses(*folders, tmp_path, options)


@pytest.fixture
def folders(world: Any, small_kapture: Any, tmp_path: Path) -> tuple[KaptureFolder, ...]:
    """A map of two frames, and two localized queries, one in each."""
    image = next(iter(world.mapping().read().image_names()))
    pixels = read_image_rgb(world.mapping().image_path(image))
    pose = RigidTransform.identity()
    names = [f"{k:02d}.png" for k in range(12)]
    mapping = small_kapture(
        {name: pixels for name in names}, name="map", poses={name: pose for name in names}
    )
    query = small_kapture({"a.png": pixels, "b.png": pixels}, name="query")
    found = [
        Pose(pose, 50, 40, name=q, candidates=(first,))
        for q, first in (("a.png", "00.png"), ("b.png", "06.png"))
    ]
    write_localized(tmp_path / "localized", query, found)
    return mapping, query, KaptureFolder(tmp_path / "localized")


TABLES = SideTables(
    groups={f"{k:02d}.png": ImageGroup(frame="good" if k < 6 else "bad") for k in range(12)}
)


def test_each_coordinate_frame_has_its_consistency(folders: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = Chosen(refiners=(Sure(),))
    counts = refine_poses(*folders, out, options, tables=TABLES)
    assert counts == {
        "queries": 2, "accepted_by_sure": 1, "frames_where_sure_is_trusted": 1,
    }  # fmt: skip
    text = status_table(out).refinement
    assert text["a.png"] == "sure: accepted"
    assert "sure: the map contradicts itself: 6 of 6" in text["b.png"]
    (first,), (second,) = read_refinement(out / "refinement.csv", {}).values()
    assert (first.accepted, second.accepted) == (True, False) and second.reason in text["b.png"]
    poses = KaptureFolder(out).read().poses()
    assert poses["a.png"] == SHIFT and poses["b.png"] == RigidTransform.identity()
    bad, good = read_records(out / CONSISTENCY_FILE, ConsistencyRow)
    assert (bad.frame, bad.images, bad.contradicting) == ("bad", 6, 6)
    assert (good.frame, good.contradicting, good.reason) == ("good", 0, "")
    assert consistency_sentence(good).startswith("sure in good is used; 6 held-out map images")
    # without the check the refiner is used everywhere
    options = Chosen(refiners=(Sure(require_consistent_map=False),))
    counts = refine_poses(*folders, tmp_path / "all", options, tables=TABLES)
    assert counts == {"queries": 2, "accepted_by_sure": 2}
    assert not (tmp_path / "all" / CONSISTENCY_FILE).exists()
