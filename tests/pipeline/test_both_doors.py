"""``megloc eval``, ``megloc localize`` and ``Localizer`` are one method: the same poses."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from corner import write_scene

from megloc_kapture import KaptureMap, Localizer, Pose
from megloc_kapture.cli.main import main
from megloc_kapture.errors import OptionError
from megloc_kapture.io.kapture import (
    KaptureData,
    KaptureFolder,
    read_pairs,
    write_sensors,
)
from megloc_kapture.io.tables import CONSISTENCY_FILE, read_refinement, read_status
from megloc_kapture.pipeline.datasets import choose_dataset
from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.pipeline.plan import run_plan
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.results import Results
from megloc_kapture.pipeline.run import Run
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.matches import iterate_candidates
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.values import Failure, RigidTransform

FEW = ("local_features.rootsift.options.max_keypoints=300",)
TWO_TYPES = ('local_features=["rootsift","sift"]', *FEW)


def evaluated(scene: Path, workspace: Path, options: PipelineOptions) -> Workspace:
    """A workspace that all stages have run in."""
    place = Workspace(workspace)
    with place.lock(), single_threaded():
        run_plan(
            plan_evaluation(Run(choose_dataset("kapture", scene), "classic", options, place)), place
        )
    return place


def assert_same(
    workspace: Workspace, localized: Iterable[tuple[str, Pose | Failure]]
) -> list[Pose]:
    """Check that results are those of the workspace, to the last bit; returns the poses."""
    evaluated = workspace.folder("localized").read()
    status = read_status(workspace.path("localized/status.csv"))
    found = dict(localized)
    assert sorted(found) == evaluated.image_names()
    poses = []
    for name, result in found.items():
        pose = evaluated.cam_from_world(name)
        assert bool(result) == (status[name].status == "localized")
        assert (result.num_matches, result.num_inliers, result.candidates) == (
            status[name].num_matches, status[name].num_inliers, status[name].candidates,
        )  # fmt: skip
        if isinstance(result, Pose):
            assert pose is not None
            np.testing.assert_allclose(
                [*result.cam_from_world.quat_wxyz, *result.cam_from_world.translation],
                [*pose.quat_wxyz, *pose.translation],
                rtol=0,
                atol=1e-9,
            )
            poses.append(result)
    return poses


@pytest.fixture(scope="module")
def with_depth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene with a depth map of each image."""
    root = tmp_path_factory.mktemp("depth") / "scene"
    write_scene(root, with_depth=True)
    return root


