"""One result against true poses: totals, queries, and MLAD's pairs."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corner import pose_at
from scipy.spatial.transform import Rotation
from scored import evaluate_poses, evaluation_of, write_kapture

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.evaluate import evaluate_results
from megloc_kapture.evaluation.metrics import thresholds_from_pairs
from megloc_kapture.evaluation.pose_files import format_mlad_file, relative_pose
from megloc_kapture.evaluation.protocols import benchmark_of, protocol_of
from megloc_kapture.evaluation.report.content import criterion
from megloc_kapture.evaluation.report.queries import shown_queries
from megloc_kapture.evaluation.report.reports import plain, report_data, report_text
from megloc_kapture.evaluation.results import Result
from megloc_kapture.evaluation.scoring import evaluate_pairs
from megloc_kapture.io.dataset_tables import (
    RelocalizationPair,
    SideTables,
    write_side_tables,
)
from megloc_kapture.values import LocalizationResult, RigidTransform

HERE = RigidTransform.identity()


def test_every_true_query_is_counted_once(world: Any) -> None:
    evaluation = evaluation_of(world)
    assert [q.image for q in evaluation.queries] == sorted(world.truth)
    assert evaluation.errors.names == tuple(sorted(world.truth))
    row = evaluation.row()
    outcomes = [query.outcome for query in evaluation.queries]
    assert row.num_localized == outcomes.count("localized") == 32
    assert row.num_fallback == outcomes.count("fallback") == 4
    assert row.num_missing == outcomes.count("missing") == 4
    assert evaluation.row("day").num_queries + evaluation.row("night").num_queries == 40
    posed = [q.name for q in evaluation.queries if q.cam_from_world is not None]
    assert posed == sorted(world.estimated)
    with pytest.raises(KeyError):
        evaluation.row("noon")
    # in whatever order they come
    first = evaluate_poses(world.estimated, world.truth)
    backwards = (dict(reversed(each.items())) for each in (world.estimated, world.truth))
    second = evaluate_poses(*backwards)
    assert (first.rows, first.queries) == (second.rows, second.queries)


@pytest.mark.parametrize(("times", "low", "high"), [(1.0, 0.92, 0.98), (2.0, 0.1, 0.3)])
def test_share_of_errors_within_covariances(times: float, low: float, high: float) -> None:
    """Errors drawn from the covariances lie within the 95 % region in 95 % of all cases."""
    rng = np.random.default_rng(0)
    estimated, truth, covariances = {}, {}, {}
    for number in range(300):
        half = rng.normal(size=(6, 6)) * np.array([1e-3] * 3 + [0.1] * 3)[:, None]
        step = times * half @ rng.normal(size=6)
        x, y, z, w = Rotation.from_rotvec(step[:3]).as_quat().tolist()
        error = RigidTransform((w, x, y, z), tuple(step[3:].tolist()))
        x, y, z, w = Rotation.random(rng=rng).as_quat().tolist()
        pose = RigidTransform((w, x, y, z), tuple((100 * rng.normal(size=3)).tolist()))
        name = f"{number}.jpg"
        estimated[name], truth[name], covariances[name] = pose, error @ pose, half @ half.T
    estimated["guess.jpg"] = truth["guess.jpg"] = HERE  # without a covariance
    evaluation = evaluate_poses(estimated, truth, covariances=covariances)
    check = evaluation.covariance
    assert check is not None and check["num_poses"] == 300
    assert low < check["num_within"] / 300 < high
    line = f"Covariance: {check['num_within']} of 300 errors lie within the estimated 95 % region"
    assert line in report_text(evaluation)
    assert plain(report_data(evaluation))["covariance"] == check
    assert "Covariance" not in report_text(evaluate_poses(estimated, truth))


def test_images_without_truth_are_not_counted() -> None:
    evaluation = evaluate_poses({"b": HERE, "x": HERE, "c": HERE}, {"a": HERE, "b": HERE})
    assert evaluation.without_truth == ("c", "x")
    assert [q.name for q in evaluation.queries] == ["a", "b"]
    truth = {"a": HERE, "b": HERE, "c": HERE}
    evaluation = evaluate_poses({"a": HERE, "unknown": HERE}, truth, scored={"a", "c"})
    assert [q.image for q in evaluation.queries] == ["a", "c"]
    assert (evaluation.not_scored, evaluation.without_truth) == (("b",), ("unknown",))


def test_outcomes_and_reasons_from_statuses() -> None:
    statuses = {
        "a": LocalizationResult(name="a", num_matches=9, num_inliers=5),
        "b": LocalizationResult(name="b", reason="dark", fallback="retrieval"),
        "c": LocalizationResult(name="c", reason="blurred"),
        "d": LocalizationResult(name="d"),
    }
    truth = dict.fromkeys("abcde", HERE)
    evaluation = evaluate_poses({"a": HERE, "b": HERE}, truth, statuses=statuses)
    assert [(q.outcome, q.reason, q.num_inliers) for q in evaluation.queries] == [
        ("localized", "", 5),
        ("fallback", "dark", None),
        ("missing", "blurred", None),
        ("missing", "the status is localized, but the result has no pose", None),
        ("missing", "no pose in the result", None),
    ]


def test_results_without_scored_queries_are_refused() -> None:
    for truth, options in (({}, {}), ({"a": HERE}, {"scored": set()})):
        with pytest.raises(DataError, match="no query with a true pose"):
            evaluate_poses({"a": HERE}, truth, **options)


def test_the_coarsest_threshold_need_not_be_given_last() -> None:
    thresholds = thresholds_from_pairs(((5.0, 10.0), (0.25, 2.0), (0.25, None)))
    statuses = {name: LocalizationResult(name=name, confidence=0.9) for name in "ab"}
    result = evaluate_poses(
        {"a": pose_at([1.0, 0.0, 0.0]), "b": pose_at([0.1, 0.0, 0.0])},
        dict.fromkeys("ab", HERE),
        thresholds=thresholds,
        statuses=statuses,
    )
    assert result.confidence is not None and result.confidence.num_wrong == 0
    meanings = [query.meaning for query in shown_queries(result)]
    assert meanings == ["within 5 m, 10 deg", "within 0.25 m, 2 deg"]


MLAD = protocol_of("4seasons")


def evaluate_query(estimated: RigidTransform, truth: RigidTransform) -> Any:
    pairs = [RelocalizationPair("a_to_b.txt", "ref.png", "q.png")]
    benchmark = SideTables(protocol=MLAD, relocalization=pairs)
    result = Result("", {"q.png": estimated}, ("q.png",))
    references = {"ref.png": pose_at([0.0, 0.0, 0.0], 33.0)}
    return evaluate_pairs(result, {"q.png": truth}, benchmark, references)


@pytest.mark.parametrize(("distance_m", "turn_deg"), [(3.0, 20.0), (50.0, 0.2)])
def test_relative_errors_of_a_rotation_and_a_shift(distance_m: float, turn_deg: float) -> None:
    # right place, wrong heading: the reference is seen on a circle around the query
    at, turned = [distance_m, 0.0, 0.0], pose_at([distance_m, 0.0, 0.0], turn_deg)
    actual = evaluate_query(turned, pose_at(at))
    chord = 2 * distance_m * np.sin(np.deg2rad(turn_deg) / 2)
    assert actual.errors.position_m[0] == pytest.approx(chord, rel=1e-12)
    assert actual.by_center.errors.position_m[0] == pytest.approx(0.0, abs=1e-12)
    assert actual.errors.angle_deg[0] == pytest.approx(turn_deg)
    actual = evaluate_query(pose_at([distance_m + 0.1, 0.0, 0.2], turn_deg), turned)
    for errors in (actual.errors, actual.by_center.errors):
        assert errors.position_m[0] == pytest.approx(np.hypot(0.1, 0.2))


def test_mlad_pairs_and_conditions() -> None:
    truth = {f"q{i}.png": pose_at([i, 0.0, 0.0]) for i in range(4)}
    estimated = {
        "q0.png": pose_at([0.09, 0.0, 0.0]),
        "q1.png": pose_at([1.3, 0.0, 0.0]),
        "q2.png": pose_at([2.0, 0.0, 0.0]),
    }
    references = {"r0.png": pose_at([0.0, 0.0, 5.0]), "r1.png": pose_at([0.0, 5.0, 0.0])}
    first, second = "reloc_town_1_to_town_2.txt", "reloc_park_1_to_park_2.txt"
    asked = [(first, "r0", "q0"), (first, "r1", "q0"), (second, "r0", "q1"), (second, "r0", "q3")]
    asked += [(second, "r1", "unknown")]
    pairs = [RelocalizationPair(file, f"{r}.png", f"{q}.png") for file, r, q in asked]
    statuses = {"q3.png": LocalizationResult(name="q3.png", reason="dark")}
    actual = evaluate_pairs(
        Result("", estimated, tuple(estimated), statuses),
        truth,
        SideTables(protocol=MLAD, relocalization=tuple(pairs)),
        references,
    )
    assert [row.name for row in actual.rows] == ["town_2", "park_2", "all"]
    assert [row.num_queries for row in actual.rows] == [2, 2, 4]
    # a query of two pairs is called by its pair, one of one pair by its name
    assert actual.errors.names == (
        f"q0.png from r0.png, {first}",
        f"q0.png from r1.png, {first}",
        "q1.png",
        "q3.png",
    )
    assert actual.pairs[actual.errors.names[0]].query == "q0.png"
    assert [at.num_within for at in actual.row("town_2").recall] == [2, 2, 2]
    assert [at.num_within for at in actual.row("park_2").recall] == [0, 0, 1]
    assert actual.queries[-1].reason == "dark"
    assert actual.without_truth == ("unknown.png",)
    assert actual.by_center.row().num_queries == 4
    assert criterion(actual).startswith("Error of the translation relative to the given reference")
    with_angles = replace(actual, thresholds=thresholds_from_pairs(((0.1, 2.0),)))
    assert criterion(with_angles).startswith("Errors of the rotation and of the translation")


def test_pose_files_and_folders_have_equal_figures(tmp_path: Path) -> None:
    """Two relocalization files; one query of six has no pose."""
    rng = np.random.default_rng(4)
    workspace, files = tmp_path / "workspace", tmp_path / "submission"
    references = {f"a/{i}.png": pose_at([i, 0.0, 0.0], 10.0 * i) for i in (100, 200)}
    names = [*(f"b/{i}.png" for i in (103, 104, 105)), *(f"c/{i}.png" for i in (206, 207, 208))]
    truth = {n: pose_at([int(n[2:5]) + 1.0, 0.5, 2.0], 5.0 * int(n[2:5])) for n in names}
    estimated = {
        name: pose_at(pose.center() + rng.normal(size=3) * 0.1, 5.0 * int(name[2:5]) + 1)
        for name, pose in list(truth.items())[:-1]
    }
    write_kapture(workspace / "mapping", list(references), references)
    write_kapture(workspace / "query_gt", names, truth)
    write_kapture(workspace / "localized", names, estimated)
    pairs = [
        RelocalizationPair(f"reloc_{name[0]}.txt", f"a/{name[2]}00.png", name) for name in names
    ]
    listed = SideTables(protocol=MLAD, relocalization=pairs)
    write_side_tables(workspace / "megloc", listed)
    files.mkdir()
    for file in ("reloc_b.txt", "reloc_c.txt"):
        asked = [(p.reference, p.query) for p in pairs if p.file == file and p.query in estimated]
        rows = {
            (int(r[2:5]), int(q[2:5])): relative_pose(estimated[q], references[r]) for r, q in asked
        }
        (files / file).write_text(format_mlad_file(rows))
    rules = benchmark_of(workspace / "megloc")
    results = [workspace / "localized", files]
    folder, submitted = evaluate_results(results, workspace / "query_gt", rules)
    assert folder.row().num_queries == 6 and folder.row().num_missing == 1
    np.testing.assert_allclose(submitted.errors.position_m, folder.errors.position_m, atol=1e-12)
    assert folder.thresholds == thresholds_from_pairs(MLAD.thresholds)
    # one file of two: the other file's pairs have no pose
    (half,) = evaluate_results(
        [files / "reloc_b.txt"], workspace / "query_gt", rules, mapping=workspace / "mapping"
    )
    assert half.row("b").num_missing == 0
    assert half.row("c").num_missing == 3
    renamed = shutil.copyfile(files / "reloc_b.txt", tmp_path / "mine.txt")
    with pytest.raises(DataError, match="rename it to one of reloc_b.txt, reloc_c.txt"):
        evaluate_results([renamed], workspace / "query_gt", rules, mapping=workspace / "mapping")
    # a dummy row in place of a missing pose counts as missing
    first, *others = (files / "reloc_b.txt").read_text().splitlines()
    rows = [" ".join([*first.split()[:2], "0 0 0 0 0 0 1"]), *others]
    (files / "reloc_b.txt").write_text("".join(f"{row}\n" for row in rows))
    with_dummy, _ = evaluate_results([files, results[0]], workspace / "query_gt", rules)
    assert with_dummy.row("b").num_missing == 1
