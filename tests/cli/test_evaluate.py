"""``megloc evaluate``, ``submit`` and ``check``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.evaluation.pose_files import format_pose_file
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.dataset_tables import (
    ImageGroup,
    Protocol,
    RelocalizationPair,
    SideTables,
    write_protocol,
    write_side_tables,
)
from megloc_kapture.io.kapture import KaptureFolder, write_sensors
from megloc_kapture.io.tables import write_status
from megloc_kapture.values import LocalizationResult, RigidTransform
from tests.worlds import one_camera

IMAGES = [f"query/{'night' if i % 4 == 0 else 'day'}/{i:03d}.jpg" for i in range(40)]
MAPPED = {
    f"map/{i}.jpg": RigidTransform((1.0, 0.0, 0.0, 0.0), (-4.0 * i, 0.0, 0.0)) for i in range(20)
}


def write_kapture(root: Path, images: list[str], poses: dict[str, RigidTransform]) -> None:
    write_sensors(root, one_camera(images, poses))


def write_candidates(result: Path) -> None:
    """Write a status with one candidate per query, from the same location."""
    counts = {"num_matches": 99, "num_inliers": 50}
    rows = [
        LocalizationResult(name=image, candidates=(f"map/{i // 2}.jpg",), **counts)
        for i, image in enumerate(IMAGES)
    ]
    write_status(result / "status.csv", rows)


def poses_off(by_m: float, num_lost: int = 0) -> dict[str, RigidTransform]:
    """Every query 2 m from the next, moved by ``by_m``; the first ``num_lost`` by 50 m."""
    return {
        image: RigidTransform((1.0, 0.0, 0.0, 0.0), (-2.0 * i, 50.0 if i < num_lost else by_m, 0.0))
        for i, image in enumerate(IMAGES)
    }


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Workspaces ``a`` and ``b`` of two runs: truth, map, and results with lost queries."""
    root = tmp_path_factory.mktemp("runs")
    for name, by_m, num_lost in (("a", 0.01, 2), ("b", 0.02, 14)):
        workspace = root / name
        write_kapture(workspace / "query_gt", IMAGES, poses_off(0.0))
        write_kapture(workspace / "mapping", list(MAPPED), MAPPED)
        write_kapture(workspace / "localized", IMAGES, poses_off(by_m, num_lost))
        write_candidates(workspace / "localized")
        groups = {image: ImageGroup(condition=image.split("/")[1]) for image in IMAGES}
        write_side_tables(
            workspace / "megloc", SideTables(protocol=protocol_of("aachen"), groups=groups)
        )
    return root


def results(runs: Path, *names: str) -> list[str | Path]:
    return ["evaluate", *(word for name in names for word in ("-i", runs / name / "localized"))]


