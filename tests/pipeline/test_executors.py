"""Executors: inline, worker processes and dask."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Iterator
from contextlib import chdir
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client, LocalCluster
from threadpoolctl import threadpool_info

from megloc_kapture.errors import MeglocError, OptionError
from megloc_kapture.pipeline import dask_executor
from megloc_kapture.pipeline.executors import open_executor, single_threaded
from megloc_kapture.stages.work import ordered_map


def _log_level() -> int:
    return logging.getLogger().level


def test_workers_are_processes_with_one_thread_and_the_same_log_level(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(logging.getLogger(), "level", logging.INFO)
    with open_executor("processes", 2) as executor:
        assert executor is not None
        assert executor.submit(os.getpid).result() != os.getpid()
        counts = {pool["num_threads"] for pool in executor.submit(threadpool_info).result()}
        assert counts == {1}
        assert executor.submit(_log_level).result() == logging.INFO


def test_threads_of_torch_are_restored() -> None:
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with single_threaded():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_a_worker_that_dies_is_reported_in_one_line() -> None:
    with pytest.raises(MeglocError, match="a worker process died.*--workers.*__main__"):  # noqa: SIM117
        with open_executor("processes", 2) as executor:
            assert executor is not None
            pid = executor.submit(os.getpid).result()
            os.kill(pid, signal.SIGKILL)
            executor.submit(abs, -1).result()
            executor.submit(abs, -1).result()


def test_an_error_does_not_wait_for_busy_workers() -> None:
    with pytest.raises(ValueError, match="of the block"):  # noqa: SIM117
        with open_executor("processes", 2) as executor:
            assert executor is not None
            pids = {executor.submit(os.getpid).result()}
            executor.submit(time.sleep, 600)
            raise ValueError("of the block")
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a scheduler whose two workers started in another folder."""
    with chdir(tmp_path_factory.mktemp("cluster")):
        running = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with running, pytest.MonkeyPatch.context() as patch:
        # every process would import torch for its version
        patch.setattr(dask_executor, "_PACKAGES", ["megloc_kapture", "numpy"])
        yield running.scheduler_address


def _slow_square(number: int) -> tuple[int, int]:
    time.sleep(0.02)
    return number * number, os.getpid()


def _threads(_: int) -> set[int]:
    (np.ones((64, 64)) @ np.ones((64, 64))).sum()
    return {pool["num_threads"] for pool in threadpool_info()}


def _read(path: Path) -> str:
    return path.read_text()


def test_results_are_in_order_and_workers_have_one_thread(cluster: str) -> None:
    with open_executor("dask", scheduler=cluster) as executor:
        found = list(ordered_map(_slow_square, range(40), executor))
        assert [square for square, _ in found] == [n * n for n in range(40)]
        assert len({pid for _, pid in found} - {os.getpid()}) == 2
        assert set().union(*ordered_map(_threads, range(8), executor)) == {1}


def test_relative_paths_refer_to_the_folder_of_the_run(
    cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("here.txt").write_text("seen")
    with open_executor("dask", scheduler=cluster, shared=Path("out")) as executor:
        assert list(ordered_map(_read, [Path("here.txt")] * 3, executor)) == ["seen"] * 3
    assert list(Path("out").iterdir()) == []


def test_workers_with_another_version_of_a_package_are_refused(
    cluster: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def changed(client: Client, **kwargs: Any) -> Any:
        found = versions_of(client, **kwargs)
        found["client"]["packages"]["numpy"] = "1.0"
        return found

    versions_of = Client.get_versions
    monkeypatch.setattr(Client, "get_versions", changed)
    with (
        pytest.raises(MeglocError, match=r"worker tcp://.* has numpy .*, here it is 1\.0"),
        open_executor("dask", scheduler=cluster),
    ):
        pass


def test_folders_that_workers_cannot_read_are_refused(
    cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = dask_executor._Preparation

    def elsewhere(folder: Path, shared: Path) -> Any:
        return replace(make(folder, shared), shared=Path("/nowhere/shared"))

    monkeypatch.setattr(dask_executor, "_Preparation", elsewhere)
    with (
        pytest.raises(MeglocError, match="does not see /nowhere/shared"),
        open_executor("dask", scheduler=cluster),
    ):
        pytest.fail("opened")


def test_wrong_addresses_and_numbers_of_workers_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dask_executor, "_CONNECT_S", 0.2)
    with (
        pytest.raises(OptionError, match="no dask scheduler at tcp://127.0.0.1:1; give an address"),
        open_executor("dask", scheduler="tcp://127.0.0.1:1"),
    ):
        pass
    with monkeypatch.context() as patch:
        patch.setattr(dask_executor, "Client", lambda *_, **__: pytest.fail("connects"))
        with pytest.raises(OptionError, match="127.0.0.1; give an address tcp://HOST:PORT"):
            open_executor("dask", scheduler="tcp://127.0.0.1").__enter__()
    with pytest.raises(OptionError, match="--scheduler"):
        open_executor("processes", 2, "tcp://127.0.0.1:1").__enter__()
    with pytest.raises(OptionError, match="0 workers"):
        open_executor("inline", 0).__enter__()
