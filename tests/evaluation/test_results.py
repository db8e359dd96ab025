"""Results on disk and in memory: kapture folders, pose files, side tables; what they come to."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from poses import WRONG_CONVENTIONS, random_pose
from scored import write_kapture

from megloc_kapture.errors import DataError, MeglocError, OptionError
from megloc_kapture.evaluation.evaluate import evaluate, evaluate_results
from megloc_kapture.evaluation.metrics import Threshold
from megloc_kapture.evaluation.pose_files import format_pose_file
from megloc_kapture.evaluation.protocols import benchmark_of, protocol_of
from megloc_kapture.evaluation.results import (
    context_of,
    distinct_labels,
    read_result,
    side_tables_near,
    workspace_of,
)
from megloc_kapture.io.colmap import new_colmap_pose
from megloc_kapture.io.dataset_tables import (
    ImageGroup,
    Protocol,
    SideTables,
    SimilarityTransform,
    World,
    write_side_tables,
)
from megloc_kapture.io.tables import write_status
from megloc_kapture.values import Failure, Pose, RigidTransform


@pytest.fixture
def truth(world: Any, tmp_path: Path) -> Path:
    return write_kapture(tmp_path / "query_gt", list(world.truth), world.truth)


@pytest.fixture
def result(world: Any, tmp_path: Path) -> Path:
    folder = write_kapture(tmp_path / "localized", list(world.truth), world.estimated)
    write_status(folder / "status.csv", world.statuses.values())
    return folder


@pytest.mark.parametrize(
    ("paths", "labels"),
    [
        (["runs/a/localized", "runs/b/localized"], ["a", "b"]),
        (["x/poses_1.txt", "x/poses_2.txt"], ["poses_1.txt", "poses_2.txt"]),
        (["a", "x/a"], ["a", "x/a"]),
        (["/r/a/localized", "/r/b.txt"], ["a/localized", "b.txt"]),
        (["a/b/c", "a/d/e/c"], ["b", "d/e"]),
    ],
)
def test_labels_of_results_are_distinct(paths: list[str], labels: list[str]) -> None:
    assert distinct_labels([Path(path) for path in paths]) == labels


def test_conditions_from_folder_names() -> None:
    rules = SideTables(protocol=protocol_of("robotcar"))
    images = ["night-rain/rear/1.jpg", "dawn/left/2.jpg", "left/3.jpg", "dawn/night/4.jpg"]
    assert rules.conditions(images) == {
        "night-rain/rear/1.jpg": "night-rain",
        "dawn/left/2.jpg": "dawn",
    }
    # a file named like a condition does not count, and tables overrule folders
    assert SideTables(protocol=protocol_of("aachen")).conditions(["query/night"]) == {}
    grouped = SideTables(
        protocol=protocol_of("aachen"), groups={"query/night/1.jpg": ImageGroup(condition="dusk")}
    )
    assert grouped.conditions(["query/night/1.jpg", "query/day/2.jpg"]) == {
        "query/night/1.jpg": "dusk"
    }


def test_thresholds_of_the_challenges() -> None:
    # papers: (0.25, 2) (0.5, 5) (5, 10) outdoors, (0.25, 0.5, 1 m; 10 deg) on InLoc, MLAD by metres
    outdoors = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
    assert protocol_of("aachen").thresholds == outdoors
    assert protocol_of("robotcar").thresholds == outdoors
    assert protocol_of("inloc").thresholds == ((0.25, 10.0), (0.5, 10.0), (1.0, 10.0))
    assert protocol_of("4seasons").thresholds == ((0.1, None), (0.2, None), (0.5, None))
    assert protocol_of("4seasons").pose_file == "mlad"
    assert protocol_of("kapture") == Protocol()
    robotcar = protocol_of("robotcar")
    pooled = [condition for parts in robotcar.pools.values() for condition in parts]
    assert sorted(pooled) == sorted(robotcar.conditions)
    assert robotcar.pools["night-all"] == ("night", "night-rain")
    assert len(robotcar.pools["day-all"]) == 7
    with pytest.raises(OptionError, match="known: aachen, robotcar, 4seasons, inloc"):
        protocol_of("synthetic-cmu")


def test_results_in_other_local_frames(world: Any, tmp_path: Path) -> None:
    truth_world = World(official_from_local=SimilarityTransform(translation=(100.0, 20.0, 3.0)))
    other_world = World(
        official_from_local=SimilarityTransform(
            quat_wxyz=(0.8, 0.0, 0.6, 0.0), translation=(-7.0, 1.0, 0.0)
        )
    )
    for name, official_world in (("one", truth_world), ("two", other_world)):
        write_side_tables(tmp_path / name / "megloc", SideTables(world=official_world))
    names = list(world.truth)
    official = {n: truth_world.pose_in_official(p) for n, p in world.estimated.items()}
    moved = {n: other_world.pose_in_local(p) for n, p in official.items()}
    truth = write_kapture(tmp_path / "one/query_gt", names, world.truth)
    folder = write_kapture(tmp_path / "one/localized", names, world.estimated)
    moved_folder = write_kapture(tmp_path / "two/localized", names, moved)
    (tmp_path / "poses.txt").write_text(format_pose_file(official))
    actual = evaluate_results(
        [folder, moved_folder, tmp_path / "poses.txt"], truth, benchmark_of(tmp_path / "one/megloc")
    )
    first, *others = (evaluation.errors.position_m for evaluation in actual)
    for other in others:
        np.testing.assert_allclose(other, first, rtol=0, atol=1e-9)
    # the guard: in its own frame it is metres off
    wrong = evaluate_results([write_kapture(tmp_path / "lone", names, moved)], truth, SideTables())
    assert np.median(wrong[0].errors.position_m) > 1.0


def test_truth_in_the_official_frame(world: Any, tmp_path: Path, caplog: Any) -> None:
    """As a dataset's owner has it, outside of any import."""
    similarity = SimilarityTransform(
        quat_wxyz=(0.8, 0.0, 0.6, 0.0), translation=(4.1e6, 8.6e5, 4.7e6), scale=2.0
    )
    official_world = World(official_from_local=similarity)
    run, names = tmp_path / "run", list(world.truth)
    write_side_tables(run / "megloc", SideTables(world=official_world))
    local = write_kapture(run / "query_gt", names, world.truth)
    official = {name: official_world.pose_in_official(pose) for name, pose in world.truth.items()}
    actual = write_kapture(run / "localized", names, world.estimated)
    expected = evaluate(actual, local).errors.position_m
    assert not caplog.records
    errors = evaluate(actual, write_kapture(tmp_path / "owner", names, official)).errors.position_m
    np.testing.assert_allclose(errors, expected, rtol=0, atol=1e-6)
    assert "owner is in the dataset's official frame" in caplog.text


