"""Interrupted and killed runs: the next run continues, and the result is the same."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

# files with seconds and dates
DATED = ("stages/", "timing.csv", "evaluation/report.html")
LAST_FILES = {"local_features": ".desc", "global_features": ".gfeat", "mapping_matches": ".matches"}


@pytest.fixture(autouse=True)
def temporary(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The temporary folder of all runs of a test; paths of sockets may have 100 characters."""
    with tempfile.TemporaryDirectory() as folder:
        monkeypatch.setenv("TMPDIR", folder)
        yield Path(folder)


def start(scene: Path, workspace: Path, *more: str) -> subprocess.Popen[str]:
    """Start a run with two worker processes in a new session."""
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
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_a_killed_run_keeps_its_finished_items(
    scene: Path, finished: Path, tmp_path: Path, contents: Callable[[Path], dict[str, bytes]]
) -> None:
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
        {name: data for name, data in contents(root).items() if not name.startswith(DATED)}
        for root in (workspace, finished)
    )
    assert actual == expected
