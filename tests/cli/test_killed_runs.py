"""Runs that are killed: the next one goes on, and ends as if nothing had happened."""

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

Contents = Callable[[Path], dict[str, bytes]]

# these hold seconds and dates
DATED = ("stages/", "timing.csv", "evaluation/report.html")
ON = "run the same command again to go on"


def left_behind(workspace: Path) -> list[Path]:
    """Temporary files and unfinished folders of a workspace, except folders with finished items."""
    hidden = [path for path in workspace.rglob(".*") if path.name.startswith(".megloc-")]
    return [
        *hidden,
        *(p for p in workspace.glob(".partial/*") if not (p / ".fingerprint").is_file()),
    ]


@pytest.fixture(autouse=True)
def temporary(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The temporary folder of all runs of a test; sockets' paths may have 100 characters."""
    with tempfile.TemporaryDirectory() as folder:
        monkeypatch.setenv("TMPDIR", folder)
        yield Path(folder)


def start(scene: Path, workspace: Path, *more: str) -> subprocess.Popen[str]:
    """Start a run with two worker processes in a session of its own."""
    program = str(Path(sys.executable).with_name("megloc"))
    places = ["--root", str(scene), "--workspace", str(workspace)]
    few = ["--set", "local_features.options.max_keypoints=800", "--workers", "2"]
    return subprocess.Popen(
        [program, "eval", "kapture", *places, *few, *more],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a shell ignores SIGINT for what it starts in the background, and that is inherited
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )


def finish(scene: Path, workspace: Path) -> None:
    """Run to the end."""
    run = start(scene, workspace)
    _, told = run.communicate()
    assert run.returncode == 0, told


def wait_for(run: subprocess.Popen[str], *texts: str) -> str:
    """Read what a run tells until a line has one of the texts in it, and return that."""
    assert run.stderr is not None
    told = []
    for line in run.stderr:
        told.append(line)
        for text in texts:
            if text in line:
                return text
    pytest.fail(f"the run ended before {texts}: {''.join(told)}")


def processes_of(session: int) -> list[int]:
    """Ids of the running processes of a session, zombies left out."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            state, _, _, of_session = (place / "stat").read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(of_session) == session and state != "Z":
            found.append(int(place.name))
    return found


def kill_alone(run: subprocess.Popen[str]) -> None:
    """Kill a run, none of its workers: they end with it."""
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    patience = time.monotonic() + 30
    while left := processes_of(run.pid):
        assert time.monotonic() < patience, f"left behind: {left}"
        time.sleep(0.05)
    run.communicate()


LAST_FILES = {"local_features": ".desc", "global_features": ".gfeat", "mapping_matches": ".matches"}


def written(workspace: Path, stage: str) -> dict[Path, int]:
    """Times of the files that finish an item, by path in the unfinished folder."""
    place = workspace / ".partial" / stage
    files = [path for path in place.rglob(f"*{LAST_FILES[stage]}") if path.name[0] != "."]
    return {path.relative_to(place): path.stat().st_mtime_ns for path in files}


def test_ctrl_c_says_how_to_go_on(scene: Path, tmp_path: Path) -> None:
    run = start(scene, tmp_path / "run")
    while not written(tmp_path / "run", "local_features"):
        time.sleep(0.01)
        assert run.poll() is None
    # a terminal sends it to every process of the group
    os.killpg(run.pid, signal.SIGINT)
    assert run.stderr is not None
    assert f"megloc: interrupted; {ON}" in run.stderr.read().splitlines()
    assert run.wait() == 130
    assert not (tmp_path / "run" / "local_features").exists()
    assert written(tmp_path / "run", "local_features")
    assert left_behind(tmp_path / "run") == []


def test_sigterm_says_how_to_go_on(scene: Path, tmp_path: Path) -> None:
    run = start(scene, tmp_path / "run")
    wait_for(run, "local_features, stage")
    os.kill(run.pid, signal.SIGTERM)
    assert run.stderr is not None
    assert f"megloc: terminated; {ON}" in run.stderr.read().splitlines()
    assert run.wait() == 143
    assert left_behind(tmp_path / "run") == []


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_a_killed_run_keeps_its_finished_items(
    scene: Path, finished: Path, tmp_path: Path, contents: Contents
) -> None:
    workspace = tmp_path / "run"
    for stage in LAST_FILES:
        run = start(scene, workspace)
        while len(written(workspace, stage)) < 2 and run.poll() is None:
            time.sleep(0.001)
        kill_alone(run)
        done = written(workspace, stage)
        # on a busy machine the stage may be over before it is looked at
        assert len(done) >= 2 or (workspace / "stages" / f"{stage}.json").is_file()
        run = start(scene, workspace, "--until", stage)
        _, told = run.communicate()
        assert run.returncode == 0, told
        assert {name: (workspace / name).stat().st_mtime_ns for name in done} == done
    finish(scene, workspace)
    assert left_behind(workspace) == [] and not any(workspace.glob(".partial/*"))
    assert undated(contents(workspace)) == undated(contents(finished))


def undated(found: dict[str, bytes]) -> dict[str, bytes]:
    return {name: content for name, content in found.items() if not name.startswith(DATED)}