def test_listed_names_are_read_back(world: Any, truth: Path, result: Path, tmp_path: Path) -> None:
    names = {name: f"rear/{number}.png" for number, name in enumerate(sorted(world.truth))}
    listed = SideTables(protocol=protocol_of("robotcar"), names=names)
    write_side_tables(tmp_path / "megloc", listed)
    (tmp_path / "poses.txt").write_text(format_pose_file(world.estimated, names=names))
    rules = benchmark_of(tmp_path / "megloc")
    (actual,) = evaluate_results([tmp_path / "poses.txt"], truth, rules)
    assert actual.row().num_missing == 4 and actual.without_truth == ()
    assert "RobotCar Seasons v2 publishes" in actual.truth_known_by
    # last parts of the path alone give the figures of the folder
    (tmp_path / "poses.txt").write_text(format_pose_file(world.estimated, names="basename"))
    from_file, from_folder = evaluate(tmp_path / "poses.txt", truth), evaluate(result, truth)
    np.testing.assert_array_equal(from_file.errors.position_m, from_folder.errors.position_m)
    assert from_file.without_truth == ()


def test_context_of_a_result(tmp_path: Path) -> None:
    here = {"m.jpg": RigidTransform.identity()}
    workspace = tmp_path / "run"
    write_kapture(workspace / "mapping", ["m.jpg"], here)
    write_kapture(workspace / "query", ["q.jpg", "r.jpg"], {})
    result = write_kapture(workspace / "localized", ["q.jpg"], {})
    # not a workspace yet: the result itself is all there is
    assert workspace_of(result) is None and side_tables_near(result) is None
    alone = context_of(result)
    assert alone.query_images() == ["q.jpg"] and alone.map_poses() == {}
    assert context_of(result, mapping=workspace / "mapping").map_poses() == here
    groups = {"m.jpg": ImageGroup(frame="DUC1"), "q.jpg": ImageGroup()}
    tables = SideTables(groups=groups, world=World(unit="units"))
    write_side_tables(workspace / "megloc", tables)
    assert side_tables_near(workspace / "submissions/poses.txt") == workspace / "megloc"
    around = context_of(workspace / "submissions/poses.txt")
    assert around.query_images() == ["q.jpg", "r.jpg"] and around.map_poses() == here
    assert around.frames == {"m.jpg": "DUC1"} and around.unit == "units"
    nothing = context_of(tmp_path / "elsewhere/poses.txt")
    assert nothing.query_images() == [] and nothing.queries is None


