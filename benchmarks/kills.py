"""Runs on a dask cluster whose workers and scheduler are killed: the same bytes as in one process.

    .venv/bin/python benchmarks/kills.py --scene ../shared/data/scenes/fountain_p11 \\
        --scene ../shared/data/scenes/hololens_room --twin aachen --twin robotcar

Of each scene and twin a small run of the preset ``classic`` in this process comes first. Then on a
cluster over loopback, of 2 and of 4 workers, each run once undisturbed and once while workers get
SIGKILL at ten random moments; and of two workers with the scheduler killed three times, the run
resumed after each. Moments are drawn among the results that a run waits for. A folder of a
workspace with other bytes than the first run's ends in NO, and exit status 1.
"""

from __future__ import annotations

import argparse
import logging
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil  # type: ignore[import-untyped]
from distributed import Client

from megloc_kapture.errors import MeglocError
from megloc_kapture.pipeline.datasets import twin_of
from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.executors import open_executor, single_threaded
from megloc_kapture.pipeline.plan import run_plan
from megloc_kapture.pipeline.run import choose_run
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.work import Item, Track, Work, untracked

sys.path.append(str(Path(__file__).resolve().parent / "speed"))
from executors import contents  # noqa: E402

SMALL = {
    "preprocessing.max_size_px": 480,
    "local_features.options.max_keypoints": 600,
    "global_features.options.num_clusters": 16,
    "mapping_pairs.top_k": 5,
    "query_pairs.top_k": 5,
}
TWINS: dict[str, dict[str, Any]] = {
    "aachen": {
        **{"num_places": 2, "stations_per_place": 4, "width": 320, "height": 240},
        **{"day_queries": 3, "night_queries": 1},
    },
    "robotcar": {"num_locations": 2, "size_px": 240, "moments_per_condition": 2},
    "4seasons": {"num_places": 2, "map_keyframes": 16, "winter_keyframes": 4, "dusk_keyframes": 2},
}
KILLS, SCHEDULER_KILLS = 10, 3


@dataclass(frozen=True)
class Cluster:
    """A scheduler and workers of their own, as somebody starts them."""

    address: str
    scheduler: subprocess.Popen[str]
    workers: tuple[subprocess.Popen[str], ...]

    def pids(self) -> list[int]:
        """The processes that do the work; their parents only start them again."""
        found = []
        for nanny in self.workers:
            for child in psutil.Process(nanny.pid).children(recursive=True):
                with suppress(psutil.Error):  # it has just died
                    found += [child.pid] if "spawn_main" in "".join(child.cmdline()) else []
        return found

    def kill_one(self, random: np.random.Generator) -> None:
        """Kill a worker, as soon as one lives."""
        pids: list[int] = []
        while not pids:  # all may be about to be started again
            time.sleep(0.01)
            pids = self.pids()
        with suppress(ProcessLookupError):
            os.kill(int(random.choice(pids)), signal.SIGKILL)