@pytest.fixture(scope="module")
def with_rig(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene with its four queries as two moments of a rig of two cameras."""
    root = tmp_path_factory.mktemp("rig") / "scene"
    shutil.copytree(scene, root, copy_function=shutil.copyfile)
    truth = KaptureFolder(scene / "query_gt").read()
    names = truth.image_names()
    poses = truth.poses()
    sensor = truth.sensors["cam"]
    data = KaptureData(sensors={"left": sensor, "right": sensor})
    # the second camera stands where the true poses of the first moment put it
    right_from_left = poses[names[1]] @ poses[names[0]].inverse()
    data.rigs["rig"] = {"left": RigidTransform.identity(), "right": right_from_left}
    data.records_camera = {
        (1, "left"): names[0], (1, "right"): names[1],
        (2, "left"): names[2], (3, "right"): names[3],
    }  # fmt: skip
    write_sensors(root / "query", data)
    shutil.rmtree(root / "query_gt")
    return root


@pytest.mark.parametrize(
    "assignments",
    [
        pytest.param(FEW, id="classic"),
        pytest.param((*TWO_TYPES, "reranking.by=coverage", "reranking.keep=4"), id="coverage"),
        *(
            pytest.param((*FEW, *more), id=name, marks=pytest.mark.slow)
            for name, more in {
                "retrieval": ["query_pairs.top_k=4"],
                "in turn": ["localization.sure_confidence=0.5"],
                "turns of all": ["localization.sure_confidence=1.0", "reranking.by=matches"],
                "resized": ["preprocessing.max_size_px=240", "query_pairs.top_k=4"],
                "matches": [*TWO_TYPES, "reranking.by=matches", "reranking.keep=3"],
                "pyramid": [
                    "guided_pyramid.mode=all",
                    "guided_pyramid.scales=[0.5,1.0]",
                    "guided_pyramid.min_matches=400",
                ],
                "unverified": ["verification=none", "localization.clusters.by=none"],
            }.items()
        ),
    ],
)
def test_the_same_poses(scene: Path, tmp_path: Path, assignments: tuple[str, ...]) -> None:
    options = options_of_preset(assignments=assignments)
    workspace = evaluated(scene, tmp_path / "workspace", options)
    opened = KaptureMap.open(workspace.path("map"))
    localizer = Localizer(opened, options=options)
    assert len(assert_same(workspace, localizer.localize_kapture(workspace.path("query")))) == 4


def test_options_that_contradict_each_other_are_refused(scene: Path, tmp_path: Path) -> None:
    options = options_of_preset(assignments=["verification=none", "guided_pyramid.mode=all"])
    message = "guided pyramid matching counts verified matches"
    with pytest.raises(OptionError, match=message):
        evaluated(scene, tmp_path / "workspace", options)
    map_options = options_of_preset(assignments=FEW)
    workspace = evaluated(scene, tmp_path / "map", map_options)
    with pytest.raises(OptionError, match=message):
        Localizer(KaptureMap.open(workspace.path("map")), options=options)


def test_a_fallback_is_the_pose_of_the_first_candidate_after_reranking(
    scene: Path, tmp_path: Path
) -> None:
    sets = [
        *FEW, "localization.pose.min_inliers=5000", "localization.fallback=retrieval",
        "reranking.by=verified", "reranking.keep=3", "global_features.vlad.options.num_clusters=1",
    ]  # fmt: skip
    options = options_of_preset(assignments=sets)
    workspace = evaluated(scene, tmp_path / "workspace", options)
    first = [
        {name: images[0] for name, images in iterate_candidates(read_pairs(workspace.path(pairs)))}
        for pairs in ("pairs/query_candidates.txt", "pairs/query.txt")
    ]
    assert first[0] != first[1]
    localizer = Localizer(KaptureMap.open(workspace.path("map")), options=options)
    Results(localizer, workspace.path("query")).save(tmp_path / "localized")
    found = KaptureFolder(tmp_path / "localized").read().poses()
    map_poses = workspace.folder("map").read().poses()
    assert found == {name: map_poses[image] for name, image in first[1].items()}
    assert found == workspace.folder("localized").read().poses()


@pytest.mark.slow
def test_the_same_poses_of_rigs(with_rig: Path, tmp_path: Path) -> None:
    options = options_of_preset(assignments=[*FEW, "localization.rigs=true"])
    workspace = evaluated(with_rig, tmp_path / "workspace", options)
    localizer = Localizer(KaptureMap.open(workspace.path("map")), options=options)
    poses = assert_same(workspace, localizer.localize_kapture(workspace.path("query")))
    assert len(poses) == 4
    rigs = KaptureFolder(with_rig / "query").read().rigs["rig"]
    found = dict(localizer.localize_kapture(workspace.path("query")))
    names = sorted(found)
    left, right = found[names[0]], found[names[1]]
    assert isinstance(left, Pose) and isinstance(right, Pose)
    expected = rigs["right"] @ left.cam_from_world
    np.testing.assert_allclose(right.cam_from_world.translation, expected.translation, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("by", ["icp", "rendering"])
def test_the_same_refined_poses(with_depth: Path, tmp_path: Path, by: str) -> None:
    options = options_of_preset(
        assignments=[*FEW, f'pose_refinement.by=["{by}"]', "localization.rank=perceptual"]
    )
    workspace = evaluated(with_depth, tmp_path / "workspace", options)
    localizer = Localizer(KaptureMap.open(workspace.path("map")), options=options)
    poses = assert_same(workspace, localizer.localize_kapture(workspace.path("query")))
    rows = read_refinement(workspace.path("localized/refinement.csv"))
    assert [row.method for row in rows] == [by] * 4
    for pose, row in zip(poses, rows, strict=True):
        assert [one.reason for one in pose.refinements] == [row.reason]


@pytest.mark.parametrize("by", ["icp", pytest.param("rendering", marks=pytest.mark.slow)])
def test_the_command_writes_what_eval_writes(with_depth: Path, tmp_path: Path, by: str) -> None:
    sets = [*FEW, f'pose_refinement.by=["{by}"]', "preprocessing.max_size_px=240"]
    workspace = evaluated(with_depth, tmp_path / "w", options_of_preset(assignments=sets))
    flags = [flag for one in sets for flag in ("--set", one)]
    out = tmp_path / "localized"
    with pytest.raises(SystemExit) as end:
        main(
            ["localize", "-i", str(workspace.path("map")), "--query", str(workspace.path("query")),
             "-o", str(out), *flags]
        )  # fmt: skip
    assert end.value.code == 0
    names = ["status.csv", "refinement.csv", "clusters.csv", "sensors/trajectories.txt"]
    tested = [place / CONSISTENCY_FILE for place in (out, workspace.path("localized"))]
    assert [path.is_file() for path in tested] == [by == "rendering"] * 2
    for name in [*names, CONSISTENCY_FILE] if by == "rendering" else names:
        assert (out / name).read_bytes() == workspace.path(f"localized/{name}").read_bytes(), name