def test_status_and_tables_are_used(world: Any, result: Path, truth: Path, tmp_path: Path) -> None:
    alone = evaluate(result, truth)
    assert [row.name for row in alone.rows] == ["all"] and len(alone.thresholds) == 4
    actual = read_result(result, SideTables())
    assert actual.images == tuple(sorted(world.truth))
    assert len(actual.poses) == 36 and actual.statuses == world.statuses
    unscored = sorted(world.truth)[0]
    groups = {
        name: ImageGroup(condition=condition, scored=name != unscored)
        for name, condition in world.conditions.items()
    }
    pools = {"any light": ("day", "night")}
    rules = Protocol(thresholds=((0.1, None),), conditions=("night", "day"), pools=pools)
    write_side_tables(tmp_path, SideTables(protocol=rules, groups=groups))
    evaluation = evaluate(result, truth, side_tables=tmp_path, label="x")
    assert [row.name for row in evaluation.rows] == ["night", "day", "any light", "all"]
    assert evaluation.thresholds == (Threshold(position_m=0.1),)
    assert evaluation.not_scored == (unscored,)
    assert evaluation.row().num_queries == 39
    assert evaluation.row().num_fallback == 4
    other = evaluate(result, truth, side_tables=tmp_path, thresholds=[Threshold(position_m=1.0)])
    assert other.thresholds == (Threshold(position_m=1.0),)


def test_localization_results_have_reasons_and_inliers(world: Any) -> None:
    first, second, third, *_ = sorted(world.estimated)
    truth = {name: world.truth[name] for name in (first, second, third)}
    pose, failure = Pose(world.estimated[first], 300, 120), Failure("no matches", num_matches=7)
    actual = evaluate({first: pose, second: failure}, truth, label="mine")
    table = actual.to_pandas()
    assert table.loc[first, "num_inliers"] == 120 and table.loc[first, "outcome"] == "localized"
    assert table.loc[second, "reason"] == "no matches" and table.loc[second, "num_matches"] == 7
    assert table.loc[third, "outcome"] == "missing" and table.loc[third, "num_inliers"] is pd.NA
    assert actual.label == "mine"


def test_arguments_from_python(world: Any, tmp_path: Path) -> None:
    """Rows of an array and texts are thresholds, and a pose may be None, as that of a Failure."""
    first, *_ = names = sorted(world.truth)
    given: Any
    for given in ("0.1,1", ["0.1,1"], np.array([[0.1, 1.0]])):
        actual = evaluate(world.truth, world.truth, thresholds=given)
        assert actual.thresholds == (Threshold(position_m=0.1, angle_deg=1.0),)
    poses: dict[Any, Any] = {Path(name): world.truth[name] for name in names}
    row = evaluate({**poses, Path(first): None}, world.truth).row()
    assert (row.num_queries, row.num_localized) == (len(names), len(names) - 1)
    single = np.float32  # as networks return them, in arrays
    arrays: Any = {
        n: RigidTransform(single(p.quat_wxyz), single(p.translation))
        for n, p in world.truth.items()  # type: ignore[arg-type]
    }
    assert "equal" not in str(evaluate(arrays, world.truth))
    wrong: Any
    for wrong, message in (
        ({"thresholds": (0.1, 1)}, r"be \(metres, degrees\) pairs, got 0\.1"),
        ({"align": "sim"}, "align is 'sim'; give none, se3 or sim3"),
        ({"align": None}, "align is None; give"),
        ({"truth": list(world.truth.values())}, "or image -> cam_from_world, got list"),
        ({"side_tables": tmp_path / "no"}, "no: no such folder"),
        ({"side_tables": tmp_path}, r"neither protocol\.json nor groups\.csv; give the folder m"),
        ({"mapping": tmp_path / "no"}, "no: no such folder"),
    ):
        with pytest.raises(MeglocError, match=message):
            evaluate(world.truth, **{"truth": world.truth, **wrong})


def test_labels_do_not_decide_the_type_of_a_column(world: Any) -> None:
    first, second = (evaluate(world.estimated, world.truth, label=f"num_{k}") for k in (5, 10))
    table = first.compare(second).to_pandas()
    assert set(table["num_5: outcome"]) == {"localized", "missing"}


