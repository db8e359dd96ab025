"""Context of a run: ordered work with bounded memory and a progress bar, batches of networks.

Work runs on an executor with one core per process. Networks on a GPU of this machine run in threads
of this process only, one batch at a time.
"""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, groupby, islice
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

from megloc_kapture.errors import MeglocError, PluginError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.plugin_loading import AUTO, Placement

Item = TypeVar("Item")
Result = TypeVar("Result")

BATCH = 8  # for batch plugins without a device option
MOST_AT_ONCE = {"cpu": 1, "cuda": 16}


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
    """Run a plugin on items in batches, halved when memory runs out.

    Raise MeglocError if one item does not fit.
    """
    key = type(plugin).__qualname__, many, repr(getattr(plugin, "options", None))
    found: list[Result] = []
    while len(found) < len(items):
        most = min(most_at_once(plugin, many), _limits.get(key, sys.maxsize))
        batch = items[len(found) :][:most]
        try:
            with _gpu if on_gpu(plugin) else nullcontext():
                results = run(batch)
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            if len(batch) == 1:
                raise MeglocError(
                    f"{name(len(found))}: there is not enough memory for it alone; make images "
                    "smaller (max_megapixels, preprocessing.max_size_px), keep fewer keypoints, or "
                    "compute on another device (--device)"
                ) from error
            _limits[key] = len(batch) // 2
            continue
        if len(results) != len(batch):
            raise PluginError(f"{many} of {key[0]} gave {len(results)} for {len(batch)} items")
        found += results
    return found


# of plain RuntimeErrors: allocation by the CPU, by CUDA contexts, cuBLAS and cuDNN
_OUT_OF_MEMORY = (
    "can't allocate memory",
    "out of memory",
    "CUBLAS_STATUS_ALLOC_FAILED",
    "CUDNN_STATUS_ALLOC_FAILED",
    "CUDNN_STATUS_INTERNAL_ERROR_HOST_ALLOCATION_FAILED",
    "CUDNN_STATUS_INTERNAL_ERROR_DEVICE_ALLOCATION_FAILED",
)


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether torch ran out of memory, on any device and in any library below it."""
    torch: Any = sys.modules.get("torch")
    if torch is None or not isinstance(error, RuntimeError):
        return False
    return isinstance(error, torch.OutOfMemoryError) or any(
        text in str(error) for text in _OUT_OF_MEMORY
    )


_THREADS = 4  # that share a plugin on a GPU
_gpu = threading.Lock()  # as one batch may fill the memory


Track = Callable[[Iterable[Any], int, str], Iterator[Any]]
"""Progress display of items, their number and a label; yields the items unchanged."""


def untracked(items: Iterable[Item], total: int, label: str) -> Iterator[Item]:
    return iter(items)


def ordered_map(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    executor: Executor | None = None,
    *,
    window: int = 32,
) -> Iterator[Result]:
    """Map on an executor, in order, with at most ``window`` items in flight."""
    if executor is None:
        yield from map(function, items)
        return
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
        # not on errors: a breaking pool fails on futures that were cancelled meanwhile
        for future in waiting:
            future.cancel()
        raise


def batched(items: Iterable[Item], size: int) -> Iterator[list[Item]]:
    waiting = iter(items)
    while batch := list(islice(waiting, size)):
        yield batch


@dataclass(frozen=True)
class Work:
    """Execution context of a stage.

    Attributes
    ----------
    executor : None means this process.
    num_threads : for libraries with internal threads, such as COLMAP.
    resume : skip items whose output files an interrupted run has written.
    force : continue despite contradictory input data.
    placement : device and precision of networks.
    """

    executor: Executor | None = None
    track: Track = untracked
    num_threads: int = 1
    resume: bool = False
    force: bool = False
    placement: Placement = AUTO

    def map(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        label: str,
        total: int | None = None,
        *,
        plugins: Sequence[object] = (),
    ) -> Iterator[Result]:
        """Yield results in the order of the items, with a progress bar.

        ``function`` must be picklable. If one of its ``plugins`` uses a GPU of this machine,
        threads of this process do the work, so that no other process takes GPU memory.
        """
        if total is None:
            items = items if isinstance(items, Sequence) else list(items)
            total = len(items)
        return self.track(self._results(function, items, plugins), total, label)

    def map_batches(
        self,
        function: Callable[[Sequence[Item]], Sequence[Result]],
        items: Sequence[Item],
        label: str,
        *,
        plugin: object,
        many: str,
        alike: Callable[[Item], object],
    ) -> Iterator[Result]:
        """Yield the results of a function of several items, as :meth:`map` does.

        ``many`` is the batch method of the plugin; consecutive items with equal keys ``alike`` can
        share a batch.
        """
        most = most_at_once(plugin, many)
        groups = (group for _, group in groupby(items, key=alike))
        batches = (some for group in groups for some in batched(group, most))
        results = self._results(function, batches, (plugin,))
        return self.track(chain.from_iterable(results), len(items), label)

    def _results(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        plugins: Sequence[object],
    ) -> Iterator[Result]:
        # cluster machines have separate GPUs
        in_threads = not getattr(self.executor, "is_elsewhere", False) and any(map(on_gpu, plugins))
        with ThreadPoolExecutor(_THREADS) if in_threads else nullcontext(self.executor) as executor:
            yield from ordered_map(function, items, executor)

    def unfinished(self, items: Iterable[Item], is_written: Callable[[Item], bool]) -> list[Item]:
        """Return the items that an interrupted run of the stage has not written."""
        return [item for item in items if not (self.resume and is_written(item))]


def resumed_label(text: str, total: int, todo: int) -> str:
    return f"{text}, {total - todo} kept" if todo < total else text


HERE = Work()


class FolderSpec:
    """A kapture folder that is cheap to pickle and opened once per process and run."""

    def __init__(self, folder: KaptureFolder) -> None:
        self.key = (folder.root, folder.features_dirs, folder.allow_links_below, uuid4().hex)

    def open(self) -> KaptureFolder:
        return open_folder(*self.key)


@lru_cache(maxsize=8)
def open_folder(
    root: Path, features_dirs: tuple[Path, ...], links_below: tuple[Path, ...], run_id: str
) -> KaptureFolder:
    return KaptureFolder(root, features_dirs=features_dirs, allow_links_below=links_below)
