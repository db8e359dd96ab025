"""Per-image and per-pair work: in order, with bounded memory and a progress bar.

It runs on an executor, whose processes have a processor each. Networks on a GPU of this machine
run in this process, the only one that has it: threads read ahead, one computes batches, and the
executor does what follows.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import chain, groupby, islice
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar
from uuid import uuid4

from megloc_kapture.io.files import output_error
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.stages.devices import most_at_once, on_gpu


class FinishedItems:
    """The finished items of a stage, which a stopped run leaves for the next one.

    The first line of the file is the stage's fingerprint. A line of JSON per item follows,
    appended once the item's files are written.
    """

    def __init__(self, path: Path, fingerprint: str) -> None:
        self._path, self._fingerprint = path, fingerprint
        self._found: dict[tuple[str, str], Any] = {}
        for line in self._lines():
            try:
                kind, name, values = json.loads(line)
            except ValueError:  # cut when the run was killed
                continue
            self._found[kind, name] = values
        self.num_kept = len(self._found)

    def _lines(self) -> list[str]:
        if not is_resumable(self._path, self._fingerprint):
            return []
        return self._path.read_text(encoding="utf-8", errors="replace").splitlines()[1:]

    def of(self, kind: str) -> dict[str, Any]:
        """Return the items of one kind: name to the values that were noted."""
        return {name: values for (of, name), values in self._found.items() if of == kind}

    def add(self, kind: str, name: str, values: Any) -> None:
        """Note a finished item with plain JSON values."""
        try:
            with open(self._path, "a", encoding="utf-8") as file:
                if file.tell() == 0:
                    file.write(f"{self._fingerprint}\n")
                file.write(json.dumps([kind, name, values]) + "\n")
        except OSError as error:
            raise output_error(self._path, error) from error


def is_resumable(path: Path, fingerprint: str) -> bool:
    """Return whether a file of finished items belongs to a stage with this fingerprint."""
    if not path.is_file():
        return False
    with open(path, encoding="utf-8", errors="replace") as file:
        return file.readline() == f"{fingerprint}\n"


@dataclass
class Items:
    """Items of one kind: the finished ones, with the values noted for each."""

    kind: str = ""
    done: dict[str, Any] = field(default_factory=dict)
    finished: FinishedItems | None = None

    def label(self, text: str) -> str:
        """Return the label of a progress bar, with the number of items that are kept."""
        return f"{text}, {len(self.done)} kept" if self.done else text

    def add(self, name: str, values: Any = None) -> None:
        """Note that an item is finished; its files must be written."""
        self.done[name] = values
        if self.finished is not None:
            self.finished.add(self.kind, name, values)


Item = TypeVar("Item")
Result = TypeVar("Result")
_READERS = 4  # threads that read ahead for a GPU


class Track(Protocol):
    """Shows progress: yields the items as they are, one by one."""

    def __call__(self, items: Iterable[Item], total: int, label: str) -> Iterator[Item]: ...


def untracked(items: Iterable[Item], total: int, label: str) -> Iterator[Item]:
    """Show nothing; see :class:`Track`."""
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
    """Where the work of a stage runs, and how its progress is shown.

    Attributes
    ----------
    executor : None stands for this process.
    num_threads : for what has threads of its own, as COLMAP's triangulation.
    finished : items that a stopped run has finished; None outside a workspace.
    force : go on where the given data contradict themselves.
    """

    executor: Executor | None = None
    track: Track = untracked
    num_threads: int = 1
    finished: FinishedItems | None = None
    force: bool = False

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

    def items(self, kind: str) -> Items:
        """Return the items of a kind that a stopped run of the stage has finished."""
        if self.finished is None:
            return Items()
        return Items(kind, self.finished.of(kind), self.finished)


def _alike(
    items: Iterable[Item], size: int, alike: Callable[[Item], object]
) -> Iterator[list[Item]]:
    for _, group in groupby(items, key=alike):
        yield from batched(group, size)


HERE = Work()


class FolderSpec:
    """A kapture folder that is cheap to send and opened once per process and run."""

    def __init__(self, folder: KaptureFolder) -> None:
        self.key = (folder.root, folder.features_dirs, folder.allow_links_below, uuid4().hex)

    def open(self) -> KaptureFolder:
        """The folder; the same object for every item of this run in this process."""
        return _open_folder(*self.key)


@lru_cache(maxsize=8)
def _open_folder(
    root: Path, features_dirs: tuple[Path, ...], links_below: tuple[Path, ...], run_id: str
) -> KaptureFolder:
    return KaptureFolder(root, features_dirs=features_dirs, allow_links_below=links_below)
