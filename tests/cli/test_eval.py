"""``megloc eval``: the workspace, repeated, partial and killed runs, failed queries."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aachen_files import write_v1_0

from megloc_kapture.io.dataset_tables import read_side_tables
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import KaptureFolder, read_pairs, write_sensors
from megloc_kapture.io.tables import read_status
from tests.worlds import folder_bytes

STAGES = (
    *("import", "local_features", "global_features", "mapping_pairs", "mapping_matches", "map"),
    *("query_pairs", "query_matches", "localization", "submission", "evaluation"),
)
POSES = "submissions/kapture_eval_megloc-classic.txt"


@pytest.fixture
def evaluate(megloc: Any) -> Callable[..., Any]:
    def run(root: Path, workspace: Path, *arguments: str, status: int = 0) -> Any:
        done = megloc(
            *("eval", "kapture", "--root", root, "--workspace", workspace),
            *("--set", "local_features.options.max_keypoints=800", "--executor", "inline"),
            *arguments,
        )
        assert done.status == status, done.err
        return done

    return run


def states(err: str) -> dict[str, str]:
    """Return the last printed state of each stage."""
    printed = dict(line.split(": ", 1) for line in err.splitlines() if ": " in line)
    return {stage: printed[stage] for stage in STAGES if stage in printed}


def ran(err: str) -> list[str]:
    """Return the stages with a printed duration: they were run."""
    return [stage for stage, state in states(err).items() if state.endswith(" s")]


def reasons(err: str) -> dict[str, str]:
    """Return the reason that is printed before a stage runs."""
    printed = re.findall(r"^(\w+), stage \d+ of \d+: (.*)$", err, re.MULTILINE)
    return dict(reversed(printed))


def test_the_workspace_has_the_documented_files(finished: Path, scene: Path) -> None:
    for place in (
        *("mapping", "query", "query_gt", "megloc/protocol.json", "map", "localized"),
        *("local_features/rootsift/keypoints/keypoints.txt", "pairs/mapping.txt"),
        *("local_features/rootsift/descriptors/descriptors.txt", "pairs/query.txt"),
        "global_features/vlad_rootsift/global_features/global_features.txt",
        "matches/mapping/local_features/rootsift/matches",
        "matches/query/local_features/rootsift/matches",
        *("map/reconstruction/points3d.txt", "map/reconstruction/observations.txt"),
        *("localized/sensors/trajectories.txt", "localized/status.csv", "timing.csv"),
        *(POSES, POSES + ".json"),
        *("evaluation/recall.json", "evaluation/recall.txt", "evaluation/report.html"),
        *(f"stages/{stage}.json" for stage in STAGES),
    ):
        assert (finished / place).exists(), place
    assert list((finished / ".partial").iterdir()) == []
    # images are links to the dataset
    for part in ("mapping", "query"):
        link = finished / part / "sensors" / "records_data"
        assert link.readlink() == scene.resolve() / part / "sensors" / "records_data"
    assert [p for p in finished.rglob("*.jpg") if not p.is_symlink() and p.is_file()] == []


def test_the_second_run_does_nothing_and_prints_the_result(
    evaluate: Any, scene: Path, workspace: Path
) -> None:
    before = folder_bytes(workspace)
    times = {path: path.stat().st_mtime_ns for path in workspace.rglob("*") if path.is_file()}
    done = evaluate(scene, workspace)
    assert states(done.err) == dict.fromkeys(STAGES, "up to date")
    assert "nothing to do: every stage is up to date" in done.err
    assert "pose file" in done.out and "100.0" in done.out
    assert folder_bytes(workspace) == before
    assert {path: path.stat().st_mtime_ns for path in times} == times


def test_a_changed_option_repeats_later_stages_and_keeps_the_earlier_pose_file(
    evaluate: Any, scene: Path, workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    until = ("--until", "submission", "--submissions", "kept")
    copy = Path("kept") / Path(POSES).name
    assert evaluate(scene, workspace, *until).out == f"pose file  {copy}\n"
    first = copy.read_bytes()
    assert first == (workspace / POSES).read_bytes()
    assert Path(f"{copy}.json").read_bytes() == (workspace / f"{POSES}.json").read_bytes()
    done = evaluate(scene, workspace, *until, "--set", "localization.pose.max_error_px=6")
    assert ran(done.err) == ["localization", "submission"]
    assert reasons(done.err)["localization"] == "options changed: localization.pose.max_error_px"
    assert reasons(done.err)["submission"] == "localization changed"
    assert f"{copy} belongs to another result and is kept" in done.err
    assert f"pose file  {str(copy).replace('.txt', '-2.txt')}\n" in done.out
    assert copy.read_bytes() == first


def test_changed_thresholds_repeat_neither_the_map_nor_the_localization(
    evaluate: Any, scene: Path, workspace: Path
) -> None:
    done = evaluate(scene, workspace, "--thresholds", "0.001,1", "0.5,5", "--until", "submission")
    assert ran(done.err) == ["import", "submission"]
    assert reasons(done.err)["import"] == "options changed: protocol.thresholds"
    protocol = read_side_tables(workspace / "megloc").protocol
    assert (protocol.dataset, protocol.thresholds) == ("kapture", ((0.001, 1.0), (0.5, 5.0)))


def test_a_moved_dataset_repeats_the_import_and_a_changed_image_the_features(
    evaluate: Any, dataset: Path, tmp_path: Path
) -> None:
    until = ("--until", "local_features")
    evaluate(dataset, tmp_path / "run", *until)
    moved = dataset.rename(dataset.with_name("moved"))
    assert ran(evaluate(moved, tmp_path / "run", *until).err) == ["import"]
    with open(moved / "mapping/sensors/records_data/0005.jpg", "ab") as file:
        file.write(b"\0")
    done = evaluate(moved, tmp_path / "run", *until)
    assert ran(done.err) == ["import", "local_features"]
    assert reasons(done.err)["import"] == "dataset files changed"


def test_options_are_checked_before_the_run(megloc: Any, tmp_path: Path) -> None:
    command = ("eval", "aachen", "--root", write_v1_0(tmp_path / "root"), "-w", tmp_path / "run")
    done = megloc(*command, "--import-option", "version=1.1", "--dry-run")
    assert done.status == 2 and "the model of Aachen Day-Night v1.1 is missing" in done.err
    done = megloc(*command, "--import-option", "version")
    assert done.status == 2 and "--import-option takes key=value" in done.err
    done = megloc(*command, "--dry-run", "--submissions", __file__)
    assert done.status == 2 and "test_eval.py is a file; give a folder" in done.err


def test_from_uses_files_of_another_tool_as_they_are(
    evaluate: Any, scene: Path, workspace: Path
) -> None:
    pairs = read_pairs(workspace / "pairs" / "query.txt")
    nearest = {pair.query: pair.map for pair in reversed(pairs)}
    rows = [f"{query}, {image}, 1.0\n" for query, image in sorted(nearest.items())]
    (workspace / "pairs" / "query.txt").write_text("".join(rows))
    again = ("--from", "query_matches", "--until", "localization")
    done = evaluate(scene, workspace, *again, "--set", "query_pairs.top_k=1")
    assert ran(done.err) == list(STAGES[7:9])
    used = states(done.err)
    assert set(map(used.get, STAGES[:6])) == {"used as is"}
    assert used["query_pairs"] == "used as is (options changed: query_pairs.top_k)"
    statuses = read_status(workspace / "localized" / "status.csv")
    candidates = {query: (image,) for query, image in nearest.items()}
    assert {query: status.candidates for query, status in statuses.items()} == candidates


def add_query(dataset: Path, name: str) -> None:
    """Add a query that shows noise, listed as an image of another location."""
    data = KaptureFolder(dataset / "query").read()
    time, sensor = data.record_of(data.image_names()[-1])
    data.records_camera[time + 1000, sensor] = name
    write_sensors(dataset / "query", data)
    coarse = np.random.default_rng(0).integers(0, 255, (38, 50, 3), dtype=np.uint8)
    noise = np.kron(coarse, np.ones((8, 8, 1), np.uint8))[:300, :400]
    write_image(dataset / "query/sensors/records_data" / name, noise)
    (dataset / "query_gt" / "nowhere.txt").write_text(f"{name}\n")


def test_failed_queries_are_misses_and_a_rejected_stranger_is_correct(
    evaluate: Any, dataset: Path, finished: Path
) -> None:
    images = dataset / "query/sensors/records_data"
    (images / "0004.jpg").write_bytes((images / "0004.jpg").read_bytes()[:20_000])
    write_image(images / "0007.jpg", np.zeros((100, 200, 3), np.uint8))
    (images / "0010.jpg").unlink()
    add_query(dataset, "stranger.png")
    run = dataset.parent / "run"
    done = evaluate(dataset, run, "--fail-below", "0.3", status=3)
    assert "recall 0.250 is below 0.300" in done.err
    assert evaluate(dataset, run, "--fail-below", "0.25").status == 0
    statuses = read_status(run / "localized" / "status.csv")
    failed = {name: s.reason for name, s in statuses.items() if s.status == "failed"}
    assert set(failed) == {"0004.jpg", "0007.jpg", "0010.jpg", "stranger.png"}
    assert failed["0007.jpg"].startswith("the image cannot be used: ")
    assert "200x100, its camera says 400x300" in failed["0007.jpg"]
    text = " ".join((run / "evaluation" / "recall.txt").read_text().split())
    assert "1 query shows nothing of the map: 1 not localized, 0 localized wrongly" in text
    # the localized query has the same pose as without the failed ones
    expected = (finished / POSES).read_text().splitlines(keepends=True)
    assert (run / POSES).read_text() == "".join(r for r in expected if "0001" in r)


def test_inverted_poses_are_refused_unless_forced(
    evaluate: Any, dataset: Path, tmp_path: Path
) -> None:
    folder = KaptureFolder(dataset / "mapping")
    data = folder.read()
    inverted = {key: pose.inverse() for key, pose in data.trajectories.items()}
    write_sensors(folder.root, replace(data, trajectories=inverted))
    done = evaluate(dataset, tmp_path / "ws", status=2)
    assert "with poses inverted (camera-to-world, world_from_cam), " in done.err
    done = evaluate(dataset, tmp_path / "ws", "--force", "--until", "mapping_matches")
    assert "up to date" in done.err and "mapping_matches: " in done.err


# files with seconds and dates
DATED = ("stages/", "timing.csv", "evaluation/report.html")
LAST_FILES = {"local_features": ".desc", "global_features": ".gfeat", "mapping_matches": ".matches"}


@pytest.fixture
def temporary(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The temporary folder of all runs of a test; paths of sockets may have 100 characters."""
    with tempfile.TemporaryDirectory() as folder:
        monkeypatch.setenv("TMPDIR", folder)
        yield Path(folder)


