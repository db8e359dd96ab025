"""Runs that are killed: the next one goes on, and ends as if nothing had happened."""

from __future__ import annotations

import os
import random
import re
import shutil
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

# the dates of these tell nothing about poses
DATED = ("stages/", "timing.csv")
ON = "run the same command again to go on"


def left_behind(workspace: Path, *pids: int) -> list[Path]:
    """What runs have left: temporary files in the workspace and elsewhere, semaphores.

    Items that are done stay, for the next run.
    """
    temporary = list(Path(os.environ["TMPDIR"]).iterdir())
    hidden = [path for path in workspace.rglob(".*") if path.name.startswith(".megloc-")]
    staged = [p for p in workspace.glob(".partial/*") if not (p / ".items").is_file()]
    named = [Path("/dev/shm").glob(f"sem.megloc-*.{pid}-*") for pid in pids]
    return [*temporary, *hidden, *staged, *(path for found in named for path in found)]


def wait_until_it_hears(run: subprocess.Popen[str]) -> None:
    """Wait for its handler of SIGTERM: what the interpreter does before is not ours."""
    caught = 0
    while not caught & 1 << (signal.SIGTERM - 1):
        assert run.poll() is None
        time.sleep(0.001)
        lines = Path(f"/proc/{run.pid}/status").read_text().splitlines()
        caught = next(int(line.split()[1], 16) for line in lines if line.startswith("SigCgt"))


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


def finish(scene: Path, workspace: Path) -> tuple[subprocess.Popen[str], str]:
    """A run that nobody kills, and what it told."""
    run = start(scene, workspace)
    _, told = run.communicate()
    assert run.returncode == 0, told
    return run, told


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


def test_a_run_ended_at_the_keyboard_says_how_to_go_on(scene: Path, tmp_path: Path) -> None:
    run = start(scene, tmp_path / "run")
    wait_for(run, "local_features, stage 2 of 12: starting")
    while not num_lines(tmp_path / "run" / ".partial" / "local_features" / ".items"):
        time.sleep(0.01)
        assert run.poll() is None
    # a terminal sends it to every process of the group
    os.killpg(run.pid, signal.SIGINT)
    assert run.stderr is not None
    told = run.stderr.read().splitlines()
    assert "megloc: interrupted; run the same command again to go on" in told
    assert run.wait() == 130
    assert not (tmp_path / "run" / "local_features").exists()
    assert num_lines(tmp_path / "run" / ".partial" / "local_features" / ".items") > 0
    assert left_behind(tmp_path / "run", run.pid) == []


@pytest.mark.parametrize(
    ("stage", "group"),
    [
        ("localization", True),
        ("localization", False),
        *(
            pytest.param(stage, group, marks=pytest.mark.slow)
            for stage in ("local_features", "mapping_matches")
            for group in (True, False)
        ),
    ],
)
def test_a_run_that_is_asked_to_end_does(
    scene: Path, finished: Path, tmp_path: Path, stage: str, group: bool
) -> None:
    """Asked as a process, or with all of its group."""
    workspace, more = tmp_path / "run", ()
    if stage == "localization":  # it alone runs again
        shutil.copytree(finished, workspace, symlinks=True)
        more = ("--set", "localization.pose.max_error_px=6")
    run = start(scene, workspace, *more)
    wait_for(run, f"{stage}: ")
    (os.killpg if group else os.kill)(run.pid, signal.SIGTERM)
    assert run.stderr is not None
    assert run.stderr.read().splitlines()[-1] == f"megloc: terminated; {ON}"
    assert run.wait() == 143
    assert left_behind(workspace, run.pid) == []


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize(
    "after_s", [0.0, 0.3, 1.0, *(pytest.param(s, marks=pytest.mark.slow) for s in (0.1, 0.6, 1.5))]
)
def test_ctrl_c_twice_ends_a_run_in_one_line_from_its_first_moment_on(
    scene: Path, tmp_path: Path, after_s: float
) -> None:
    run = start(scene, tmp_path / "run")
    wait_until_it_hears(run)
    time.sleep(after_s)
    os.killpg(run.pid, signal.SIGINT)
    time.sleep(0.02)
    os.killpg(run.pid, signal.SIGINT)
    _, told = run.communicate(timeout=60)  # it hung for ever
    assert run.returncode == 130
    assert told.splitlines()[-1] == f"megloc: interrupted; {ON}"
    assert "Traceback" not in told
    assert "resource_tracker" not in told
    assert left_behind(tmp_path / "run", run.pid) == []


