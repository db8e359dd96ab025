"""Work on a cluster of dask.distributed: one that runs already, or one of local processes.

Items of work are paths and numbers, and workers read what these name; so the workspace, the data
and this process's current folder must be at the same paths on every machine. Each worker, also one
that joins later, is asked for that and for equal packages and weights before it gets work.
"""

from __future__ import annotations

import asyncio
import logging
import os
import platform
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future, InvalidStateError
from concurrent.futures import wait as wait_for
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from distributed import Client, KilledWorker, LocalCluster, Worker, WorkerPlugin
from distributed.client import ClosedClientError
from distributed.comm.core import CommClosedError

from megloc_kapture.errors import MeglocError, OptionError
from megloc_kapture.evaluation.pose_files import installed_version
from megloc_kapture.io.files import clear_leftovers, owned_name
from megloc_kapture.io.weights import describe, files_of, registry, sha256_of, share_weights
from megloc_kapture.pipeline.executors import enter_single_threaded, starting_processes

# the last bits of a result depend on these
_PACKAGES = (
    *("megloc-kapture", "numpy", "scipy", "numba", "opencv-python-headless", "pillow"),
    *("pycolmap", "poselib", "kapture", "torch", "kornia", "small-gicp"),
)
_CONNECT_S = 10.0
# a worker that died is no fault of the item it was at; one that kills ten is
_ALLOWED_FAILURES = 10
_ITEMS_PER_WORKER = 4
_WATCH_S = 0.5
# a client that has given its scheduler up has none, or a closed pool, or one that it cannot close
_WITHOUT_SCHEDULER = (CommClosedError, OSError, TimeoutError, AttributeError, RuntimeError)
# what dask does by the clock, 50 times a second in each process unless told otherwise: 8 % of a
# core for two workers that wait, 1 % so
_QUIET = {
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.scheduler.active-memory-manager.start": False,
    "distributed.scheduler.work-stealing-interval": "1s",
    "distributed.worker.profile.enabled": False,
}


@contextmanager
def dask_executor(workers: int, scheduler: str | None, shared: Path) -> Iterator[_ClusterExecutor]:
    """An executor whose items run on dask workers.

    Parameters
    ----------
    workers : processes of a local cluster; with a scheduler it says nothing.
    scheduler : address of a running one, as ``tcp://10.0.0.1:8786``; None: a local cluster.
    shared : folder that all workers must see as this process does; made where it is absent.

    Raises
    ------
    OptionError : there is no scheduler at the address, or it has no workers.
    MeglocError : a worker differs, is named with the difference; or the scheduler went away.
    """
    with _client(workers, scheduler) as client:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            raise OptionError(f"the scheduler {scheduler} has no workers: start some (dask worker)")
        plugin = _Preparation.of_this_process(shared, elsewhere=scheduler is not None)
        try:
            client.register_plugin(plugin, name="megloc")
            executor = _ClusterExecutor(client, is_elsewhere=scheduler is not None)
            try:
                yield executor
            finally:
                executor.over.set()
        except (CancelledError, CommClosedError, ClosedClientError) as error:
            raise MeglocError(
                f"the scheduler {scheduler or 'of the local cluster'} has gone; what is finished "
                "is kept, run the same again to go on"
            ) from error
        except KilledWorker as error:
            raise MeglocError(
                f"an item of work killed {_ALLOWED_FAILURES} workers, perhaps for want of memory; "
                "try fewer workers on a machine"
            ) from error
        except ModuleNotFoundError as error:
            if error.name != "megloc_kapture":
                raise
            raise MeglocError("the workers have no megloc_kapture: install it there") from error
        finally:
            plugin.token.unlink(missing_ok=True)
            with suppress(*_WITHOUT_SCHEDULER):
                client.unregister_worker_plugin("megloc")


