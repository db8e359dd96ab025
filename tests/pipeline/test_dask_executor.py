"""Work on a dask cluster: the same bytes as here, whatever happens to its workers."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from distributed import Client
from threadpoolctl import threadpool_info

import megloc_kapture as megloc
from megloc_kapture.errors import DataError, MeglocError, OptionError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline import dask_executor
from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.executors import open_executor, single_threaded
from megloc_kapture.pipeline.plan import run_plan
from megloc_kapture.pipeline.queries import KaptureQueries
from megloc_kapture.pipeline.run import choose_run
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.work import Item, Track, Work, ordered_map, untracked
from megloc_kapture.values import Pose


@dataclass(frozen=True)
class Cluster:
    """A scheduler and two workers of their own, as somebody starts them."""

    address: str
    scheduler: subprocess.Popen[str]
    workers: tuple[subprocess.Popen[str], ...]


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
        for _ in range(number):
            started.append(subprocess.Popen(command, **settings))  # type: ignore[call-overload]
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(number, timeout=60)
        yield Cluster(address, started[0], tuple(started[1:]))
    finally:
        for process in started:
            with_children(process.pid)
            process.wait()
            if process.stderr:
                process.stderr.close()


def with_children(pid: int) -> None:
    """Kill a process and those of its session."""
    try:
        os.killpg(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A cluster for those who leave it as it is."""
    with running(tmp_path_factory.mktemp("cluster")) as found:
        yield found


def _slow_square(number: int) -> tuple[int, int]:
    time.sleep(0.02)
    return number * number, os.getpid()


def _threads(_: int) -> set[int]:
    (np.ones((64, 64)) @ np.ones((64, 64))).sum()
    return {pool["num_threads"] for pool in threadpool_info()}


def _broken(path: Path) -> None:
    raise DataError("expected so, got thus", path=path, line=3)


def _read(path: Path) -> str:
    return path.read_text()


def _die_once(place: Path) -> str:
    if not place.exists():
        place.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "done"


def test_results_come_in_order_from_workers_with_one_thread(cluster: Cluster) -> None:
    with open_executor("dask", scheduler=cluster.address) as executor:
        found = list(ordered_map(_slow_square, range(40), executor))
        assert [square for square, _ in found] == [n * n for n in range(40)]
        assert len({pid for _, pid in found} - {os.getpid()}) == 2
        assert set().union(*ordered_map(_threads, range(8), executor)) == {1}


