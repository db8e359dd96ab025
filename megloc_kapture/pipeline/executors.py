"""Where per-image and per-pair work runs: here, or in local processes."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Literal

from megloc_kapture.errors import OptionError

ExecutorKind = Literal["inline", "processes"]


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def single_threaded() -> Iterator[None]:
    """One thread per matrix product while the block runs.

    A product's last bits may depend on how it is split among threads; parallelism comes from
    the executor, so that results are the same bytes whatever the number of workers.
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1):
        yield


def _start_worker() -> None:
    import cv2
    import numpy  # noqa: F401  its thread pool must be there to be limited
    from threadpoolctl import threadpool_limits

    threadpool_limits(limits=1)
    cv2.setNumThreads(1)


@contextmanager
def open_executor(kind: ExecutorKind, workers: int | None = None) -> Iterator[Executor | None]:
    """The executor for a run; None stands for inline.

    Raises
    ------
    OptionError : no worker at all.
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
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker)
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
