"""Results and rules from disk: labels, frames, names, conditions, what lies around a result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.evaluation.folders import evaluate_results
from megloc_kapture.evaluation.pose_file import write_pose_file
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.evaluation.results import distinct_labels, read_result
from megloc_kapture.evaluation.rules import Rules, read_rules
from megloc_kapture.evaluation.surroundings import (
    side_tables_near,
    surroundings_of,
    workspace_of,
)
from megloc_kapture.evaluation.thresholds import Threshold
from megloc_kapture.io.challenge_tables import write_names
from megloc_kapture.io.side_tables import (
    ImageGroup,
    Protocol,
    SimilarityTransform,
    World,
    write_groups,
    write_protocol,
    write_world,
)
from megloc_kapture.values import RigidTransform


@pytest.mark.parametrize(
    ("paths", "labels"),
    [
        (["runs/a/localized"], ["runs/a/localized"]),
        (["runs/a/localized", "runs/b/localized"], ["a", "b"]),
        (["x/poses_1.txt", "x/poses_2.txt"], ["poses_1.txt", "poses_2.txt"]),
        (["runs/a/localized", "runs/a/again"], ["localized", "again"]),
        (["a", "x/a"], ["a", "x/a"]),
        (["/r/a/localized", "/r/b.txt"], ["a/localized", "b.txt"]),
        (["a/b/c", "a/d/e/c"], ["b", "d/e"]),
    ],
)
def test_labels_tell_results_apart(paths: list[str], labels: list[str]) -> None:
    assert distinct_labels([Path(path) for path in paths]) == labels


def test_conditions_from_folders_where_no_table_has_them() -> None:
    rules = Rules(protocol=protocol_of("robotcar"))
    images = ["night-rain/rear/1.jpg", "dawn/left/2.jpg", "left/3.jpg", "dawn/night/4.jpg"]
    assert rules.conditions(images) == {
        "night-rain/rear/1.jpg": "night-rain",
        "dawn/left/2.jpg": "dawn",
    }
    # a file called like a condition is none, and tables overrule folders
    assert Rules(protocol=protocol_of("aachen")).conditions(["query/night"]) == {}
    grouped = Rules(
        protocol=protocol_of("aachen"), groups={"query/night/1.jpg": ImageGroup(condition="dusk")}
    )
    assert grouped.conditions(["query/night/1.jpg", "query/day/2.jpg"]) == {
        "query/night/1.jpg": "dusk"
    }


def test_a_named_dataset_overrules_the_protocol_and_keeps_the_groups(tmp_path: Path) -> None:
    write_protocol(tmp_path, Protocol(dataset="mine", thresholds=((1.0, None),)))
    write_groups(tmp_path, {"a.jpg": ImageGroup(condition="day")})
    assert read_rules(tmp_path).thresholds() == (Threshold(position_m=1.0),)
    rules = read_rules(tmp_path, "inloc")
    assert rules.protocol.dataset == "inloc" and "a.jpg" in rules.groups
    assert read_rules().protocol == Protocol()


def test_workspaces_that_were_recentred_in_other_ways_are_brought_together(
    world: Any, tmp_path: Path, kaptures: Callable[..., Path]
) -> None:
    truth_world = World(official_from_local=SimilarityTransform(translation=(100.0, 20.0, 3.0)))
    other_world = World(
        official_from_local=SimilarityTransform(
            quat_wxyz=(0.8, 0.0, 0.6, 0.0), translation=(-7.0, 1.0, 0.0)
        )
    )
    write_world(tmp_path / "one/megloc", truth_world)
    write_protocol(tmp_path / "one/megloc", Protocol())
    write_world(tmp_path / "two/megloc", other_world)
    write_protocol(tmp_path / "two/megloc", Protocol())
    names = list(world.truth)
    official = {n: truth_world.pose_in_official(p) for n, p in world.estimated.items()}
    moved = {n: other_world.pose_in_local(p) for n, p in official.items()}
    truth = kaptures(tmp_path / "one/query_gt", names, world.truth)
    here = kaptures(tmp_path / "one/localized", names, world.estimated)
    there = kaptures(tmp_path / "two/localized", names, moved)
    write_pose_file(tmp_path / "poses.txt", official)
    found = evaluate_results(
        [here, there, tmp_path / "poses.txt"], truth, read_rules(tmp_path / "one/megloc")
    )
    for other in found[1:]:
        np.testing.assert_allclose(
            other.errors.position_m, found[0].errors.position_m, rtol=0, atol=1e-9
        )
    # the guard: in its own frame it is metres off
    wrong = evaluate_results([kaptures(tmp_path / "lone", names, moved)], truth, Rules())
    assert np.median(wrong[0].errors.position_m) > 1.0


def test_the_challenges_names_are_read_back(
    world: Any, tmp_path: Path, kaptures: Callable[..., Path]
) -> None:
    names = {name: f"rear/{number}.png" for number, name in enumerate(sorted(world.truth))}
    write_protocol(tmp_path / "megloc", protocol_of("robotcar"))
    write_names(tmp_path / "megloc", names)
    write_pose_file(tmp_path / "poses.txt", world.estimated, names=names)
    truth = kaptures(tmp_path / "query_gt", list(world.truth), world.truth)
    rules = read_rules(tmp_path / "megloc")
    (found,) = evaluate_results([tmp_path / "poses.txt"], truth, rules)
    assert found.row().num_missing == 4 and found.without_truth == ()
    assert "RobotCar Seasons v2 publishes" in found.truth_known_by


def test_a_result_knows_all_its_queries(
    world: Any, tmp_path: Path, kaptures: Callable[..., Path]
) -> None:
    names = sorted(world.truth)
    folder = kaptures(tmp_path / "localized", names, world.estimated)
    found = read_result(folder, Rules(), label="x")
    assert found.images == tuple(names)
    assert len(found.poses) == 36 and found.statuses is None


def test_what_lies_around(tmp_path: Path, kaptures: Callable[..., Path]) -> None:
    here = {"m.jpg": RigidTransform.identity()}
    workspace = tmp_path / "run"
    kaptures(workspace / "mapping", ["m.jpg"], here)
    kaptures(workspace / "query", ["q.jpg", "r.jpg"], {})
    result = kaptures(workspace / "localized", ["q.jpg"], {})
    # not a workspace yet: the result itself is all there is
    assert workspace_of(result) is None and side_tables_near(result) is None
    alone = surroundings_of(result)
    assert alone.query_images() == ["q.jpg"] and alone.map_poses() == {}
    assert surroundings_of(result, mapping=workspace / "mapping").map_poses() == here
    write_protocol(workspace / "megloc", Protocol())
    write_groups(workspace / "megloc", {"m.jpg": ImageGroup(frame="DUC1"), "q.jpg": ImageGroup()})
    assert side_tables_near(workspace / "submissions/poses.txt") == workspace / "megloc"
    around = surroundings_of(workspace / "submissions/poses.txt")
    assert around.query_images() == ["q.jpg", "r.jpg"] and around.map_poses() == here
    assert around.frames == {"m.jpg": "DUC1"}
    nothing = surroundings_of(tmp_path / "elsewhere/poses.txt")
    assert nothing.query_images() == [] and nothing.queries is None
