"""Where per-image and per-pair work runs: here, in local processes, or on a dask cluster."""

from __future__ import annotations

import itertools
import logging
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext, suppress
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import wait
from multiprocessing.util import Finalize, get_temp_dir
from pathlib import Path
from typing import Any, Literal

from megloc_kapture.errors import MeglocError, OptionError
from megloc_kapture.io.files import clear_leftovers, output_error, owned_name

ExecutorKind = Literal["inline", "processes", "dask"]


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _SingleThreads:
    """One thread for BLAS, OpenMP and torch, while and wherever a block is open.

    Their numbers of threads have three scopes, so that no single call limits all of them:

    - BLAS has one pool for the process: the first block that opens limits it, and the last that
      closes gives it back, whichever threads these are. threadpoolctl ignores all threads but the
      one that set OpenBLAS first, as long as that one lives; so its claim is cleared.
    - OpenMP counts for each thread that calls it, and so does an OpenBLAS made with it, as FAISS
      brings one: every thread limits its own.
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
            blas, openmp = _pools(ThreadpoolController())
            if self._threads == 0:
                self._variable = os.environ.get("OMP_NUM_THREADS")
                os.environ["OMP_NUM_THREADS"] = "1"
                self._blas = {library.filepath: library.num_threads for library in blas}
                torch = _loaded_torch()
                self._torch = self._default() if torch is None else torch.get_num_threads()
                _set_blas(blas, dict.fromkeys(self._blas, 1))
            self._threads += 1
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
            blas, openmp = _pools(ThreadpoolController())
            for library in openmp:
                number = self._own.openmp.get(library.filepath, self._default())
                library.set_num_threads(number)
            self._threads -= 1
            _set_torch(self._torch, others=1 if self._threads else self._torch)
            if self._threads == 0:
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


def _pools(libraries: Any) -> tuple[list[Any], list[Any]]:
    """Libraries with a pool for the process, and those that count for each thread."""
    blas = libraries.select(user_api="blas").lib_controllers
    own = [one for one in blas if getattr(one, "threading_layer", None) == "openmp"]
    openmp = libraries.select(user_api="openmp").lib_controllers
    return [one for one in blas if one not in own], [*openmp, *own]


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


def enter_single_threaded() -> None:
    """As :func:`single_threaded`, for good."""
    _single_threads.enter()


# ------------------------------------------------------------------------------------ processes

_SEMAPHORES = Path("/dev/shm")  # where Linux keeps those that have a name
_PATIENCE_S = 600.0  # of silence before a line says so

_log = logging.getLogger(__name__)


def _start_worker(shared: Path) -> None:
    import cv2
    import numpy  # noqa: F401  its thread pool must be there to be limited

    from megloc_kapture.io.weights import share_weights

    share_weights(shared)
    end_with_parent()
    enter_single_threaded()
    cv2.setNumThreads(1)


@contextmanager
def _handled_by(handler: Any, *signals: signal.Signals) -> Iterator[None]:
    """Another handler of signals in the block; only the main thread may have one."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {one: signal.signal(one, handler) for one in signals}
    try:
        yield
    finally:
        for one, former in before.items():
            signal.signal(one, former)


@contextmanager
def starting_processes() -> Iterator[None]:
    """Processes that are started in the block never hear Ctrl-C, and none is left half started.

    A terminal sends Ctrl-C to every process; the run itself ends its workers. On this process
    Ctrl-C and SIGTERM have their effect at the end of the block.
    """
    met: list[int] = []
    try:
        with _handled_by(lambda number, _: met.append(number), signal.SIGINT, signal.SIGTERM):
            # where it is started later, it lets the signals through again
            resource_tracker.ensure_running()
            # blocked, for that is inherited: were it ignored meanwhile, one would be lost
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                yield
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
    finally:
        for number in met[:1]:
            signal.raise_signal(number)


def end_with_parent() -> None:
    """End this process when its parent has gone: a worker waits for work that will not come."""

    def wait_for_parent() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            wait([parent.sentinel])
            os._exit(1)

    threading.Thread(target=wait_for_parent, daemon=True).start()


def _name_as_ours() -> None:
    """Let what multiprocessing leaves behind in a killed run say whose it is; clear others'.

    That is a folder with a socket, and on Linux semaphores, which have names.
    """
    clear_leftovers(Path(tempfile.gettempdir()))
    clear_leftovers(_SEMAPHORES)
    settings: dict[str, Any] = multiprocessing.current_process()._config  # type: ignore[attr-defined]
    if _SEMAPHORES.is_dir():
        settings["semprefix"] = f"/{owned_name()}"
    if settings.get("tempdir") is None:
        place = settings["tempdir"] = tempfile.mkdtemp(prefix=owned_name())
        # as multiprocessing does with a folder of its own: behind all else that ends
        Finalize(None, shutil.rmtree, (place,), {"ignore_errors": True}, exitpriority=-100)