def start(scene: Path, workspace: Path, *more: str) -> subprocess.Popen[str]:
    program = str(Path(sys.executable).with_name("megloc"))
    places = ["--root", str(scene), "--workspace", str(workspace)]
    few = ["--set", "local_features.options.max_keypoints=800", "--workers", "2"]
    return subprocess.Popen(
        [program, "eval", "kapture", *places, *few, *more],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a background job inherits from its shell that SIGINT is ignored
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )


def finish(scene: Path, workspace: Path, *more: str) -> None:
    run = start(scene, workspace, *more)
    _, err = run.communicate()
    assert run.returncode == 0, err


def temporary_files(workspace: Path) -> list[Path]:
    """Temporary files and unfinished folders, except folders with finished items."""
    hidden = [path for path in workspace.rglob(".*") if path.name.startswith(".megloc-")]
    folders = workspace.glob(".partial/*")
    return [*hidden, *(path for path in folders if not (path / ".fingerprint").is_file())]


def finished_items(workspace: Path, stage: str) -> dict[Path, int]:
    """Times of the last file of each item, by path in the unfinished folder."""
    place = workspace / ".partial" / stage
    files = [path for path in place.rglob(f"*{LAST_FILES[stage]}") if path.name[0] != "."]
    return {path.relative_to(place): path.stat().st_mtime_ns for path in files}


