"""Executors: inline and worker processes."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info

from megloc_kapture.errors import MeglocError, OptionError
from megloc_kapture.pipeline.executors import open_executor, single_threaded


def test_inline_and_one_worker_need_no_pool() -> None:
    for kind, workers in (("inline", None), ("inline", 8), ("processes", 1)):
        with open_executor(kind, workers) as executor:  # type: ignore[arg-type]
            assert executor is None


def test_less_than_one_worker_is_refused() -> None:
    with pytest.raises(OptionError, match="0 workers"), open_executor("inline", 0):
        pass


def test_workers_are_processes_with_one_thread() -> None:
    with open_executor("processes", 2) as executor:
        assert executor is not None
        assert executor.submit(os.getpid).result() != os.getpid()
        counts = {pool["num_threads"] for pool in executor.submit(threadpool_info).result()}
        assert counts == {1}


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
    with pytest.raises(MeglocError, match="a worker process died.*--workers"):  # noqa: SIM117
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