def kill_in_two_stages(scene: Path, workspace: Path, counts: list[int]) -> list[int]:
    """Kill runs once they have done so many items, of one stage and then of another; their ids."""
    pids = []
    for kind in ("local_features", "mapping_matches"):
        journal = workspace / ".partial" / kind / ".items"
        for count in counts:
            # items that are there before any worker tell of none
            first = num_lines(journal) == 0
            run = start(scene, workspace)
            begun = wait_for(run, f"{kind}, stage", f"{kind}: up to date").endswith("stage")
            while begun and num_lines(journal) < count and run.poll() is None:
                time.sleep(0.002)
            if kind == "local_features":
                if first and begun and run.poll() is None:
                    assert len(processes_of(run.pid)) >= 4  # the run, two helpers, a worker
                kill_alone(run)
            else:
                os.killpg(run.pid, signal.SIGKILL)
                run.communicate()
            pids.append(run.pid)
    return pids


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize(
    "counts",
    [[3], pytest.param([1, 2, 3, 4, 5, 6], marks=pytest.mark.slow)],
    ids=["2 kills", "12 kills"],
)
def test_items_that_are_done_when_a_run_is_killed_are_not_done_again(
    scene: Path, finished: Path, tmp_path: Path, contents: Contents, counts: list[int]
) -> None:
    pids: list[int] = []
    # on a busy machine the stage may be over before it is looked at
    for attempt in range(5):
        workspace = tmp_path / f"run{attempt}"
        pids += kill_in_two_stages(scene, workspace, counts)
        if 0 < num_lines(workspace / ".partial" / "mapping_matches" / ".items") < 21:
            break
    last, told = finish(scene, workspace)
    kept = [int(n) for n in re.findall(r"mapping_matches: .* ([0-9]+) of 21 kept", told)]
    assert len(kept) == 1 and kept[0] >= max(counts)
    assert left_behind(workspace, last.pid, *pids) == [] and not any(workspace.glob(".partial/*"))
    assert undated(contents(workspace)) == undated(contents(finished))


def num_lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.is_file() else 0


def undated(found: dict[str, bytes]) -> dict[str, bytes]:
    return {name: content for name, content in found.items() if not name.startswith(DATED)}


@pytest.mark.slow
def test_runs_killed_at_random_moments_end_in_the_same_bytes(
    scene: Path, finished: Path, tmp_path: Path, contents: Contents
) -> None:
    # seeded: which stages, and how long after they have begun
    draw = random.Random(20)
    stages = [path.stem for path in finished.glob("stages/[a-z]*.json")]
    order = {stage: (finished / "stages" / f"{stage}.json").stat().st_mtime_ns for stage in stages}
    unlucky = sorted(draw.sample(sorted(stages), 6), key=order.__getitem__)
    workspace = tmp_path / "run"
    ends, pids = [], []
    for stage in unlucky:
        run = start(scene, workspace)
        wait_for(run, f"{stage}: ")
        time.sleep(draw.uniform(0.0, 0.05))
        os.killpg(run.pid, signal.SIGKILL)
        ends.append(run.wait())
        pids.append(run.pid)
    # the last stage may have been faster
    assert ends.count(-signal.SIGKILL) >= len(unlucky) - 1
    last, _ = finish(scene, workspace)
    assert left_behind(workspace, last.pid, *pids) == []
    found = undated(contents(workspace))
    assert found == undated(contents(finished))
    assert any(name.startswith("submissions/") for name in found)
