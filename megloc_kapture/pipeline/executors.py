"""Where per-image and per-pair work runs: here, or in local processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
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


class _SingleThreads:
    """One thread for BLAS, OpenMP and torch, while and wherever a block is open.

    Their numbers of threads have three scopes, so that no single call limits all of them:

    - BLAS has one pool for the process: the first block that opens limits it, and the last that
      closes gives it back, whichever threads these are. threadpoolctl ignores all threads but the
      one that set OpenBLAS first, as long as that one lives; so its claim is cleared.
    - OpenMP counts for each thread that calls it: every thread limits its own.
    - torch keeps both, the process's number being that of threads it has not met yet, and it
      overrides MKL and OpenMP; so every thread sets it last.

    Libraries that are loaded while a block is open start with one thread by ``OMP_NUM_THREADS``.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._threads = 0  # that have a block open
        self._own = threading.local()  # depth: of this thread's blocks; openmp: its numbers before
        self._blas: dict[str, int] = {}  # numbers of threads before, by library
        self._torch = 0
        self._variable: str | None = None

    def enter(self) -> None:
        """Open a block in this thread; within another one of this thread it changes nothing."""
        self._own.depth = getattr(self._own, "depth", 0) + 1
        if self._own.depth > 1:
            return
        from threadpoolctl import ThreadpoolController

        with self._lock:
            libraries = ThreadpoolController()
            if self._threads == 0:
                self._variable = os.environ.get("OMP_NUM_THREADS")
                os.environ["OMP_NUM_THREADS"] = "1"
                blas = libraries.select(user_api="blas").lib_controllers
                self._blas = {library.filepath: library.num_threads for library in blas}
                torch = _loaded_torch()
                self._torch = self._default() if torch is None else torch.get_num_threads()
                _set_blas(blas, dict.fromkeys(self._blas, 1))
            self._threads += 1
            openmp = libraries.select(user_api="openmp").lib_controllers
            self._own.openmp = {library.filepath: library.num_threads for library in openmp}
            for library in openmp:
                library.set_num_threads(1)
            _set_torch(1, others=1)

    def leave(self) -> None:
        """Close the block that was opened last in this thread."""
        self._own.depth -= 1
        if self._own.depth:
            return
        from threadpoolctl import ThreadpoolController

        with self._lock:
            libraries = ThreadpoolController()
            for library in libraries.select(user_api="openmp").lib_controllers:
                number = self._own.openmp.get(library.filepath, self._default())
                library.set_num_threads(number)
            self._threads -= 1
            _set_torch(self._torch, others=1 if self._threads else self._torch)
            if self._threads == 0:
                blas = libraries.select(user_api="blas").lib_controllers
                before = {library.filepath: self._default() for library in blas} | self._blas
                _set_blas(blas, before)
                _clear_claim(blas)
                os.environ.pop("OMP_NUM_THREADS")
                if self._variable is not None:
                    os.environ["OMP_NUM_THREADS"] = self._variable

    def _default(self) -> int:
        """Threads of a library that is loaded without a block."""
        number = (self._variable or "").split(",")[0].strip()  # "4,2" is for nested regions
        return int(number) if number.isdigit() and int(number) > 0 else available_cores()


def _set_blas(libraries: Sequence[Any], numbers: Mapping[str, int]) -> None:
    """Set the number of threads of each, by file path, in the whole process."""
    _clear_claim(libraries)
    for library in libraries:
        library.set_num_threads(numbers[library.filepath])


def _clear_claim(libraries: Sequence[Any]) -> None:
    """Let any thread set OpenBLAS's number again; versions before 3.8 know no such claim."""
    for library in libraries:
        clear = getattr(library, "clear_controlling_thread", None)
        if clear is not None:
            clear(force=True)


def _loaded_torch() -> Any:
    """The module; None while it is not imported, or another thread is still at it."""
    torch = sys.modules.get("torch")
    return torch if hasattr(torch, "set_num_threads") else None


def _set_torch(number: int, others: int) -> None:
    """Set torch's number in this thread, and that of threads it has not met yet."""
    torch = _loaded_torch()
    if torch is None:
        return
    torch.get_num_threads()  # or this thread would take the others' number at its first product
    torch.set_num_threads(number)
    if others != number:
        thread = threading.Thread(target=torch.set_num_threads, args=(others,))
        thread.start()
        thread.join()


_single_threads = _SingleThreads()


@contextmanager
def single_threaded() -> Iterator[None]:
    """One thread per matrix product while the block runs, in the thread that runs it.

    A product's last bits may depend on how it is split among threads; parallelism comes from
    the executor, so that results are the same bytes whatever the number of workers. Blocks may be
    nested, and may overlap in several threads; after the last one all numbers are as before.
    """
    _single_threads.enter()
    try:
        yield
    finally:
        _single_threads.leave()


def _start_worker() -> None:
    import cv2
    import numpy  # noqa: F401  its thread pool must be there to be limited

    threading.Thread(target=_end_with_parent, daemon=True).start()
    _single_threads.enter()  # for good
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