@contextmanager
def running(folder: Path, number: int = 2, **environment: str) -> Iterator[Cluster]:
    """A cluster on this machine, whose workers start in another folder than this process."""
    settings = {"env": {**os.environ, **environment}, "cwd": folder}
    settings |= {"stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    dask = [sys.executable, "-m", "dask"]
    started: list[subprocess.Popen[str]] = []
    command = [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    try:
        started.append(subprocess.Popen(command, **settings))  # type: ignore[call-overload]
        stderr: Any = started[0].stderr
        line = next(line for line in stderr if "Scheduler at:" in line)
        address = re.findall(r"tcp://\S+", line)[0]
        command = [*dask, "worker", address, "--nthreads", "1", "--no-dashboard"]
        settings["stderr"] = subprocess.DEVNULL  # a pipe that nobody reads fills up
        for _ in range(number):
            started.append(subprocess.Popen(command, **settings))  # type: ignore[call-overload]
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(number, timeout=60)
        yield Cluster(address, started[0], tuple(started[1:]))
    finally:
        for process in started:
            kill_session(process.pid)
            process.wait()
            if process.stderr:
                process.stderr.close()


def kill_session(pid: int) -> None:
    """Kill a process and those of its session."""
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)


class At:
    """Calls a function each time that so many results of a run have arrived."""

    def __init__(self, moments: Iterable[int] = (), action: Callable[[], object] = int) -> None:
        self.results, self._moments, self._action = 0, set(moments), action

    def __call__(self, items: Iterable[Item], total: int, label: str) -> Iterator[Item]:
        for item in items:
            yield item
            self.results += 1
            if self.results in self._moments:
                self._action()


@dataclass(frozen=True)
class Given:
    """A dataset in its official layout or as kapture folders, and options of the run."""

    dataset: str
    root: Path
    options: Mapping[str, Any]

    def run(self, workspace: Path, address: str | None = None, track: Track = untracked) -> None:
        """What ``megloc eval`` runs: in this process, or on the cluster of an address."""
        choice = choose_run(
            self.dataset, self.root, preset="classic", assignments=dict(self.options)
        )
        opened = Workspace(workspace)
        with (
            opened.lock(),
            single_threaded(),
            open_executor(
                "dask" if address else "inline", scheduler=address, shared=workspace
            ) as executor,
        ):
            run_plan(plan_evaluation(choice), opened, Work(executor, track))


def run_with_kills(given: Given, folder: Path, number: int, results: int, seed: int) -> int:
    """Run while workers are killed at random moments; how many were."""
    random = np.random.default_rng(seed)
    moments = random.choice(np.arange(1, results), min(KILLS, results - 1), replace=False)
    with running(folder, number) as cluster:
        track = At(moments.tolist(), lambda: cluster.kill_one(random))
        given.run(folder / "workspace", cluster.address, track)
    return len(moments)


def resume_after_kills(given: Given, folder: Path, results: int, seed: int) -> int:
    """Run, and again after each time that the scheduler was killed; how often it was."""
    killed = 0
    # what was done before is not done again, so each must come early enough for the next
    for moment in np.random.default_rng(seed).integers(1, results // 4, SCHEDULER_KILLS).tolist():
        with running(folder, 2) as cluster:
            track = At([moment], lambda: kill_session(cluster.scheduler.pid))  # noqa: B023
            try:
                given.run(folder / "workspace", cluster.address, track)
            except MeglocError as error:
                if "has gone" not in str(error):
                    raise
                killed += 1
    with running(folder, 2) as cluster:
        given.run(folder / "workspace", cluster.address)
    return killed


def compare(name: str, given: Given, place: Path) -> bool:
    """Print a line for each run; whether all have the first one's bytes."""
    counter, start = At(), time.perf_counter()
    given.run(place / "inline", track=counter)
    here, equal = contents(place / "inline"), True
    print(
        f"{name}: {len(here)} files of {sum(map(len, here.values())) / 1e6:.1f} MB, "
        f"{counter.results} results, {time.perf_counter() - start:.0f} s in one process",
        flush=True,
    )

    def line(what: str, run: Callable[[Path], int], things: str) -> None:
        nonlocal equal
        folder, start = place / what.replace(" ", "-"), time.perf_counter()
        folder.mkdir()
        killed = run(folder)
        there = contents(folder / "workspace")
        other = sorted(name for name in here | there if here.get(name) != there.get(name))
        equal &= not other
        said = f"{killed} {things} killed, {time.perf_counter() - start:.0f} s"
        print(
            f"  {what}: {said}, equal bytes: {f'NO, {other[:3]}' if other else 'yes'}", flush=True
        )

    def undisturbed(folder: Path, number: int) -> int:
        with running(folder, number) as cluster:
            given.run(folder / "workspace", cluster.address)
        return 0

    for number in (2, 4):
        line(f"{number} workers", lambda folder: undisturbed(folder, number), "workers")  # noqa: B023
        line(
            f"{number} workers that die",
            lambda folder: run_with_kills(given, folder, number, counter.results, number),  # noqa: B023
            "workers",
        )
    line(
        "a scheduler that dies",
        lambda folder: resume_after_kills(given, folder, counter.results, 0),
        "schedulers",
    )
    return equal


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scene", type=Path, action="append", default=[])
    parser.add_argument("--twin", choices=TWINS, action="append", default=[])
    options = parser.parse_args()
    for name in ("distributed", "distributed.client"):  # of schedulers that go, at length
        logging.getLogger(name).setLevel(logging.CRITICAL)
    equal = True
    for scene in options.scene:
        with tempfile.TemporaryDirectory(prefix="megloc-kills-") as folder:
            given = Given("kapture", scene.resolve(), SMALL)
            equal &= compare(scene.name, given, Path(folder))
    for twin in options.twin:
        with tempfile.TemporaryDirectory(prefix="megloc-kills-") as folder:
            twin_of(twin, **TWINS[twin]).write(Path(folder) / "world", Work())
            given = Given(twin, Path(folder) / "world", SMALL)
            equal &= compare(f"twin of {twin}", given, Path(folder))
    return 0 if equal else 1


if __name__ == "__main__":
    sys.exit(main())
