"""Where per-image and per-pair work runs: here, or in local processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import forkserver
from multiprocessing.connection import wait
from typing import Any, Literal

from megloc_kapture.errors import MeglocError, OptionError

ExecutorKind = Literal["inline", "processes"]


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _SingleThreadedBlas:
    """Counts who needs one thread per matrix product; the first sets it, the last restores it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._limits: Any = None

    def enter(self) -> None:
        from threadpoolctl import threadpool_limits

        with self._lock:
            if self._users == 0:
                self._limits = threadpool_limits(limits=1, user_api="blas")
            self._users += 1

    def leave(self) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                self._limits.restore_original_limits()


_single_threaded_blas = _SingleThreadedBlas()


@contextmanager
def single_threaded() -> Iterator[None]:
    """One thread per matrix product while the block runs; blocks may overlap in several threads.

    A product's last bits may depend on how it is split among threads; parallelism comes from
    the executor, so that results are the same bytes whatever the number of workers.
    """
    from threadpoolctl import threadpool_limits

    _single_threaded_blas.enter()
    try:
        # unlike BLAS's, OpenMP's limit is of the calling thread alone
        with threadpool_limits(limits=1, user_api="openmp"):
            yield
    finally:
        _single_threaded_blas.leave()


def _start_worker() -> None:
    import cv2
    import numpy  # noqa: F401  its thread pool must be there to be limited
    from threadpoolctl import threadpool_limits

    threading.Thread(target=_end_with_parent, daemon=True).start()
    threadpool_limits(limits=1)
    cv2.setNumThreads(1)


@contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Processes started in the block ignore Ctrl-C, and so do those that they start.

    A terminal sends it to every process; the run itself ends its workers.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _end_with_parent() -> None:
    """A worker waits for work forever; when the run was killed, none will come."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


@contextmanager
def open_executor(kind: ExecutorKind, workers: int | None = None) -> Iterator[Executor | None]:
    """The executor for a run; None stands for inline.

    Raises
    ------
    OptionError : no worker at all.
    MeglocError : a worker process was killed while the block ran.
    """
    count = available_cores() if workers is None else workers
    if count < 1:
        raise OptionError(f"{count} workers cannot work; give 1 or more")
    if kind == "inline" or count == 1:
        yield None
        return
    # never fork: BLAS and OpenCV have threads by now
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["megloc_kapture.stages.query_poses"])
    with _deaf_to_interrupts():
        forkserver.ensure_running()
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker)
    try:
        yield pool
    except BrokenProcessPool as error:
        raise MeglocError(
            "a worker process died, perhaps for want of memory; try fewer with --workers"
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