@contextmanager
def open_executor(
    kind: ExecutorKind,
    workers: int | None = None,
    scheduler: str | None = None,
    shared: Path | None = None,
) -> Iterator[Executor | None]:
    """The executor for a run; None stands for inline.

    A block that ends in an exception does not wait for what its workers are doing: they are killed.

    Parameters
    ----------
    scheduler : of ``dask``: the address of a running one; else a local cluster of so many workers.
    shared : of ``dask``: a folder that all workers must see; the current one unless given.

    Raises
    ------
    OptionError : no worker at all; a scheduler that is not there, or that nothing asks.
    OutputError : no room in the temporary folder, where processes talk to each other.
    MeglocError : a worker process was killed while the block ran; see also
        :func:`~megloc_kapture.pipeline.dask_executor.dask_executor`.
    """
    count = available_cores() if workers is None else workers
    if count < 1:
        raise OptionError(f"{count} workers cannot work; give 1 or more")
    if kind == "dask":
        if workers is not None and scheduler is not None:
            raise OptionError("--workers changes nothing: the scheduler has workers of its own")
        from megloc_kapture.pipeline.dask_executor import dask_executor

        with dask_executor(count, scheduler, shared or Path.cwd()) as cluster:
            yield cluster
        return
    if scheduler is not None:
        raise OptionError("--scheduler changes nothing without --executor dask")
    if kind == "inline" or count == 1:
        yield None
        return
    # never fork: BLAS and OpenCV have threads by now
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["megloc_kapture.stages.query_poses"])
    pool: _WatchedPool | None = None
    try:
        try:
            with starting_processes():
                _name_as_ours()
                forkserver.ensure_running()
                temporary = Path(get_temp_dir())  # ends with the run
                pool = _WatchedPool(
                    count, mp_context=context, initializer=_start_worker, initargs=(temporary,)
                )
        except OSError as error:
            raise output_error(tempfile.gettempdir(), error) from error
        yield pool
    except BaseException as error:
        if pool is not None:
            # what ends the workers must not be disturbed
            with _handled_by(signal.SIG_IGN, signal.SIGINT, signal.SIGTERM):
                pool.kill()
                pool.shutdown()
        if isinstance(error, BrokenProcessPool):
            raise MeglocError(
                "a worker process died, perhaps for want of memory; try fewer with --workers"
            ) from error
        raise
    finally:
        if pool is not None:
            pool.shutdown(wait=True, cancel_futures=True)


class _WatchedPool(ProcessPoolExecutor):
    """Worker processes, with a line in the log when none of them gives a result for long.

    A worker that was stopped, or does not end, is not killed: who stopped it may let it go on.
    """

    def __init__(self, count: int, **settings: Any) -> None:
        super().__init__(count, **settings)
        self._notes = Path(tempfile.mkdtemp(prefix="notes-", dir=get_temp_dir()))
        self._tasks: dict[int, Any] = {}  # items under way or waiting, by number
        self._numbers = itertools.count()
        self._finished = 0
        self._over = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        number = next(self._numbers)
        # the first starts the workers: one that is half started could not be killed
        with nullcontext() if number else starting_processes():
            future = super().submit(_noted, self._notes, number, function, *args, **kwargs)
        self._tasks[number] = args[0] if args else function
        future.add_done_callback(lambda _: self._end(number))
        return future

    def kill(self) -> None:
        """End all workers at once, whatever they are doing."""
        for pid in list(self._processes or ()):
            with suppress(OSError):  # Process.kill does nothing where the fork server has gone
                os.kill(pid, signal.SIGKILL)
        # or the thread that reads results would wait for the rest of one for ever
        if self._result_queue is not None:
            self._result_queue._writer.close()  # type: ignore[attr-defined]

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._over.set()
        super().shutdown(wait=wait, cancel_futures=cancel_futures)
        shutil.rmtree(self._notes, ignore_errors=True)

    def _end(self, number: int) -> None:
        self._tasks.pop(number, None)
        self._finished += 1

    def _watch(self) -> None:
        patience_s, before = _PATIENCE_S, -1
        silent_since = time.monotonic()
        while not self._over.wait(min(_PATIENCE_S / 10, 1.0)):
            if self._finished != before or not self._tasks:
                patience_s, before = _PATIENCE_S, self._finished
                silent_since = time.monotonic()
            elif time.monotonic() - silent_since > patience_s:
                patience_s *= 2
                minutes = (time.monotonic() - silent_since) / 60
                _log.warning("no result for %.3g minutes: %s", minutes, self._silent())

    def _silent(self) -> str:
        """What workers are at, and which of them; one that was stopped may keep the others idle."""
        told = []
        for pid in sorted(self._processes or ()):
            item = None
            with suppress(OSError, ValueError):
                item = self._tasks.get(int((self._notes / str(pid)).read_text()))
            at = "" if item is None else f" is at {described(item)}"
            if at or _is_stopped(pid):
                stopped = " was stopped (kill -CONT lets it go on)" if _is_stopped(pid) else ""
                told.append(f"process {pid}{stopped}{' and' if at and stopped else ''}{at}")
        return "; ".join(told) or f"{len(self._tasks)} items wait for a process"


def _noted(
    notes: Path, number: int, function: Callable[..., Any], /, *args: Any, **kwargs: Any
) -> Any:
    """Call a function in a worker, and note which task it is at."""
    with suppress(OSError):  # a full disk: only the watchdog would read it
        (notes / str(os.getpid())).write_text(str(number))
    return function(*args, **kwargs)


def _is_stopped(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "Tt"
    except (OSError, IndexError):
        return False


def described(item: Any) -> str:
    """An item of work in a few words: the image or images it is of, where it says so."""
    for name in ("image", "images", "unit", "depth", "name", "path"):
        found = None if isinstance(item, Path) else getattr(item, name, None)
        if found is not None and not callable(found):
            return described(found)
    text = item if isinstance(item, str) else repr(item)
    return text if len(text) <= 80 else f"{text[:77]}..."
