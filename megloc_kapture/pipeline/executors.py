"""Executors for per-image and per-pair work: inline, local processes, or dask."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Literal

from megloc_kapture.errors import MeglocError, OptionError, check_option

ExecutorKind = Literal["inline", "processes", "dask"]
LOG_FORMAT = "%(levelname)s %(name)s: %(message)s"


def available_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_lock = threading.Lock()
_num_blocks = 0
_before = ExitStack()  # restores the thread counts


@contextmanager
def single_threaded() -> Iterator[None]:
    """Limit BLAS, OpenMP and torch to one thread, as executors provide the parallelism.

    The last bits of a matrix product may depend on the number of threads. Several threads may be in
    this context at once.
    """
    global _num_blocks
    with _lock:
        _num_blocks += 1
        if _num_blocks == 1:
            _limit_threads(_before)
    try:
        yield
    finally:
        with _lock:
            _num_blocks -= 1
            if _num_blocks == 0:
                _before.close()


def _limit_threads(stack: ExitStack) -> None:
    from threadpoolctl import threadpool_limits

    stack.enter_context(threadpool_limits(1))
    torch: Any = sys.modules.get("torch")
    if hasattr(torch, "set_num_threads"):  # missing while another thread imports torch
        stack.callback(torch.set_num_threads, torch.get_num_threads())
        torch.set_num_threads(1)


def enter_single_threaded() -> None:
    import cv2
    import numpy  # noqa: F401  its thread pool must exist to be limited
    from threadpoolctl import threadpool_limits

    cv2.setNumThreads(1)
    os.environ["OMP_NUM_THREADS"] = "1"  # for libraries that load later, such as torch
    threadpool_limits(1)


def _start_worker(log_level: int) -> None:
    logging.basicConfig(level=log_level, format=LOG_FORMAT)
    # the parent ends its workers when a terminal interrupts the process group
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    end_with_parent()
    enter_single_threaded()


def end_with_parent() -> None:
    """Stop this process if its parent is killed; otherwise a worker would wait for work forever."""

    def wait_for_parent() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            wait([parent.sentinel])
            os._exit(1)

    threading.Thread(target=wait_for_parent, daemon=True).start()


def open_executor(
    kind: ExecutorKind,
    workers: int | None = None,
    scheduler: str | None = None,
    shared: Path | None = None,
) -> AbstractContextManager[Executor | None]:
    """Open the executor of a run, or None for inline work; kill workers on an exception.

    With dask, ``scheduler`` is an address (None starts a local cluster) and ``shared`` a folder
    that all workers must see, the current one by default.
    """
    count = available_cores() if workers is None else workers
    check_option(count >= 1, f"{count} workers: give 1 or more")
    if scheduler is not None and kind != "dask":
        raise OptionError("--scheduler needs --executor dask")
    if kind == "dask":
        from megloc_kapture.pipeline.dask_executor import dask_executor

        return dask_executor(count, scheduler, shared or Path.cwd())
    return nullcontext() if kind == "inline" or count == 1 else _process_pool(count)


@contextmanager
def _process_pool(count: int) -> Iterator[Executor]:
    # fork is unsafe with the threads of BLAS and OpenCV
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["megloc_kapture.stages.query_poses"])
    pool = ProcessPoolExecutor(count, context, _start_worker, (logging.getLogger().level,))
    try:
        yield pool
    except BaseException as error:
        _kill(pool)
        if isinstance(error, BrokenProcessPool):
            raise MeglocError(
                "a worker process died: either memory ran out (try fewer workers, --workers), or "
                'your script is not guarded by `if __name__ == "__main__":`'
            ) from error
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _kill(pool: ProcessPoolExecutor) -> None:
    for process in list((pool._processes or {}).values()):
        process.kill()
    if pool._result_queue is not None:
        # otherwise a thread of the pool waits forever for an incomplete result
        pool._result_queue._writer.close()  # type: ignore[attr-defined]
