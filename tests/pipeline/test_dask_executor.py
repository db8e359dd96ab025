"""Work on a dask cluster."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client
from threadpoolctl import threadpool_info

from megloc_kapture.errors import MeglocError, OptionError
from megloc_kapture.pipeline import dask_executor
from megloc_kapture.pipeline.executors import open_executor
from megloc_kapture.stages.work import ordered_map


@contextmanager
def running(folder: Path, number: int = 2) -> Iterator[str]:
    """Start a scheduler and workers in another folder than this process; yield the address."""
    dask = [sys.executable, "-m", "dask"]
    settings: dict[str, Any] = {"cwd": folder, "text": True, "start_new_session": True}
    started = [
        subprocess.Popen(
            [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"],
            stderr=subprocess.PIPE,
            **settings,
        )
    ]
    try:
        assert started[0].stderr is not None
        line = next(line for line in started[0].stderr if "Scheduler at:" in line)
        address = re.findall(r"tcp://\S+", line)[0]
        worker = [*dask, "worker", address, "--nthreads", "1", "--no-dashboard"]
        for _ in range(number):
            started.append(subprocess.Popen(worker, stderr=subprocess.DEVNULL, **settings))
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(number, timeout=60)
        yield address
    finally:
        for process in started:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with running(tmp_path_factory.mktemp("cluster")) as found:
        yield found


def _slow_square(number: int) -> tuple[int, int]:
    time.sleep(0.02)
    return number * number, os.getpid()


def _threads(_: int) -> set[int]:
    (np.ones((64, 64)) @ np.ones((64, 64))).sum()
    return {pool["num_threads"] for pool in threadpool_info()}


def _read(path: Path) -> str:
    return path.read_text()


def test_results_come_in_order_from_workers_with_one_thread(cluster: str) -> None:
    with open_executor("dask", scheduler=cluster) as executor:
        found = list(ordered_map(_slow_square, range(40), executor))
        assert [square for square, _ in found] == [n * n for n in range(40)]
        assert len({pid for _, pid in found} - {os.getpid()}) == 2
        assert set().union(*ordered_map(_threads, range(8), executor)) == {1}


def test_relative_paths_start_where_the_run_started(
    cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("here.txt").write_text("seen")
    with open_executor("dask", scheduler=cluster, shared=Path("out")) as executor:
        assert list(ordered_map(_read, [Path("here.txt")] * 3, executor)) == ["seen"] * 3
    assert list(Path("out").iterdir()) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"folder": Path("/nowhere/at/all")}, "does not see /nowhere/at/all"),
        ({"shared": Path("/nowhere/shared")}, "does not see /nowhere/shared"),
    ],
)
def test_a_worker_that_differs_is_refused(
    cluster: str, change: dict[str, Any], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = dask_executor._Preparation

    def differing(folder: Path, shared: Path) -> Any:
        return replace(made(folder, shared), **change)

    monkeypatch.setattr(dask_executor, "_Preparation", differing)
    with (
        pytest.raises(MeglocError, match=words),
        open_executor("dask", scheduler=cluster),
    ):
        pytest.fail("it was not refused")


def test_what_cannot_be_used_is_refused(cluster: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_executor, "_CONNECT_S", 1.0)
    with (
        pytest.raises(OptionError, match="no dask scheduler at tcp://127.0.0.1:1$"),
        open_executor("dask", scheduler="tcp://127.0.0.1:1"),
    ):
        pass
    with pytest.raises(OptionError, match="--scheduler"):
        open_executor("processes", 2, cluster).__enter__()
