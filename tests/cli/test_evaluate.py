"""``megloc evaluate``, ``submit`` and ``check`` as their users meet them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.evaluation.pose_files import write_pose_file
from megloc_kapture.evaluation.protocols import protocol_of
from megloc_kapture.io.dataset_tables import (
    ImageGroup,
    Protocol,
    RelocalizationPair,
    write_groups,
    write_protocol,
    write_relocalization,
)
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.io.tables import write_status
from megloc_kapture.values import Camera, LocalizationResult, RigidTransform

NUM_QUERIES = 40
IMAGES = [f"query/{'night' if i % 4 == 0 else 'day'}/{i:03d}.jpg" for i in range(NUM_QUERIES)]
MAPPED = {
    f"map/{i}.jpg": RigidTransform((1.0, 0.0, 0.0, 0.0), (-4.0 * i, 0.0, 0.0)) for i in range(20)
}


def write_kapture(root: Path, images: list[str], poses: dict[str, RigidTransform]) -> Path:
    camera = Sensor.from_camera(Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0)))
    records = {(number, "cam"): image for number, image in enumerate(images)}
    posed = {key: poses[image] for key, image in records.items() if image in poses}
    write_sensors(root, KaptureData({"cam": camera}, {}, posed, records))
    return root


def write_candidates(result: Path, number: int) -> None:
    """The best candidate of every query: that of its place, or of the ``number`` first of them."""
    rows = [
        LocalizationResult(
            name=image,
            num_matches=99,
            num_inliers=50,
            candidates=(f"map/{min(i // 2, number - 1)}.jpg",),
        )
        for i, image in enumerate(IMAGES)
    ]
    write_status(result / "status.csv", rows)


def poses_off(by_m: float, num_lost: int = 0) -> dict[str, RigidTransform]:
    """Every query 2 m from the next, moved by ``by_m``; the first ``num_lost`` by 50 m."""
    return {
        image: RigidTransform((1.0, 0.0, 0.0, 0.0), (-2.0 * i, 50.0 if i < num_lost else by_m, 0.0))
        for i, image in enumerate(IMAGES)
    }


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """A workspace with truth, and results of three runs in workspaces of their own."""
    for name, by_m, num_lost in (("a", 0.01, 2), ("b", 0.02, 14), ("c", 0.01, 3)):
        workspace = tmp_path / name
        write_kapture(workspace / "query_gt", IMAGES, poses_off(0.0))
        write_kapture(workspace / "mapping", list(MAPPED), MAPPED)
        write_kapture(workspace / "localized", IMAGES, poses_off(by_m, num_lost))
        write_candidates(workspace / "localized", len(MAPPED))
        write_protocol(workspace / "megloc", protocol_of("aachen"))
        groups = {image: ImageGroup(condition=image.split("/")[1]) for image in IMAGES}
        write_groups(workspace / "megloc", groups)
    return tmp_path


def results(runs: Path, *names: str) -> list[str | Path]:
    return ["evaluate", *(word for name in names for word in ("-i", runs / name / "localized"))]


def test_one_result(megloc: Any, runs: Path) -> None:
    out = runs / "out"
    done = megloc(*results(runs, "a"), "--gt", runs / "a/query_gt", "-o", out)
    assert done.status == 0
    assert "95.0 / 95.0 / 95.0" in done.out  # all but the two lost ones
    interval = json.loads((out / "recall.json").read_text())["rows"][-1]["recall"][0]
    assert (interval["low"], interval["high"]) == pytest.approx((0.8308, 0.9939), abs=1e-4)
    files = {"per_query.csv", "recall.json", "recall.txt", "report.html", "view.html"}
    assert {path.name for path in out.iterdir() if path.suffix} == files
    assert "From above" in (out / "report.html").read_text()


def test_two_results_are_compared(megloc: Any, runs: Path) -> None:
    out = runs / "out"
    done = megloc(*results(runs, "a", "b"), "--gt", runs / "a/query_gt", "-o", out)
    assert done.status == 0
    flat = " ".join(done.out.split())
    assert (
        "At 0.25 m, 2 deg a finds 12 queries that b misses and b finds none that a misses: the "
        "difference is real (p = 0.0015)."
    ) in flat  # 2 * 0.5^12, times the three thresholds
    comparison = json.loads((out / "recall.json").read_text())["comparison"]
    assert comparison["tests"][0]["only_first"] == sorted(IMAGES[2:14])
    assert (out / "recall.txt").read_text() == done.out.removesuffix("\n")
    # a pose file may be one of them
    poses = runs / "poses.txt"
    write_pose_file(poses, poses_off(0.01, 2), names="basename")
    done = megloc(*results(runs, "a"), "-i", poses, "--gt", runs / "a/query_gt")
    assert "a/localized and poses.txt find the same 38 queries" in " ".join(done.out.split())


def test_without_truth(megloc: Any, runs: Path) -> None:
    out = runs / "out"
    done = megloc(*results(runs, "a", "b"), "-o", out)
    assert done.status == 0
    assert "No recall: The true poses of the queries are not published" in done.out
    found = json.loads((out / "agreement.json").read_text())
    whole = found["results"][0]["rows"][-1]
    assert whole["num_localized"] == 40 and whole["inliers_quartiles"] == [50.0, 50.0, 50.0]
    # 26 queries are 1 cm apart, 2 are lost in the same way
    agreement = found["agreement"][-1]
    assert agreement["within"][0]["num_within"] == 28
    assert (out / "report.html").is_file() and not (out / "recall.json").exists()
    assert (out / "agreement.txt").read_text() == done.out.removesuffix("\n")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("", "no result given; use -i"),
        ("-i {}/a/localized -i {}/a/../a/localized", "is given twice"),
        ("-i {}/a/localized --dataset cmu", "unknown dataset 'cmu'; known: aachen"),
        ("-i {}/a/localized --map {}/nowhere", "nowhere"),
        ("-i {}/nowhere", "nowhere"),
        ("-i {}/a/localized --gt {}/nowhere", "nowhere"),
        ("-i {}/a/localized --gt {}/a/query_gt --thresholds x", "METRES,DEGREES"),
        ("-i {}/a/localized --gt {}/a/query_gt -o {}/a", "is not empty"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(
    megloc: Any, runs: Path, arguments: str, said: str
) -> None:
    before = sorted(runs.rglob("*"))
    megloc("evaluate", *(word.replace("{}", str(runs)) for word in arguments.split())).refused(said)
    assert sorted(runs.rglob("*")) == before


@pytest.fixture
def imported(scene: Path, tmp_path: Path) -> Path:
    """An imported scene and a result in it: the true poses of all but one query."""
    root = tmp_path / "imported"
    for part in ("mapping", "query"):
        write_sensors(root / part, KaptureFolder(scene / part).read())
    truth = KaptureFolder(scene / "query_gt").read()
    images = truth.image_names()
    truth.trajectories.pop(truth.record_of(images[0]))
    write_sensors(root / "localized", truth)
    failed = {"reason": "no matches"}
    rows = [
        LocalizationResult(name=images[0], **failed),
        LocalizationResult(name=images[1], fallback="retrieval", **failed),
        *(LocalizationResult(name=image) for image in images[2:]),
    ]
    write_status(root / "localized" / "status.csv", rows)
    write_protocol(root / "megloc", Protocol(dataset="aachen", pose_file_names="basename"))
    return root


def test_mlad_goes_to_a_folder(megloc: Any, imported: Path, tmp_path: Path) -> None:
    write_protocol(imported / "megloc", Protocol(dataset="4seasons", pose_file="mlad"))
    for part in ("mapping", "query", "localized"):
        data = KaptureFolder(imported / part).read()
        data.records_camera = {
            key: f"{int(name.removesuffix('.jpg')) + 1}.png"
            for key, name in data.records_camera.items()
        }
        write_sensors(imported / part, data)
    (imported / "localized" / "status.csv").unlink()
    reference, *_ = KaptureFolder(imported / "mapping").read().image_names()
    queries = KaptureFolder(imported / "query").read().image_names()
    pairs = [RelocalizationPair("a_to_b.txt", reference, query) for query in queries]
    write_relocalization(imported / "megloc", pairs)
    place = tmp_path / "submission"
    command = ["submit", "4seasons", "-i", imported / "localized", "-o", place]
    done = megloc(*command)
    assert done.out == f"3 poses of 4 queries, 1 missing, written as dummy poses: {place}\n"
    assert {path.name for path in tmp_path.glob("submission*")} == {place.name, "submission.json"}
    assert [path.name for path in place.iterdir()] == ["a_to_b.txt"]
    tables = ("--side-tables", imported / "megloc")
    megloc("evaluate", "-i", place, *tables).refused("relative to the map's", "--map")
    megloc(*command).refused("exists; -f")
    assert megloc(*command, "-f").status == 0
    (tmp_path / "file").write_text("")
    megloc(*command[:-1], tmp_path / "file").refused("a folder, one file per relocalization file")


Poses = dict[str, RigidTransform]


@pytest.fixture
def poses(scene: Path) -> Poses:
    return KaptureFolder(scene / "query_gt").read().poses()


@pytest.fixture
def place(poses: Poses, tmp_path: Path) -> Path:
    """A right pose file."""
    write_pose_file(tmp_path / "poses.txt", poses)
    return tmp_path / "poses.txt"


@pytest.fixture
def aachen(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The one workspace of dataset aachen below runs/, with the scene's map."""
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "runs" / "aachen-classic"
    for part in ("mapping", "query"):
        write_sensors(root / part, KaptureFolder(scene / part).read())
    write_protocol(root / "megloc", Protocol(dataset="aachen", pose_file_names="basename"))
    return root


