"""``megloc eval``, ``megloc localize`` and ``Localizer`` give the same poses."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from corner import write_scene

from megloc_kapture import KaptureMap, Localizer, Pose
from megloc_kapture.errors import OptionError
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, read_pairs, write_sensors
from megloc_kapture.io.tables import CONSISTENCY_FILE, read_match_counts, read_status
from megloc_kapture.pipeline.plan import Workspace
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.results import Results
from megloc_kapture.stages.matches import SecondMatchingOptions, candidates_of, pairs_to_rematch
from megloc_kapture.stages.paths import MAPPING_MATCHES, QUERY_MATCHES
from megloc_kapture.stages.query_poses import LocalizeQueries
from megloc_kapture.values import RigidTransform
from tests.pipeline.runs import evaluated, run_command

TYPE = "rootsift"
ALL_CANDIDATES = "localization.sure_confidence=none"  # as eval matches them
FEW = ("local_features.rootsift.options.max_keypoints=300",)
TWO_TYPES = (
    *('local_features=["rootsift","sift"]', "local_features.sift.options.first_octave=0"),
    *FEW,
)
SECOND = (
    "second_matching.matcher.name=nn",
    "second_matching.matcher.options.max_ratio=0.9",
    "second_matching.pairs=2",
)


def both(scene: Path, root: Path, *assignments: str) -> tuple[Workspace, Localizer]:
    """Run the stages and open a localizer in the map with the same options."""
    options = options_of_preset(assignments=[ALL_CANDIDATES, *assignments])
    workspace = evaluated(root, scene, options, last="submission")
    return workspace, Localizer(KaptureMap.open(workspace.path("map")), options=options)


def same_poses(workspace: Workspace, localizer: Localizer) -> list[Pose]:
    """Localize the queries from Python and compare with the poses of the workspace."""
    in_run = KaptureFolder(workspace.path("localized")).read()
    status = read_status(workspace.path("localized/status.csv"))
    found = dict(Results(localizer, workspace.path("query")))
    assert sorted(found) == in_run.image_names()
    for name, result in found.items():
        pose, row = in_run.cam_from_world(name), status[name]
        assert bool(result) == (row.status == "localized")
        numbers = (result.num_matches, result.num_inliers, result.candidates)
        assert numbers == (row.num_matches, row.num_inliers, row.candidates)
        assert result.confidence == pytest.approx(row.confidence, rel=1e-3)
        if isinstance(result, Pose):
            assert pose is not None
            matrix = result.cam_from_world.matrix()
            np.testing.assert_allclose(matrix, pose.matrix(), rtol=0, atol=1e-9)
    return [result for result in found.values() if isinstance(result, Pose)]


@pytest.fixture(scope="module")
def with_depth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene with a depth map of each image."""
    root = tmp_path_factory.mktemp("depth") / "scene"
    write_scene(root, with_depth=True)
    return root