def test_two_results_are_compared_query_by_query(megloc: Any, runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = megloc(*results(runs, "a", "b"), "--gt", runs / "a/query_gt", "-o", out)
    assert done.status == 0
    flat = " ".join(done.out.split())
    assert (
        "At 0.25 m, 2 deg, a localizes 12 queries that b misses and b localizes none that a "
        "misses: the difference is real (p = 0.0015)."
    ) in flat  # 2 * 0.5^12, times the three thresholds
    comparison = json.loads((out / "recall.json").read_text())["comparison"]
    assert comparison["tests"][0]["only_first"] == sorted(IMAGES[2:14])
    assert (out / "recall.txt").read_text() == done.out.removesuffix("\n")
    # a pose file may be one of them
    poses = tmp_path / "poses.txt"
    poses.write_text(format_pose_file(poses_off(0.01, 2), names="basename"))
    done = megloc(*results(runs, "a"), "-i", poses, "--gt", runs / "a/query_gt")
    assert "/poses.txt localize the same 38 queries" in " ".join(done.out.split())


def test_a_notebook_backend_and_a_terminal_without_unicode_do_no_harm(
    runs: Path, tmp_path: Path
) -> None:
    linked = tmp_path / "später"
    linked.symlink_to(runs / "b/localized")
    command = [*results(runs, "a"), "-i", linked, "--gt", runs / "a/query_gt", "-o", tmp_path / "o"]
    environment = {"MPLBACKEND": "module://missing", "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [sys.executable, "-m", "megloc_kapture", *map(str, command)],
        env=os.environ | environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "sp\\xe4ter" in done.stdout


def test_results_without_truth_are_compared_with_each_other(
    megloc: Any, runs: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    done = megloc(*results(runs, "a", "b"), "-o", out)
    assert done.status == 0
    assert "No recall: The true poses of the queries are not published" in done.out
    content = json.loads((out / "agreement.json").read_text())
    whole = content["results"][0]["rows"][-1]
    assert whole["num_localized"] == 40 and whole["inliers_quartiles"] == [50.0, 50.0, 50.0]
    # 26 queries are 1 cm apart, 2 are lost in the same way
    agreement = content["agreement"][-1]
    assert agreement["within"][0]["num_within"] == 28
    assert (out / "report.html").is_file() and not (out / "recall.json").exists()
    assert (out / "agreement.txt").read_text() == done.out.removesuffix("\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "no result given; use -i"),
        ("-i {}/a/localized -i {}/a/../a/localized", "is given twice"),
        ("-i {}/a/localized --dataset cmu", "unknown dataset 'cmu'; known: aachen"),
        ("-i {}/a/localized --gt {}/a/query_gt --thresholds x", "METRES,DEGREES"),
        ("-i {}/a/localized --gt {}/a/query_gt --map {}/none", "none: no such folder"),
        ("-i {}/a/localized --gt {}/a/query_gt -o {}/a", "is not empty"),
    ],
)
def test_wrong_arguments_of_evaluate_are_refused(
    megloc: Any, runs: Path, arguments: str, message: str
) -> None:
    before = sorted(runs.rglob("*"))
    words = [word.replace("{}", str(runs)) for word in arguments.split()]
    megloc("evaluate", *words).refused(message)
    assert sorted(runs.rglob("*")) == before


def write_relocalization_dataset(root: Path) -> None:
    """Write an imported dataset with relocalization pairs, and a result without one query."""
    names = [f"{number}.png" for number in range(4)]
    poses = {name: RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for name in names}
    write_kapture(root / "mapping", ["100.png"], {"100.png": poses["0.png"]})
    write_kapture(root / "query", names, {})
    write_kapture(root / "localized", names, {name: poses[name] for name in names[1:]})
    pairs = [RelocalizationPair("a_to_b.txt", "100.png", name) for name in names]
    rules = Protocol(dataset="4seasons", pose_file="mlad")
    write_side_tables(root / "megloc", SideTables(protocol=rules, relocalization=pairs))


def test_a_submission_of_relocalization_pairs_is_a_folder(megloc: Any, tmp_path: Path) -> None:
    root, place = tmp_path / "imported", tmp_path / "submission"
    write_relocalization_dataset(root)
    command = ["submit", "4seasons", "-i", root / "localized", "-o", place]
    place.mkdir()  # an empty folder may exist
    done = megloc(*command)
    assert done.out == f"3 poses of 4 queries, 1 missing, written as dummy poses: {place}\n"
    assert {path.name for path in tmp_path.glob("submission*")} == {place.name, "submission.json"}
    assert [path.name for path in place.iterdir()] == ["a_to_b.txt"]
    megloc(*command).refused("submission: is not empty .* or -f")
    assert megloc(*command, "-f").status == 0
    tables = ("--side-tables", root / "megloc")
    megloc("evaluate", "-i", place, *tables).refused("relative to the map's", "--map")


Poses = dict[str, RigidTransform]


@pytest.fixture
def poses(scene: Path) -> Poses:
    return KaptureFolder(scene / "query_gt").read().poses()


@pytest.fixture
def place(poses: Poses, tmp_path: Path) -> Path:
    (tmp_path / "poses.txt").write_text(format_pose_file(poses))
    return tmp_path / "poses.txt"


@pytest.fixture
def aachen(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only workspace of dataset aachen below runs/, with the map of the scene."""
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "runs" / "aachen-classic"
    for part in ("mapping", "query"):
        write_sensors(root / part, KaptureFolder(scene / part).read())
    write_protocol(root / "megloc", Protocol(dataset="aachen", pose_file_names="basename"))
    return root


def test_a_correct_pose_file_has_no_problem(megloc: Any, aachen: Path, place: Path) -> None:
    done = megloc("check", "aachen", place)
    assert (done.status, done.out) == (0, "4 poses of 4 queries: no problem found\n")
    assert done.err == "compared with runs/aachen-classic\n"
    assert megloc("check", "synthetic-aachen", place, "--data", aachen, "-q").err == ""


@pytest.mark.usefixtures("aachen")
def test_problems_of_a_pose_file_are_listed(megloc: Any, poses: Poses, place: Path) -> None:
    place.write_text(format_pose_file({name: pose.inverse() for name, pose in poses.items()}))
    with place.open("a") as file:
        file.write("stranger.jpg 1 0 0\n")
    done = megloc("check", "aachen", place)
    assert done.status == 2
    assert done.out.startswith("error: poses.txt: poses inverted (camera-to-world")
    assert "poses.txt:5: 4 columns instead of 8" in done.out
    assert done.out.splitlines()[-1].startswith("4 poses of 4 queries: ")
    content = json.loads(megloc("check", "aachen", place, "--json").out)
    assert content["ok"] is False and content["findings"][0]["kind"] == "convention"
