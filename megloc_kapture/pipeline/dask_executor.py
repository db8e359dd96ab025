"""Executor on a running dask.distributed cluster, or on a local one.

Items contain only paths and numbers, and the workers read the files. Therefore the workspace, the
data and the current folder must have the same paths on every machine.
"""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from distributed import Client, KilledWorker, LocalCluster, Worker, WorkerPlugin
from distributed.comm.addressing import get_address_host_port

from megloc_kapture.errors import MeglocError, OptionError, check_option
from megloc_kapture.pipeline.executors import enter_single_threaded

_CONNECT_S = 10.0
# tolerates dead workers, but not an item that kills more than ten of them
_ALLOWED_FAILURES = 10
_ITEMS_PER_WORKER = 4
_PACKAGES = ["megloc_kapture", "numpy", "torch"]


def _check_versions(versions: Mapping[str, Any]) -> None:
    """Raise MeglocError if a worker's package version differs from this process's."""
    here = versions["client"]["packages"]
    for address, worker in versions["workers"].items():
        there = worker["packages"]
        for name in _PACKAGES:
            if there[name] not in (here[name], None):  # missing packages fail with their own error
                raise MeglocError(
                    f"package versions differ on the cluster: worker {address} has {name} "
                    f"{there[name]}, here it is {here[name]}"
                )


@contextmanager
def dask_executor(workers: int, scheduler: str | None, shared: Path) -> Iterator[Executor]:
    """Open an executor on the dask ``scheduler`` (address), or on a local cluster of ``workers``.

    All workers must see the folder ``shared``.
    """
    import dask

    for name in ("distributed", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    settings = {
        "distributed.scheduler.allowed-failures": _ALLOWED_FAILURES,
        "distributed.comm.timeouts.connect": f"{_CONNECT_S} s",
    }
    with dask.config.set(settings), ExitStack() as stack:
        client = _client(stack, workers, scheduler)
        threads = sum(client.nthreads().values())
        check_option(threads, f"the scheduler {scheduler} has no workers: start some (dask worker)")
        versions: Any = client.get_versions(packages=_PACKAGES)
        _check_versions(versions)
        try:
            shared.mkdir(parents=True, exist_ok=True)
            client.register_plugin(_Preparation(Path.cwd(), shared.absolute()))
            executor: Any = client.get_executor(pure=False)
            executor.window = _ITEMS_PER_WORKER * threads
            # workers of a scheduler may be on other machines, with their own GPUs
            executor.is_elsewhere = scheduler is not None
            yield executor
        except KilledWorker as error:
            raise MeglocError(
                "one work item killed too many workers, perhaps out of memory; "
                "try fewer workers per machine"
            ) from error
        except ModuleNotFoundError as error:
            if error.name != "megloc_kapture":
                raise
            raise MeglocError("the workers have no megloc_kapture: install it there") from error


def _client(stack: ExitStack, workers: int, scheduler: str | None) -> Client:
    if scheduler is not None:
        try:
            get_address_host_port(scheduler, strict=True)  # a client without a port fails late
            client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise OptionError(
                f"there is no dask scheduler at {scheduler}; give an address tcp://HOST:PORT"
            ) from error
        return stack.enter_context(client)
    folder = stack.enter_context(
        tempfile.TemporaryDirectory(prefix="megloc-", ignore_cleanup_errors=True)
    )
    cluster = LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        dashboard_address="127.0.0.1:0",
        local_directory=folder,
        memory_limit=0,
        silence_logs=logging.CRITICAL,
    )
    return stack.enter_context(Client(stack.enter_context(cluster), set_as_default=False))


@dataclass
class _Preparation(WorkerPlugin):
    folder: Path  # current folder, base of relative paths
    shared: Path
    name = "megloc"

    def setup(self, worker: Worker) -> None:
        try:
            self.shared.stat()
            os.chdir(self.folder)
        except OSError as error:
            raise MeglocError(
                f"worker {worker.address} does not see {error.filename}: a cluster needs a file "
                "system that all machines share, at the same path"
            ) from error
        enter_single_threaded()
