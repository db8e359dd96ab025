"""Runs that are killed: the next one goes on, and ends as if nothing had happened."""

from __future__ import annotations

import os
import re
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
    return [*hidden, *(p for p in workspace.glob(".partial/*") if not (p / ".items").is_file())]


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


def num_lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.is_file() else 0


def test_ctrl_c_says_how_to_go_on(scene: Path, tmp_path: Path) -> None:
    run = start(scene, tmp_path / "run")
    items = tmp_path / "run" / ".partial" / "local_features" / ".items"
    while not num_lines(items):
        time.sleep(0.01)
        assert run.poll() is None
    # a terminal sends it to every process of the group
    os.killpg(run.pid, signal.SIGINT)
    assert run.stderr is not None
    assert f"megloc: interrupted; {ON}" in run.stderr.read().splitlines()
    assert run.wait() == 130
    assert not (tmp_path / "run" / "local_features").exists()
    assert num_lines(items) > 0
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
    for stage in ("local_features", "global_features", "mapping_matches"):
        run = start(scene, workspace)
        items = workspace / ".partial" / stage / ".items"
        while num_lines(items) < 3 and run.poll() is None:
            time.sleep(0.001)
        kill_alone(run)
        done = num_lines(items) - 1  # the first line is the fingerprint
        # on a busy machine the stage may be over before it is looked at
        assert done >= 2 or (workspace / "stages" / f"{stage}.json").is_file()
        run = start(scene, workspace, "--until", stage)
        _, told = run.communicate()
        assert run.returncode == 0, told
        kept = [int(number) for number in re.findall(rf"{stage}: .*?([0-9]+) items kept", told)]
        assert kept == ([done] if done > 0 else []), told
    finish(scene, workspace)
    assert left_behind(workspace) == [] and not any(workspace.glob(".partial/*"))
    assert undated(contents(workspace)) == undated(contents(finished))


def undated(found: dict[str, bytes]) -> dict[str, bytes]:
    return {name: content for name, content in found.items() if not name.startswith(DATED)}
