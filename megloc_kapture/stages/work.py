"""Execution context: ordered work with bounded memory, a progress bar, and network batches.

Work runs on an executor with one core per process. Networks on a GPU of this machine run only in
this process. In that case batched work (:class:`Batched`) is pipelined: threads read items ahead,
one thread computes the batches, and the executor runs the last step.
"""

from __future__ import annotations

import os
import pickle
import sys
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import chain, groupby, islice
from typing import Any, Generic, TypeVar

from megloc_kapture.errors import MeglocError, PluginError
from megloc_kapture.plugin_loading import AUTO, NetworkOptions

Item = TypeVar("Item")
Result = TypeVar("Result")

BATCH = 8  # batch size of plugins that have a batch method, but no device option
MOST_AT_ONCE = {"cpu": 1, "cuda": 16}  # batch size by device


def on_gpu(plugin: object) -> bool:
    return _device_of(plugin) not in (None, "cpu")


def most_at_once(plugin: object, many: str) -> int:
    """Return the batch size of a plugin; 1 without the batch method ``many``."""
    if not hasattr(plugin, many):
        return 1
    device = _device_of(plugin)
    return BATCH if device is None else MOST_AT_ONCE[device.partition(":")[0]]


def _device_of(plugin: object) -> str | None:
    """Return cpu, cuda or cuda:N; None if unspecified."""
    wanted = getattr(getattr(plugin, "options", None), "device", None)
    if wanted is None or wanted == "cpu":
        return wanted
    from megloc_kapture.nets.runtime import pick_device

    return str(pick_device(wanted))


_limits: dict[tuple[str, str, str], int] = {}  # batch sizes after running out of memory


def in_batches(
    plugin: object,
    many: str,
    run: Callable[[Sequence[Item]], Sequence[Result]],
    items: Sequence[Item],
    *,
    name: Callable[[int], str],
) -> list[Result]:
    """Run a plugin on items in batches; halve the batches when memory runs out.

    Raise MeglocError if the memory is too small for a single item.
    """
    key = type(plugin).__qualname__, many, repr(getattr(plugin, "options", None))
    finished: list[Result] = []
    while len(finished) < len(items):
        most = min(most_at_once(plugin, many), _limits.get(key, sys.maxsize))
        batch = items[len(finished) :][:most]
        try:
            results = list(run(batch))
        except Exception as error:  # plugins may raise anything
            if not is_out_of_memory(error):
                error.add_note(f"{key[0]} failed on {name(len(finished))}")
                raise
            if len(batch) == 1:
                raise MeglocError(
                    f"{name(len(finished))}: not enough memory, even without batching; make images "
                    "smaller (max_megapixels, preprocessing.max_size_px), keep fewer keypoints, or "
                    "compute on another device (--device)"
                ) from error
            _limits[key] = len(batch) // 2
            continue
        if len(results) != len(batch):
            raise PluginError(
                f"{many} of {key[0]} returned {len(results)} results for {len(batch)} items"
            )
        finished += results
    return finished