@pytest.fixture(scope="module")
def with_rig(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene with its four queries as two timestamps of a rig of two cameras."""
    root = tmp_path_factory.mktemp("rig") / "scene"
    shutil.copytree(scene, root, copy_function=shutil.copyfile)
    truth = KaptureFolder(scene / "query_gt").read()
    names, poses = truth.image_names(), truth.poses()
    data = KaptureData(sensors=dict.fromkeys(("left", "right"), truth.sensors["cam"]))
    right_from_left = poses[names[1]] @ poses[names[0]].inverse()
    data.rigs["rig"] = {"left": RigidTransform.identity(), "right": right_from_left}
    moments = ((1, "left"), (1, "right"), (2, "left"), (3, "right"))
    data.records_camera = dict(zip(moments, names, strict=True))
    write_sensors(root / "query", data)
    shutil.rmtree(root / "query_gt")
    return root


@pytest.mark.parametrize(
    "assignments",
    [
        pytest.param((*TWO_TYPES, "reranking.by=coverage", "reranking.keep=4"), id="coverage"),
        pytest.param((*FEW, *SECOND), id="second matcher"),
        *(
            pytest.param((*FEW, *more), id=name, marks=pytest.mark.slow)
            for name, more in {
                "resized": ["preprocessing.max_size_px=240", "query_pairs.top_k=4"],
                "pyramid": [
                    "guided_pyramid.mode=all",
                    "guided_pyramid.scales=[0.5,1.0]",
                    "guided_pyramid.min_matches=400",
                ],
                "pyramid of unverified matches": [
                    *(*TWO_TYPES, "reranking.by=verified", "reranking.local_type=rootsift"),
                    *("reranking.keep=4", "verification=mapping", "guided_pyramid.mode=max"),
                    "guided_pyramid.count=matches",
                    "guided_pyramid.scales=[0.5,1.0]",
                    "guided_pyramid.min_matches=100",
                ],
                "second matcher, then pyramid": [
                    *SECOND,
                    "guided_pyramid.mode=all",
                    "guided_pyramid.scales=[0.5,1.0]",
                    "guided_pyramid.min_matches=100",
                ],
                "unverified": ["verification=none", "localization.clusters.by=none"],
            }.items()
        ),
    ],
)
def test_the_same_poses(scene: Path, tmp_path: Path, assignments: tuple[str, ...]) -> None:
    workspace, localizer = both(scene, tmp_path / "workspace", *assignments)
    assert len(same_poses(workspace, localizer)) == 4
    if assignments == (*FEW, *SECOND):
        check_second_matches(workspace)


def check_second_matches(workspace: Workspace) -> None:
    """Check that matches of the second matcher replace those of the best pairs."""
    for kind, part in (("query", QUERY_MATCHES), ("mapping", MAPPING_MATCHES)):
        again = workspace.path(f"pyramid/{kind}")
        first = read_match_counts(workspace.path(part), TYPE)
        second = read_match_counts(again, TYPE)
        counts = {pair: row.verified for pair, row in first.items()}
        best = pairs_to_rematch(counts, SecondMatchingOptions(pairs=2), of_both=kind == "mapping")
        assert set(second) == set(best) and len(best) < len(first)
        # the ratio test removes matches
        assert all(row.matches < first[pair].matches for pair, row in second.items())
        stage = LocalizeQueries(options_of_preset(assignments=[*FEW, *SECOND]))
        folders = stage.query_matches() if kind == "query" else stage.mapping_matches()
        places = [workspace.path(folder) for folder in folders]
        stored = KaptureFolder(workspace.path(kind), features_dirs=places).matches(TYPE)
        for pair, row in {**first, **second}.items():
            assert stored.length(*pair) == row.verified


def test_a_fallback_is_the_pose_of_the_best_reranked_candidate(scene: Path, tmp_path: Path) -> None:
    sets = [
        *FEW, "localization.pose.min_inliers=5000", "localization.fallback=retrieval",
        "reranking.by=verified", "reranking.keep=3", "global_features.vlad.options.num_clusters=1",
    ]  # fmt: skip
    workspace, localizer = both(scene, tmp_path / "workspace", *sets)
    first = [
        {name: each[0] for name, each in candidates_of(read_pairs(workspace.path(pairs))).items()}
        for pairs in ("pairs/query_candidates.txt", "pairs/query.txt")
    ]
    assert first[0] != first[1]
    Results(localizer, workspace.path("query")).save(tmp_path / "localized")
    found = KaptureFolder(tmp_path / "localized").read().poses()
    map_poses = KaptureFolder(workspace.path("map")).read().poses()
    assert found == {name: map_poses[image] for name, image in first[1].items()}
    assert found == KaptureFolder(workspace.path("localized")).read().poses()
    # a type that a run does not extract is refused, but not for a map of another tool
    wrong = options_of_preset(assignments=[*sets, "reranking.local_type=superpoint"])
    message = "no local features of type 'superpoint'; known: rootsift"
    with pytest.raises(OptionError, match=message):
        evaluated(tmp_path / "wrong", scene, wrong)
    Localizer(localizer.map, options=wrong)


@pytest.mark.slow
def test_the_same_poses_of_rigs(with_rig: Path, tmp_path: Path) -> None:
    workspace, localizer = both(with_rig, tmp_path / "workspace", *FEW, "localization.rigs=true")
    poses = same_poses(workspace, localizer)
    assert len(poses) == 4
    rigs = KaptureFolder(with_rig / "query").read().rigs["rig"]
    left, right = (pose.cam_from_world for pose in poses[:2])
    expected = rigs["right"] @ left
    np.testing.assert_allclose(right.translation, expected.translation, atol=1e-9)


@pytest.mark.parametrize("by", ["icp", pytest.param("rendering", marks=pytest.mark.slow)])
def test_the_command_writes_what_eval_writes(with_depth: Path, tmp_path: Path, by: str) -> None:
    sets = [*FEW, f'pose_refinement.by=["{by}"]', "preprocessing.max_size_px=240"]
    options = options_of_preset(assignments=sets)
    workspace = evaluated(tmp_path / "w", with_depth, options, last="submission")
    flags = [flag for one in sets for flag in ("--set", one)]
    out, places = tmp_path / "localized", ("-i", workspace.path("map"))
    run_command("localize", *places, "--query", workspace.path("query"), "-o", out, *flags)
    names = ["status.csv", "refinement.csv", "clusters.csv", "sensors/trajectories.txt"]
    tested = [place / CONSISTENCY_FILE for place in (out, workspace.path("localized"))]
    assert [path.is_file() for path in tested] == [by == "rendering"] * 2
    for name in [*names, CONSISTENCY_FILE] if by == "rendering" else names:
        assert (out / name).read_bytes() == workspace.path(f"localized/{name}").read_bytes(), name