@contextmanager
def _client(workers: int, scheduler: str | None) -> Iterator[Client]:
    import dask

    for name in ("distributed", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    settings = {
        "distributed.scheduler.allowed-failures": _ALLOWED_FAILURES,
        "distributed.comm.timeouts.connect": f"{_CONNECT_S} s",
        **_QUIET,
    }
    with dask.config.set(settings):
        if scheduler is not None:
            try:
                client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
            except (OSError, ValueError, TypeError) as error:
                raise OptionError(f"there is no dask scheduler at {scheduler}") from error
            with _closing(client):
                yield client
            return
        clear_leftovers(Path(tempfile.gettempdir()))
        folder = tempfile.mkdtemp(prefix=owned_name())
        try:
            with ExitStack() as stack:
                with starting_processes():
                    cluster = LocalCluster(
                        n_workers=workers,
                        threads_per_worker=1,
                        dashboard_address="127.0.0.1:0",
                        local_directory=folder,
                        memory_limit=0,  # memory is the system's to give, as to other processes
                        silence_logs=logging.CRITICAL,
                    )
                    stack.enter_context(cluster)
                # results need not pass through the scheduler
                client = Client(cluster, set_as_default=False, direct_to_workers=True)
                yield stack.enter_context(_closing(client))
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _closing(client: Client) -> Iterator[Client]:
    """Close it behind; what fails in that says nothing of the work, and hides no error of it."""
    try:
        yield client
    finally:
        with suppress(*_WITHOUT_SCHEDULER):
            client.close()


class _ClusterExecutor(Executor):
    """Runs functions on a client's workers; they may give something else each time.

    dask's own executor looks at a task's state after its result has come, and raises an error of
    its own making where the worker that had the result has died in between.

    Attributes
    ----------
    window : items that keep all workers busy.
    is_elsewhere : its machines have GPUs of their own, if any.
    over : set where nothing is waited for any more.
    """

    def __init__(self, client: Client, *, is_elsewhere: bool) -> None:
        self.is_elsewhere = is_elsewhere
        self.over = threading.Event()
        self._client = client
        self._loop: Any = client.loop
        self._waiting: set[Future[Any]] = set()
        threading.Thread(target=self._watch, daemon=True).start()
        threads = sum(one["nthreads"] for one in client.scheduler_info(-1)["workers"].values())
        self.window = _ITEMS_PER_WORKER * max(threads, 1)

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """A future of the result, which a worker computes with one thread per matrix product."""
        call = partial(_single_threaded, function, *args, **kwargs)
        task, found = self._client.submit(call, pure=False), Future[Any]()

        def ended(_: Future[Any]) -> None:
            self._waiting.discard(found)
            if found.cancelled() and task.status != "cancelled":
                task.cancel()

        self._waiting.add(found)
        found.add_done_callback(ended)
        self._loop.add_callback(self._deliver, task, found)
        return found

    async def _deliver(self, task: Any, found: Future[Any]) -> None:
        try:
            result = await self._client.gather(task, asynchronous=True)
        except (CancelledError, asyncio.CancelledError):
            if found.cancel():
                found.set_running_or_notify_cancel()  # which wakes who waits for several
        except BaseException as error:
            with suppress(InvalidStateError):  # it was given up meanwhile
                found.set_exception(error)
        else:
            with suppress(InvalidStateError):
                found.set_result(result)

    def _watch(self) -> None:
        """End futures of a scheduler that has gone: dask forgets what is asked while it reconnects,
        and who waits for that would wait for ever."""
        while not self.over.wait(_WATCH_S):
            if self._client.status == "closed":
                for future in list(self._waiting):
                    with suppress(InvalidStateError):
                        future.set_exception(CommClosedError("the scheduler has gone"))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for what is under way, or cancel it."""
        under_way = list(self._waiting)
        if wait and not cancel_futures:
            wait_for(under_way)
        for future in under_way:
            future.cancel()


_prepared = threading.local()


def _single_threaded(function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
    if not getattr(_prepared, "done", False):
        enter_single_threaded()  # for good
        _prepared.done = True
    return function(*args, **kwargs)


@dataclass
class _Preparation(WorkerPlugin):
    """Makes a worker like the process that has the run, or refuses it."""

    packages: dict[str, str]  # versions, of Python too
    weights: dict[str, str]  # sha256 of the files of networks that this process has
    folder: Path  # the current one, which relative paths start from
    token: Path  # a file in the shared folder
    elsewhere: bool  # the workers were there before, and stay
    name = "megloc"

    @classmethod
    def of_this_process(cls, shared: Path, *, elsewhere: bool) -> _Preparation:
        shared.mkdir(parents=True, exist_ok=True)
        handle, token = tempfile.mkstemp(prefix=f".{owned_name()}", dir=shared.resolve())
        os.close(handle)
        weights = _weights() if elsewhere else {}
        return cls(_packages(), weights, Path.cwd(), Path(token), elsewhere)

    def setup(self, worker: Worker) -> None:
        """Raise MeglocError where the worker differs."""
        import cv2

        where = f"worker {worker.address}"
        for name, version in _packages().items():
            if version != self.packages.get(name):
                here = self.packages.get(name, "none")
                raise MeglocError(f"{where} has {name} {version}, this process {here}")
        try:
            os.chdir(self.folder)
            self.token.stat()
        except OSError as error:
            raise MeglocError(
                f"{where} does not see {error.filename}: a cluster needs a file system that all "
                "machines share, at the same path"
            ) from error
        own = _weights() if self.weights else {}
        for name, sha256 in self.weights.items():
            if own.get(name) != sha256:
                there = "other weights" if name in own else "no weights"
                raise MeglocError(f"{where} has {there} of {name} (megloc weights list)")
        if not self.elsewhere:  # their folder goes with the run
            share_weights(Path(worker.local_directory).parent)
        cv2.setNumThreads(1)


def _packages() -> dict[str, str]:
    """Versions of what computes; "none" of what is not there."""
    found = {"Python": platform.python_version(), "machine": f"{sys.platform} {platform.machine()}"}
    return found | {name: installed_version(name) or "none" for name in _PACKAGES}


def _weights() -> dict[str, str]:
    found = {}
    for weights in registry().values():
        path = next(files_of(weights), None)
        if path is not None:
            found[weights.name] = sha256_of(describe(weights.name, path))
    return found