def test_a_right_file(megloc: Any, aachen: Path, place: Path) -> None:
    done = megloc("check", "aachen", place)
    assert (done.status, done.out) == (0, "4 poses of 4 queries: no problem found\n")
    assert done.err == "compared with runs/aachen-classic\n"
    assert megloc("check", "aachen", place, "-q").err == ""
    assert megloc("check", "synthetic-aachen", place, "--data", aachen).status == 0


def test_a_wrong_file(megloc: Any, aachen: Path, poses: Poses, place: Path) -> None:
    write_pose_file(place, {name: pose.inverse() for name, pose in poses.items()})
    with place.open("a") as file:
        file.write("stranger.jpg 1 0 0\n0001.png 1 1 0 0 0 0 0\n")
    done = megloc("check", "aachen", place)
    assert (done.status, "compared" in done.err) == (2, True)
    first, *others, outcome = done.out.splitlines()
    assert "0001.png should be 0001.jpg" in others[0]
    assert first.startswith("error: poses.txt: poses inverted (camera-to-world, world_from_cam)")
    assert any("poses.txt:5: 4 columns instead of 8" in line for line in others)
    assert any("stranger.jpg is not in the list" in line for line in others)
    assert "quaternion of length 1.41421, not 1" in done.out
    assert outcome.startswith("4 poses of 4 queries: ") and "problems found" in outcome
    done = megloc("check", "aachen", place, "--json")
    content = json.loads(done.out)
    assert done.status == 2 and content["ok"] is False
    assert content["findings"][0]["kind"] == "convention"
