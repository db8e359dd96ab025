"""The check of pose files: conventions against the map, rows, names and MLAD's pairs."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from poses import WRONG_CONVENTIONS
from scored import upright_camera

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.check import CheckReport, Finding, Reference, check_submission
from megloc_kapture.evaluation.pose_files import format_mlad_file, format_pose_file
from megloc_kapture.io.dataset_tables import (
    Protocol,
    RelocalizationPair,
    SimilarityTransform,
    World,
)
from megloc_kapture.values import RigidTransform

Poses = dict[str, RigidTransform]
Check = Callable[..., CheckReport]


def looking(centers: np.ndarray, yaw: np.ndarray, pitch: np.ndarray, folder: str) -> Poses:
    cameras = map(upright_camera, centers, yaw, pitch)
    return {f"{folder}/{number:03d}.jpg": camera for number, camera in enumerate(cameras)}


def street(number: int, folder: str, rng: np.random.Generator) -> Poses:
    """Along a bend of 600 m, far from the origin."""
    along = np.sort(rng.uniform(0, 600, number))
    centers = np.stack([200 * np.sin(along / 150), along, 0 * along + rng.normal(0, 0.1)], axis=1)
    heading = np.pi / 2 - along / 400 + rng.normal(0, 0.05, number)
    return looking(centers + [620_000.0, 5_735_000.0, 100.0], heading, 0 * along - 0.2, folder)


def table(number: int, folder: str, rng: np.random.Generator) -> Poses:
    """Around an object of a metre, which is the origin."""
    around, above = rng.uniform(0, 3.5, number), rng.uniform(0.2, 1.2, number)
    level = np.stack([np.cos(around), np.sin(around)], axis=1) * np.cos(above)[:, None]
    centers = np.column_stack([level, np.sin(above)]) * rng.uniform(0.8, 1.2, (number, 1))
    return looking(centers, around + np.pi, -above + rng.normal(0, 0.1, number), folder)


def made(make: Callable[..., Poses]) -> tuple[Reference, Poses]:
    rng = np.random.default_rng(4)
    map_poses, poses = make(80, "m", rng), make(40, "q", rng)
    expected = {name: name for name in poses}
    queries = frozenset(poses)
    return Reference(
        folder="import", map_poses=map_poses, expected=expected, queries=queries
    ), poses


@pytest.fixture
def check(tmp_path: Path) -> Check:
    def run(
        lines: Sequence[str],
        reference: Reference | None = None,
        dataset: str = "kapture",
        name: str = "poses.txt",
    ) -> CheckReport:
        (tmp_path / name).write_text("".join(lines))
        return check_submission(tmp_path / name, dataset=dataset, reference=reference)

    return run


def kinds(report: CheckReport) -> list[tuple[str, str]]:
    return [(finding.severity, finding.kind) for finding in report.findings]


def only(report: CheckReport) -> Finding:
    (finding,) = report.findings
    return finding


@pytest.mark.parametrize("scene", [street, table])
def test_the_five_conventions(check: Check, scene: Callable[..., Poses]) -> None:
    reference, poses = made(scene)
    report = check(format_pose_file(poses), reference)
    assert report.lines() == ["40 poses of 40 queries: no problem found"]
    for words, convert in WRONG_CONVENTIONS.items():
        wrong = {name: convert(pose) for name, pose in poses.items()}
        error = only(check(format_pose_file(wrong), reference))
        assert (error.severity, error.kind) == ("error", "convention") and words in error.message
        shares = re.search(r", (\d+)% of .* but only (\d+)% as they are", error.message)
        assert shares is not None and int(shares[1]) > int(shares[2])


def test_a_recentred_map(check: Check) -> None:
    reference, poses = made(street)
    world = World(
        official_from_local=SimilarityTransform(translation=(620_000.0, 5_735_000.0, 100.0))
    )
    local = {name: world.pose_in_local(pose) for name, pose in reference.map_poses.items()}
    recentred = replace(reference, map_poses=local, world=world)
    assert not check(format_pose_file(poses), recentred).findings
    forgotten = {name: world.pose_in_local(pose) for name, pose in poses.items()}
    error = only(check(format_pose_file(forgotten), recentred))
    assert error.kind == "far" and "different frame or scale" in error.message


def test_single_poses_that_are_far(check: Check) -> None:
    reference, poses = made(street)
    lines = format_pose_file(poses).splitlines(keepends=True)
    lines[5] = "q/005.jpg 1 0 0 0 1e9 0 0\n"
    warning = only(check(lines, reference))
    assert (warning.severity, warning.kind, warning.names) == ("warning", "far", ("q/005.jpg",))


GOOD = "a.jpg 0.6 0.8 0 0 1.5 -0.2 3\n"


@pytest.mark.parametrize(
    ("line", "kind", "words"),
    [
        ("b.jpg 1 0 0 0 1.5 -0.2", "columns", "7 columns instead of 8 (name qw qx qy qz tx ty tz)"),
        ("b.jpg, 0.6, 0.8, 0, 0, 1.5, -0.2", "columns", "separated by spaces, not commas"),
        ("# name qw qx qy qz tx ty tz", "comment", "no header"),
        ("b.jpg 0 0 0 0 1 -0.2 3", "pose", "b.jpg: rotation is not a unit quaternion (length 0)"),
        ("b.jpg 10 20 30 0.6 0.8 0 0", "pose", "the columns are name qw qx qy qz tx ty tz"),
        ("a.jpg 1 0 0 0 1 -0.2 3", "duplicate", "given twice, first on line 1"),
        ("b.jpg nan nan nan nan nan nan nan", "pose", "b.jpg: the pose is not finite"),
    ],
)
def test_wrong_rows(check: Check, line: str, kind: str, words: str) -> None:
    report = check([GOOD, "\n", f"{line}\n"])
    result = report.findings[0]
    assert (result.severity, result.kind, result.line) == ("error", kind, 3)
    assert words in result.message and report.poses == 1


ROBOTCAR = {f"rear/{i}.jpg": f"dawn/rear/{i}.jpg" for i in range(100, 106)}
AACHEN = {f"IMG_{i}.jpg": f"query/day/IMG_{i}.jpg" for i in range(5)}


def named(
    check: Check, names: Sequence[str], expected: Mapping[str, str], dataset: str = "aachen"
) -> list[Finding]:
    sides = {q.replace("/rear/", f"/{s}/") for q in expected.values() for s in ("left", "rear")}
    reference = Reference(folder="import", expected=expected, queries=frozenset(sides))
    report = check([f"{name} 1 0 0 0 0 0 0\n" for name in names], reference, dataset)
    return [finding for finding in report.findings if finding.kind != "not-checked"]


@pytest.mark.parametrize(
    ("change", "expected", "words"),
    [
        (lambda name: name.removeprefix("rear/"), ROBOTCAR, "100.jpg should be rear/100.jpg; "),
        (lambda name: AACHEN[name], AACHEN, "query/day/IMG_0.jpg should be IMG_0.jpg"),
        (lambda name: f"./{name}", AACHEN, "./IMG_0.jpg should be IMG_0.jpg"),
        (lambda name: name.replace(".jpg", ".JPG"), AACHEN, "IMG_0.JPG should be IMG_0.jpg"),
    ],
)
def test_names_with_one_systematic_error(
    check: Check, change: Callable[[str], str], expected: Mapping[str, str], words: str
) -> None:
    (finding,) = named(check, list(map(change, expected)), expected)
    assert (finding.severity, finding.kind) == ("error", "name") and words in finding.message


def test_endings_and_cameras_of_robotcar(check: Check) -> None:
    names = [name.replace(".jpg", ".png") for name in ROBOTCAR]
    (finding,) = named(check, names, ROBOTCAR, "robotcar")
    assert finding.severity == "warning" and "accepts either" in finding.message
    names = [*ROBOTCAR, *(name.replace("rear", "left") for name in ROBOTCAR)]
    (finding,) = named(check, names, ROBOTCAR, "robotcar")
    assert (finding.severity, finding.kind, len(finding.names)) == ("note", "not-scored", 6)


def test_names_are_checked_without_a_dataset(tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    for name, dataset in (
        ("1.jpg", "robotcar"),
        ("dawn/rear/1.jpg", "robotcar"),
        ("day/1.jpg", "aachen"),
    ):
        file.write_text(f"rear/2.jpg 1 0 0 0 0 0 0\n{name} 1 0 0 0 0 0 0\n")
        finding = check_submission(file, dataset=dataset).findings[0]
        assert (finding.severity, finding.kind) == ("error", "name") and name in finding.names


def test_unknown_missing_and_double_names(check: Check) -> None:
    names = ["IMG_0.jpg", "else.jpg", "IMG_1.jpg", "query/day/IMG_1.jpg"]
    result = {finding.kind: finding for finding in named(check, names, AACHEN)}
    assert result.keys() == {"unknown", "name", "duplicate", "missing"}
    assert (result["unknown"].line, result["unknown"].names) == (2, ("else.jpg",))
    assert result["duplicate"].line == 4 and "(line 3)" in result["duplicate"].message
    missing = result["missing"]
    assert missing.severity == "warning" and missing.message.startswith("3 queries of 5 without")
    assert missing.names == ("IMG_2.jpg", "IMG_3.jpg", "IMG_4.jpg")


def drive() -> tuple[Reference, dict[tuple[int, int], RigidTransform]]:
    """A road that is driven twice; the second time in the other lane, with true relative poses."""
    rng = np.random.default_rng(0)
    along = np.arange(0, 300, 3.0)
    path = np.stack([120 * np.sin(along / 120), 120 * (1 - np.cos(along / 120)), 0 * along], axis=1)
    side = 2.0 * np.stack([np.sin(along / 120), -np.cos(along / 120), 0 * along], axis=1)
    first = list(looking(path, along / 120, 0 * along, "").values())
    second = list(looking(path + side, along / 120, 0 * along, "").values())
    references = [f"ref/{1000 + i}.png" for i in range(len(along))]
    pairs, poses = [], {}
    for i in range(2, len(along) - 2):
        j = i + int(rng.integers(-2, 3))
        pairs.append(RelocalizationPair("a_to_b.txt", references[j], f"q/{5000 + i}.png"))
        poses[1000 + j, 5000 + i] = second[i] @ first[j].inverse()
    protocol = Protocol(dataset="4seasons", pose_file="mlad")
    map_poses = dict(zip(references, first, strict=True))
    return Reference(
        folder="import", protocol=protocol, relocalization=pairs, map_poses=map_poses
    ), poses


def test_mlad_files(check: Check) -> None:
    reference, poses = drive()
    lines = format_mlad_file(poses).splitlines(keepends=True)

    def result(lines: Sequence[str], name: str = "a_to_b.txt") -> list[tuple[str, str]]:
        return kinds(check(lines, reference, "4seasons", name))

    assert result(lines) == []
    assert result(lines, "mine.txt") == [("error", "file-name")]
    assert result(lines[1:]) == [("error", "missing")]
    assert result([*lines, "1 2 3 0 0 0 0 0 1\n"]) == [("error", "unknown")]
    swapped = [" ".join([b, a, rest]) for a, b, rest in (line.split(" ", 2) for line in lines)]
    assert result(swapped) == [("error", "swapped")]
    assert ("error", "pose") in result(["x 205 1.5 -0.2 3 0 0 0 1\n"])
    dummies = [f"{a} {b} 0 0 0 0 0 0 1\n" for a, b in poses]
    assert result([*dummies[:4], *lines[4:]]) == [("note", "dummies")]
    assert result(dummies)[-1] == ("note", "too-few")


def test_a_folder_of_mlad_files(tmp_path: Path) -> None:
    reference, poses = drive()
    second = [replace(pair, file="second.txt") for pair in reference.relocalization[50:]]
    both = replace(reference, relocalization=(*reference.relocalization[:50], *second))
    folder = tmp_path / "submission"
    folder.mkdir()

    def with_file(name: str, lines: Sequence[str]) -> CheckReport:
        (folder / name).write_text("".join(lines))
        return check_submission(folder, dataset="4seasons", reference=both)

    lines = format_mlad_file(poses).splitlines(keepends=True)
    assert kinds(with_file("a_to_b.txt", lines[:50])) == [("error", "missing-file")]
    report = with_file("second.txt", lines[50:])
    assert not report.findings and report.poses == len(lines)
    assert kinds(with_file("third.txt", lines[:1])) == [("error", "file-name")]
    with pytest.raises(DataError, match="no pose file"):
        (tmp_path / "empty").mkdir()
        check_submission(tmp_path / "empty", dataset="4seasons")
