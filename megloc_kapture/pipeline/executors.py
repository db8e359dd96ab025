"""Where per-image and per-pair work runs: here, or in local processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import forkserver
from multiprocessing.connection import wait
from typing import Literal

from megloc_kapture.errors import MeglocError, OptionError

ExecutorKind = Literal["inline", "processes"]


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _SharedLimit:
    """Counts who needs a limit of the process; the first sets it, the last takes it back."""

    def __init__(self, limit: Callable[[], Callable[[], object]]) -> None:
        """``limit`` sets it and returns what takes it back."""
        self._limit = limit
        self._lock = threading.Lock()
        self._users = 0
        self._restore: Callable[[], object] | None = None

    @contextmanager
    def __call__(self) -> Iterator[None]:
        with self._lock:
            if self._users == 0:
                self._restore = self._limit()
            self._users += 1
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                if self._users == 0 and self._restore is not None:
                    self._restore()


def _limit_blas() -> Callable[[], object]:
    from threadpoolctl import threadpool_limits

    restore: Callable[[], object] = threadpool_limits(
        limits=1, user_api="blas"
    ).restore_original_limits
    return restore


def _limit_torch() -> Callable[[], object]:
    """One thread for torch, now, or from its import on: it sets its own, past BLAS's limits."""
    wanted = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    imported = sys.modules.get("torch")
    before: int = int(wanted or available_cores())
    if imported is not None:
        before = imported.get_num_threads()
        imported.set_num_threads(1)

    def restore() -> None:
        os.environ.pop("OMP_NUM_THREADS")
        if wanted is not None:
            os.environ["OMP_NUM_THREADS"] = wanted
        torch = sys.modules.get("torch")
        if torch is not None:
            torch.set_num_threads(before)

    return restore


_blas_limit, _torch_limit = _SharedLimit(_limit_blas), _SharedLimit(_limit_torch)


@contextmanager
def single_threaded() -> Iterator[None]:
    """One thread per matrix product while the block runs; blocks may overlap in several threads.

    A product's last bits may depend on how it is split among threads; parallelism comes from
    the executor, so that results are the same bytes whatever the number of workers.
    """
    from threadpoolctl import threadpool_limits

    # OpenMP's limit is of the calling thread alone, and taking it back sets every library to what
    # it had before: so BLAS is limited around it, and torch, which sets OpenMP's threads, in it
    with _blas_limit(), threadpool_limits(limits=1, user_api="openmp"), _torch_limit():
        yield


def _start_worker() -> None:
    import cv2
    import numpy  # noqa: F401  its thread pool must be there to be limited
    from threadpoolctl import threadpool_limits

    threading.Thread(target=_end_with_parent, daemon=True).start()
    threadpool_limits(limits=1)
    _limit_torch()
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
