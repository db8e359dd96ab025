"""Where work runs: inline, or in processes whose number changes nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import pytest
from threadpoolctl import threadpool_info

from megloc_kapture.errors import MeglocError, OptionError
from megloc_kapture.pipeline.executors import available_cores, open_executor, single_threaded


def threads() -> set[int]:
    """Numbers of threads of the loaded libraries that have a pool."""
    return {pool["num_threads"] for pool in threadpool_info()}


def test_inline_and_one_worker_are_no_executor() -> None:
    for kind, workers in (("inline", None), ("inline", 8), ("processes", 1)):
        with open_executor(kind, workers) as executor:  # type: ignore[arg-type]
            assert executor is None


@pytest.mark.parametrize("workers", [0, -1])
def test_no_worker_is_refused(workers: int) -> None:
    with pytest.raises(OptionError, match=f"{workers} workers"), open_executor("inline", workers):
        pass


def test_workers_are_other_processes_with_one_thread_each() -> None:
    with open_executor("processes", 2) as executor:
        assert executor is not None
        assert executor.submit(os.getpid).result() != os.getpid()
        counts = {pool["num_threads"] for pool in executor.submit(threadpool_info).result()}
        assert counts == {1}


def _torch_threads() -> int:
    import torch

    return torch.get_num_threads()


def test_torch_has_one_thread_in_workers_and_within_a_block() -> None:
    with open_executor("processes", 2) as executor:
        assert executor is not None
        assert executor.submit(_torch_threads).result() == 1
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with single_threaded():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_torch_imported_within_a_block_has_one_thread_there_and_all_afterwards() -> None:
    script = """if True:
        from megloc_kapture.pipeline.executors import available_cores, single_threaded
        with single_threaded():
            import torch
            torch.zeros(1000, 1000).exp()  # something that starts its threads
            assert torch.get_num_threads() == 1, torch.get_num_threads()
        assert torch.get_num_threads() == available_cores(), torch.get_num_threads()
    """
    environment = {key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"}
    subprocess.run([sys.executable, "-c", script], check=True, env=environment)


def test_a_worker_that_dies_is_told_in_one_line() -> None:
    with pytest.raises(MeglocError, match="a worker process died.*--workers"):  # noqa: SIM117
        with open_executor("processes", 2) as executor:
            assert executor is not None
            pid = executor.submit(os.getpid).result()
            os.kill(pid, signal.SIGKILL)
            executor.submit(abs, -1).result()
            executor.submit(abs, -1).result()


def test_an_error_in_a_worker_keeps_its_kind() -> None:
    with open_executor("processes", 2) as executor:
        assert executor is not None
        with pytest.raises(ValueError, match="invalid literal"):
            executor.submit(int, "x").result()


def test_one_thread_while_any_block_is_open() -> None:
    before = threads()
    inside, leave = threading.Event(), threading.Event()
    seen: list[set[int]] = []

    def other() -> None:
        with single_threaded():
            inside.set()
            leave.wait(30)
            seen.append(threads())

    thread = threading.Thread(target=other)
    with single_threaded():
        thread.start()
        assert inside.wait(30)
        assert threads() == {1}
    # the other block still wants it
    leave.set()
    thread.join()
    assert seen == [{1}]
    assert threads() == before


def test_there_is_a_core_at_least() -> None:
    assert 1 <= available_cores() <= (os.cpu_count() or 1)