def processes_of(session: int) -> list[int]:
    """Ids of the running processes of a session, without zombies."""
    ids = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            state, _, _, of_session = (place / "stat").read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(of_session) == session and state != "Z":
            ids.append(int(place.name))
    return ids


def kill_parent(run: subprocess.Popen[str]) -> None:
    """Kill a run but none of its workers, which must end with it."""
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    patience = time.monotonic() + 30
    while left := processes_of(run.pid):
        assert time.monotonic() < patience, f"still running: {left}"
        time.sleep(0.05)
    run.communicate()


@pytest.mark.usefixtures("temporary")
def test_ctrl_c_says_how_to_continue_and_keeps_finished_items(scene: Path, tmp_path: Path) -> None:
    workspace = tmp_path / "run"
    run = start(scene, workspace)
    while not finished_items(workspace, "local_features"):
        time.sleep(0.01)
        assert run.poll() is None
    # a terminal sends the signal to every process of the group
    os.killpg(run.pid, signal.SIGINT)
    assert run.stderr is not None
    message = "megloc: interrupted; run the same command again to resume"
    assert message in run.stderr.read().splitlines()
    assert run.wait() == 130
    assert not (workspace / "local_features").exists()
    assert finished_items(workspace, "local_features")
    assert temporary_files(workspace) == []


@pytest.mark.slow
@pytest.mark.usefixtures("temporary")
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_a_killed_run_keeps_its_finished_items(scene: Path, finished: Path, tmp_path: Path) -> None:
    workspace = tmp_path / "run"
    for stage in LAST_FILES:
        run = start(scene, workspace)
        while len(finished_items(workspace, stage)) < 2 and run.poll() is None:
            time.sleep(0.001)
        kill_parent(run)
        done = finished_items(workspace, stage)
        # on a busy machine the stage may already be over
        assert len(done) >= 2 or (workspace / "stages" / f"{stage}.json").is_file()
        finish(scene, workspace, "--until", stage)
        assert {name: (workspace / name).stat().st_mtime_ns for name in done} == done
    finish(scene, workspace)
    assert temporary_files(workspace) == [] and not any(workspace.glob(".partial/*"))
    actual, expected = (
        {name: data for name, data in folder_bytes(root).items() if not name.startswith(DATED)}
        for root in (workspace, finished)
    )
    assert actual == expected