def test_relative_paths_start_where_the_run_started(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("here.txt").write_text("seen")
    with open_executor("dask", scheduler=cluster.address, shared=Path("out")) as executor:
        assert list(ordered_map(_read, [Path("here.txt")] * 3, executor)) == ["seen"] * 3
    assert list(Path("out").iterdir()) == []


def test_what_an_item_raises_arrives_as_it_is(cluster: Cluster) -> None:
    with (
        pytest.raises(DataError, match=r"^a/b.txt:3: expected so, got thus$") as error,
        open_executor("dask", scheduler=cluster.address) as executor,
    ):
        list(ordered_map(_broken, [Path("a/b.txt")], executor))
    assert error.value.path == Path("a/b.txt")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"packages": {"numpy": "0.1"}}, r"worker tcp://\S+ has numpy \S+, this process 0\.1$"),
        ({"weights": {"superpoint_v1": "0" * 64}}, "has no weights of superpoint_v1"),
        ({"folder": Path("/nowhere/at/all")}, "does not see /nowhere/at/all"),
        ({"token": Path("/nowhere/.token")}, "does not see /nowhere/.token"),
    ],
)
def test_a_worker_that_differs_is_refused_before_it_works(
    cluster: Cluster,
    change: dict[str, Any],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    made = dask_executor._Preparation.of_this_process

    def differing(shared: Path, *, elsewhere: bool) -> Any:
        own = made(shared, elsewhere=elsewhere)
        changed = {**own.packages, **change["packages"]} if "packages" in change else None
        return replace(own, **({"packages": changed} if changed else change))

    monkeypatch.setattr(dask_executor._Preparation, "of_this_process", differing)
    with (
        pytest.raises(MeglocError, match=words),
        open_executor("dask", scheduler=cluster.address, shared=tmp_path),
    ):
        pytest.fail("it was not refused")


def test_a_worker_that_was_killed_costs_no_result(tmp_path: Path) -> None:
    with open_executor("dask", 2) as executor:
        places = [tmp_path / str(number) for number in range(3)]
        assert list(ordered_map(_die_once, places, executor)) == ["done"] * 3


def test_a_scheduler_that_goes_away_is_one_line(tmp_path: Path) -> None:
    with (
        running(tmp_path, 1) as found,
        pytest.raises(MeglocError, match=f"scheduler {found.address} has gone; .*to go on$"),
        open_executor("dask", scheduler=found.address) as executor,
    ):
        for number, _ in enumerate(ordered_map(_slow_square, range(500), executor)):
            if number == 3:
                with_children(found.scheduler.pid)


def test_what_cannot_be_used_is_refused(cluster: Cluster) -> None:
    with (
        pytest.raises(OptionError, match="no dask scheduler at tcp://127.0.0.1:1$"),
        open_executor("dask", scheduler="tcp://127.0.0.1:1"),
    ):
        pass
    with pytest.raises(OptionError, match="--workers"):
        open_executor("dask", 2, cluster.address).__enter__()
    with pytest.raises(OptionError, match="--scheduler"):
        open_executor("processes", 2, cluster.address).__enter__()


def contents(workspace: Path) -> dict[str, bytes]:
    """The files of a workspace but for those that have times in them."""
    return {
        str(path.relative_to(workspace)): path.read_bytes()
        for path in sorted(workspace.rglob("*"))
        if path.is_file()
        and path.name != "timing.csv"
        and not {"stages", "evaluation", "submissions"} & set(path.relative_to(workspace).parts)
    }


def test_a_map_is_the_same_bytes_on_a_cluster(
    cluster: Cluster, scene: Path, tmp_path: Path
) -> None:
    few = {"local_features.options.max_keypoints": 400}
    for name, how in (("here", {}), ("cluster", {"scheduler": cluster.address})):
        megloc.build_map(scene / "mapping", set=few, workspace=tmp_path / name, **how)
    here = contents(tmp_path / "here")
    assert len(here) > 20
    assert contents(tmp_path / "cluster") == here


def test_images_are_localized_on_a_cluster_as_here(
    cluster: Cluster, scene: Path, tmp_path: Path
) -> None:
    few = {"local_features.options.max_keypoints": 400}
    built = megloc.build_map(scene / "mapping", set=few, workspace=tmp_path / "map")
    localizer = built.localizer()
    queries = list(KaptureQueries(KaptureFolder(scene / "query"), built.kapture_map))
    here = list(localizer.localize_many(queries))
    assert all(here)
    with open_executor("dask", scheduler=cluster.address) as executor:
        there = list(localizer.localize_many(queries, executor))
    for one, other in zip(here, there, strict=True):
        assert isinstance(one, Pose) and isinstance(other, Pose)
        assert one.cam_from_world.matrix().tobytes() == other.cam_from_world.matrix().tobytes()
        assert (one.name, one.confidence) == (other.name, other.confidence)


def run_whole(scene: Path, root: Path, address: str | None, track: Track = untracked) -> None:
    """What ``megloc eval`` runs: in this process, or on the cluster of an address."""
    few = {"local_features.options.max_keypoints": 400}
    choice, opened = choose_run("kapture", scene, assignments=few), Workspace(root)
    kind = "dask" if address else "inline"
    with (
        opened.lock(),
        single_threaded(),
        open_executor(kind, scheduler=address, shared=root) as executor,  # type: ignore[arg-type]
    ):
        run_plan(plan_evaluation(choice.run_in(opened)), opened, Work(executor, track))


class At:
    """Calls a function each time that so many results of a run have arrived."""

    def __init__(self, moments: Iterable[int], action: Callable[[], None]) -> None:
        self.results, self._moments, self._action = 0, set(moments), action

    def __call__(self, items: Iterable[Item], total: int, label: str) -> Iterator[Item]:
        for item in items:
            yield item
            self.results += 1
            if self.results in self._moments:
                self._action()


def worker_pids(cluster: Cluster) -> list[int]:
    """The processes that do the work; their parents only start them again."""
    found = []
    for nanny in cluster.workers:
        for child in psutil.Process(nanny.pid).children(recursive=True):
            with suppress(psutil.Error):  # it has just died
                found += [child.pid] if "spawn_main" in "".join(child.cmdline()) else []
    return found


@pytest.fixture(scope="module")
def inline(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, bytes], int]:
    """The files of a whole run in this process, and the number of results that it waits for."""
    root, counter = tmp_path_factory.mktemp("inline") / "workspace", At((), lambda: None)
    run_whole(scene, root, None, counter)
    return contents(root), counter.results


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 4])
def test_workers_killed_at_ten_moments_change_no_byte(
    number: int, inline: tuple[dict[str, bytes], int], scene: Path, tmp_path: Path
) -> None:
    here, results = inline
    random = np.random.default_rng(number)
    killed = []
    with running(tmp_path, number) as found:

        def kill() -> None:
            pids: list[int] = []
            while not pids:  # all may be about to be started again
                time.sleep(0.01)
                pids = worker_pids(found)
            killed.append(int(random.choice(pids)))
            with suppress(ProcessLookupError):
                os.kill(killed[-1], signal.SIGKILL)

        moments = random.choice(np.arange(1, results), 10, replace=False).tolist()
        run_whole(scene, tmp_path / "workspace", found.address, At(moments, kill))
    assert len(killed) == 10
    assert contents(tmp_path / "workspace") == here


@pytest.mark.slow
def test_a_run_goes_on_after_its_scheduler_was_killed(
    inline: tuple[dict[str, bytes], int], scene: Path, tmp_path: Path
) -> None:
    here, results = inline
    root = tmp_path / "workspace"
    # what was done before is not done again, so each must come early enough for the next
    for moment in np.random.default_rng(0).integers(1, results // 4, 3).tolist():
        with running(tmp_path, 2) as found:
            track = At([moment], lambda: with_children(found.scheduler.pid))  # noqa: B023
            with pytest.raises(MeglocError, match=r"has gone; .*to go on$"):
                run_whole(scene, root, found.address, track)
    with running(tmp_path, 2) as found:
        run_whole(scene, root, found.address)
    assert contents(root) == here
