"""Per-image and per-pair work: in order, with bounded memory and a progress bar.

It runs on an executor, whose processes have a processor each. What computes on a GPU of this
machine runs in this process, the only one that has it: threads read ahead, one computes batches,
and the executor has what follows.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, groupby, islice
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar
from uuid import uuid4

from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.stages.devices import most_at_once, on_gpu
from megloc_kapture.stages.kept_items import Inputs, Items, KeptItems

Item = TypeVar("Item")
Result = TypeVar("Result")
_READERS = 4  # threads that read ahead for a GPU


class Track(Protocol):
    """Shows progress: yields the items as they are, one by one."""

    def __call__(self, items: Iterable[Item], total: int, label: str) -> Iterator[Item]: ...


def untracked(items: Iterable[Item], total: int, label: str) -> Iterator[Item]:
    """A :class:`Track` that shows nothing."""
    return iter(items)


def ordered_map(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    executor: Executor | None = None,
    *,
    window: int = 32,
) -> Iterator[Result]:
    """Like ``map``, on an executor, results in order, at most ``window`` items under way.

    An executor with an attribute ``window`` has at least so many, to keep its workers busy.
    """
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
        # not on errors: a pool that breaks stumbles over futures that are cancelled meanwhile
        for future in waiting:
            future.cancel()
        raise


def batched(items: Iterable[Item], size: int) -> Iterator[list[Item]]:
    """The items in lists of at most ``size``."""
    waiting = iter(items)
    while batch := list(islice(waiting, size)):
        yield batch


@dataclass(frozen=True)
class Batched(Generic[Item, Result]):
    """A function of several items in steps, each of a module, so that a plugin gets them at once.

    Attributes
    ----------
    read : the arrays of an item.
    compute : of several items with their arrays, by the plugin; a result each.
    plugin : whose device computes.
    many : its method that takes several items; see :func:`most_at_once`.
    alike : items go together that have the same of this and stand one behind the other; None: each
        is a batch by itself.
    finish : of an item with what was computed; needs no device. None: that is the result.
    """

    read: Callable[[Item], Any]
    compute: Callable[[Sequence[Item], Sequence[Any]], Sequence[Any]]
    plugin: object
    many: str
    alike: Callable[[Item], object] | None
    finish: Callable[[tuple[Item, Any]], Result] | None = None

    def __call__(self, items: Sequence[Item]) -> Sequence[Result]:
        """All steps with items that are alike."""
        found = self.computed([(item, self.read(item)) for item in items])
        return found if self.finish is None else list(map(self.finish, found))

    def computed(self, batch: Sequence[tuple[Item, Any]]) -> list[Any]:
        """What the last step takes, of items that are alike with their arrays."""
        items, arrays = zip(*batch, strict=True)
        found = self.compute(items, arrays)
        return list(found if self.finish is None else zip(items, found, strict=True))


@dataclass(frozen=True)
class Work:
    """Where the work of a stage is done, and who is told how far it is.

    Attributes
    ----------
    executor : None stands for this process.
    num_threads : for what has threads of its own, as COLMAP's triangulation.
    kept : what runs before have done of it; None where nothing is kept.
    """

    executor: Executor | None = None
    track: Track = untracked
    num_threads: int = 1
    kept: KeptItems | None = None

    def map(
        self,
        function: Callable[[Item], Result] | Batched[Item, Result],
        items: Iterable[Item],
        label: str,
        total: int | None = None,
        *,
        plugins: Sequence[object] = (),
    ) -> Iterator[Result]:
        """Results in the order of the items, with a progress bar.

        Parameters
        ----------
        function : of a module, so that it can be sent to another process; or :class:`Batched`.
        items : paths and numbers; arrays of an image are read where the work is done.
        total : number of items, where they have no length.
        plugins : those that the function calls. Where one of them computes on a GPU of this
            machine, threads of this process do the work, and no other process takes memory of it.
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
        with ThreadPoolExecutor(_READERS) if in_threads else nullcontext(self.executor) as executor:
            yield from ordered_map(function, items, executor)

    def _has_gpu(self, plugins: Sequence[object]) -> bool:
        # machines of a cluster have GPUs of their own
        return not getattr(self.executor, "is_elsewhere", False) and any(map(on_gpu, plugins))

    def _in_batches(self, steps: Batched[Item, Result], items: Iterable[Item]) -> Iterator[Result]:
        alike = steps.alike or (lambda _: None)
        most = 1 if steps.alike is None else most_at_once(steps.plugin, steps.many)
        if not self._has_gpu([steps.plugin]):
            batches = _alike(items, most, alike)
            yield from chain.from_iterable(ordered_map(steps, batches, self.executor))
            return
        # threads read ahead of the one that computes, while what it had computed is finished
        with ThreadPoolExecutor(_READERS) as readers, ThreadPoolExecutor(1) as computing:
            ahead = most + _READERS
            read = ordered_map(lambda one: (one, steps.read(one)), items, readers, window=ahead)
            ready = _alike(read, most, lambda pair: alike(pair[0]))
            found = chain.from_iterable(ordered_map(steps.computed, ready, computing, window=2))
            if steps.finish is None:  # no other process need see it
                yield from found
            else:
                yield from ordered_map(steps.finish, found, self.executor)

    def items(self, kind: str, names: Sequence[str], inputs: Inputs) -> Items:
        """Items that do not depend on each other: those that are done, and what notes new ones.

        Parameters
        ----------
        kind : of the items, where a stage has several.
        inputs : what an item is made of beside the stage's settings and its own name; asked for
            only where something may be kept.
        """
        return Items.of(self.kept, kind, names, inputs)


def _alike(
    items: Iterable[Item], size: int, alike: Callable[[Item], object]
) -> Iterator[list[Item]]:
    for _, group in groupby(items, key=alike):
        yield from batched(group, size)


HERE = Work()


class FolderSpec:
    """A kapture folder as work items name it: cheap to send, opened once per process and run."""

    def __init__(self, folder: KaptureFolder) -> None:
        self.key = (folder.root, folder.features_dirs, folder.allow_links_below, uuid4().hex)

    def open(self) -> KaptureFolder:
        """The folder; the same object for every item of this run in this process."""
        return _open_folder(*self.key)


@lru_cache(maxsize=8)
def _open_folder(
    root: Path,
    features_dirs: tuple[Path, ...],
    allow_links_below: tuple[Path, ...],
    run_id: str,
) -> KaptureFolder:
    return KaptureFolder(root, features_dirs=features_dirs, allow_links_below=allow_links_below)