@pytest.mark.parametrize("kind", ["binary without points", "images.bin", "images.txt", "text"])
def test_colmap_models_are_results_too(world: Any, truth: Path, tmp_path: Path, kind: str) -> None:
    import pycolmap

    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=8, height=6, params=[5, 5, 4, 3], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for number, (name, pose) in enumerate(world.truth.items(), start=1):
        image = pycolmap.Image(image_id=number, name=f"above/{name}", camera_id=1)
        model.add_image_with_trivial_frame(image, new_colmap_pose(pose))
    (folder := tmp_path / "sparse" / "0").mkdir(parents=True)
    if kind in ("images.txt", "text"):
        model.write_text(str(folder))
        source = folder / "images.txt" if kind == "images.txt" else tmp_path
    else:
        model.write_binary(str(folder))
        (folder / "points3D.bin").unlink()
        source = folder / "images.bin" if kind == "images.bin" else tmp_path
    for row in (evaluate(source, truth).row(), evaluate(truth, source).row()):
        assert row.num_localized == row.num_queries == len(world.truth)
        assert row.median_position_m == pytest.approx(0.0, abs=1e-9)


def test_unrelated_names_are_refused(world: Any, truth: Path, tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text(format_pose_file({"other.jpg": RigidTransform.identity()}))
    with pytest.raises(DataError, match="no name fits: the result has 'other.jpg', the truth"):
        evaluate(tmp_path / "poses.txt", truth)
    with pytest.raises(DataError, match=r"'a.jpg': ndarray is not a pose; use RigidTransform"):
        evaluate({"a.jpg": np.eye(4)}, truth)  # type: ignore[dict-item]


def test_queries_may_lack_folders(world: Any, truth: Path, result: Path, tmp_path: Path) -> None:
    names = [f"seq/{name}" for name in world.truth]
    poses = {f"seq/{name}": pose for name, pose in world.estimated.items()}
    longer = write_kapture(tmp_path / "longer", names, poses)
    statuses = [replace(status, name=f"seq/{name}") for name, status in world.statuses.items()]
    write_status(longer / "status.csv", statuses)
    first, second = evaluate_results([result, longer], truth, SideTables())
    assert first.rows == second.rows and first.row().num_localized > 0
    assert [q.reason for q in first.queries] == [q.reason for q in second.queries]
    longest = write_kapture(tmp_path / "gt", names, {f"seq/{n}": p for n, p in world.truth.items()})
    again = evaluate_results([longer, result], longest, SideTables())
    assert [evaluation.rows for evaluation in again] == [first.rows, first.rows]


def test_a_result_with_other_poses_only_is_a_miss(world: Any, truth: Path, tmp_path: Path) -> None:
    other = {"left.jpg": RigidTransform.identity()}  # not evaluated, as RobotCar's side cameras
    folder = write_kapture(tmp_path / "localized", list(other), other)
    write_status(folder / "status.csv", [Failure("-", name=name) for name in world.truth])
    row = evaluate(folder, truth).row()
    assert (row.num_queries, row.num_localized) == (len(world.truth), 0)


def test_folders_of_no_usable_pose_are_refused(result: Path, truth: Path, tmp_path: Path) -> None:
    table = truth / "sensors" / "trajectories.txt"
    table.write_text(re.sub(r"(?m)^ *(\d+),", r"1000\1,", table.read_text()))
    for given in ((result, truth), (truth, result)):
        with pytest.raises(DataError, match="sensors: no pose of trajectories.txt has the timest"):
            evaluate(*given)
    table.unlink()
    with pytest.raises(DataError, match="query_gt: has no poses"):
        evaluate(result, truth)


def test_alignment() -> None:
    rng = np.random.default_rng(0)
    true = {f"{n}.jpg": random_pose(rng) for n in range(10)}
    world = World(official_from_local=SimilarityTransform(scale=3.7, translation=(9.0, -5.0, 2.0)))
    moved = {name: world.pose_in_official(pose) for name, pose in true.items()}
    actual = evaluate(moved, true)
    assert actual.row().recall[-1].num_within == 0
    assert "fit the truth after a similarity of scale 0.27027; use --align sim3" in str(actual)
    assert evaluate(moved, true, align="sim3").row().recall[0].num_within == 10
    assert evaluate(moved, true, align="se3").row().recall[0].num_within < 10
    by_chance = dict(zip(true, list(true.values())[::-1], strict=True))
    assert not evaluate(by_chance, true).alignment
    assert evaluate(by_chance, true, align="sim3").row().recall[0].num_within < 5
    assert not evaluate(true, true).alignment


def test_another_convention_of_results_or_truth_is_named() -> None:
    rng = np.random.default_rng(1)
    true = {f"{n}.jpg": random_pose(rng) for n in range(6)}
    for words, convert in WRONG_CONVENTIONS.items():
        given = {name: convert(pose) for name, pose in true.items()}
        note = f"but 100% with the results in another convention: {words}"
        assert note in evaluate(given, true).alignment
    assert "true poses in another convention: quaternions" in evaluate(true, given).alignment