# messages of plain RuntimeErrors from the CPU allocator, CUDA contexts, cuBLAS and cuDNN
_OUT_OF_MEMORY = (
    "can't allocate memory",
    "out of memory",
    "CUBLAS_STATUS_ALLOC_FAILED",
    "CUDNN_STATUS_ALLOC_FAILED",
    "CUDNN_STATUS_INTERNAL_ERROR_HOST_ALLOCATION_FAILED",
    "CUDNN_STATUS_INTERNAL_ERROR_DEVICE_ALLOCATION_FAILED",
)


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether torch ran out of memory, on any device and in any underlying library."""
    torch: Any = sys.modules.get("torch")
    if torch is None or not isinstance(error, RuntimeError):
        return False
    return isinstance(error, torch.OutOfMemoryError) or any(
        text in str(error) for text in _OUT_OF_MEMORY
    )


_READERS = min(os.cpu_count() or 1, 16)  # threads that read items ahead for a GPU
_THREADS = 4  # threads that share a plugin on a GPU


Track = Callable[[Iterable[Any], int, str], Iterator[Any]]
"""Progress display: takes items, their number and a label, and yields the items unchanged."""


def untracked(items: Iterable[Item], total: int, label: str) -> Iterator[Item]:
    return iter(items)


def ordered_map(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    executor: Executor | None = None,
    *,
    window: int = 32,
) -> Iterator[Result]:
    """Map on an executor, in order, with at most ``window`` items in flight (Dask: maybe more)."""
    if executor is None:
        yield from map(function, items)
        return
    if isinstance(executor, ProcessPoolExecutor):
        try:
            pickle.dumps(function)
        except Exception as error:  # plugins define how they are pickled
            raise PluginError(
                f"a plugin cannot be sent to other processes: {error}; let a function with "
                "functools.lru_cache create such objects, or use --executor inline"
            ) from error
    window = max(window, getattr(executor, "window", 0))
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(executor.submit(function, item))
            if len(waiting) >= window:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    except GeneratorExit:
        # cancel only here: after an error, a broken pool fails on cancelled futures
        for future in waiting:
            future.cancel()
        raise


def batched(items: Iterable[Item], size: int) -> Iterator[list[Item]]:
    waiting = iter(items)
    while batch := list(islice(waiting, size)):
        yield batch


@dataclass(frozen=True)
class Batched(Generic[Item, Result]):
    """A function on batches of items, split into picklable steps.

    Attributes
    ----------
    read : reads the arrays of an item.
    compute : returns one result per item; calls ``plugin``.
    many : name of the plugin's batch method.
    alike : key of an item; consecutive items with equal keys share a batch. None: batches of one.
    finish : optional last step for an item and its result; needs no device.
    """

    read: Callable[[Item], Any]
    compute: Callable[[Sequence[Item], Sequence[Any]], Sequence[Any]]
    plugin: object
    many: str
    alike: Callable[[Item], object] | None
    finish: Callable[[tuple[Item, Any]], Result] | None = None

    def __call__(self, items: Sequence[Item]) -> Sequence[Result]:
        results = self.computed([(item, self.read(item)) for item in items])
        return results if self.finish is None else list(map(self.finish, results))

    def computed(self, batch: Sequence[tuple[Item, Any]]) -> list[Any]:
        items, arrays = zip(*batch, strict=True)
        results = self.compute(items, arrays)
        return list(results if self.finish is None else zip(items, results, strict=True))


@dataclass(frozen=True)
class Work:
    """Execution context of a stage.

    Attributes
    ----------
    executor : None means this process.
    num_threads : number of threads of libraries with internal threads, such as COLMAP.
    resume : skip items whose output files an interrupted run has written.
    force : continue even if most given poses contradict the matches.
    placement : device and precision of networks.
    """

    executor: Executor | None = None
    track: Track = untracked
    num_threads: int = 1
    resume: bool = False
    force: bool = False
    placement: NetworkOptions = AUTO

    def map(
        self,
        function: Callable[[Item], Result] | Batched[Item, Result],
        items: Iterable[Item],
        label: str,
        total: int | None = None,
        *,
        plugins: Sequence[object] = (),
    ) -> Iterator[Result]:
        """Yield results in the order of the items, with a progress bar.

        ``function`` must be picklable. ``plugins`` are those that it calls; a :class:`Batched`
        names its own. If a plugin uses a GPU of this machine, threads of this process do the work,
        so that no other process takes GPU memory.
        """
        if total is None:
            items = items if isinstance(items, Sequence) else list(items)
            total = len(items)
        if isinstance(function, Batched):
            results = self._in_batches(function, items)
        else:
            results = self._one_by_one(function, items, self._has_gpu(plugins))
        return self.track(results, total, label)

    def _one_by_one(
        self, function: Callable[[Item], Result], items: Iterable[Item], in_threads: bool
    ) -> Iterator[Result]:
        with ThreadPoolExecutor(_THREADS) if in_threads else nullcontext(self.executor) as executor:
            yield from ordered_map(function, items, executor)

    def _has_gpu(self, plugins: Sequence[object]) -> bool:
        # workers on other machines do not use the GPU of this machine
        return not getattr(self.executor, "is_elsewhere", False) and any(map(on_gpu, plugins))

    def _in_batches(self, steps: Batched[Item, Result], items: Iterable[Item]) -> Iterator[Result]:
        alike = steps.alike or (lambda _: None)
        most = 1 if steps.alike is None else most_at_once(steps.plugin, steps.many)
        if not self._has_gpu([steps.plugin]):
            batches = _alike(items, most, alike)
            yield from chain.from_iterable(ordered_map(steps, batches, self.executor))
            return
        # reading ahead and finishing overlap with computing
        with ThreadPoolExecutor(_READERS) as readers, ThreadPoolExecutor(1) as computing:
            ahead = most + _READERS
            read = ordered_map(lambda item: (item, steps.read(item)), items, readers, window=ahead)
            ready = _alike(read, most, lambda pair: alike(pair[0]))
            results = chain.from_iterable(ordered_map(steps.computed, ready, computing, window=2))
            if steps.finish is None:
                yield from results
            else:
                yield from ordered_map(steps.finish, results, self.executor)

    def unfinished(
        self, items: Collection[Item], is_written: Callable[[Item], bool], label: str
    ) -> tuple[list[Item], str]:
        """Return the items that an interrupted run of the stage has not written, and a label."""
        todo = [item for item in items if not (self.resume and is_written(item))]
        kept = len(items) - len(todo)
        return todo, f"{label}, {kept} kept" if kept else label


def _alike(
    items: Iterable[Item], size: int, alike: Callable[[Item], object]
) -> Iterator[list[Item]]:
    for _, group in groupby(items, key=alike):
        yield from batched(group, size)


HERE = Work()
