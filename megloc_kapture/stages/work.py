"""Per-image and per-pair work: in order, with bounded memory, a progress bar and a journal.

It runs on an executor, whose processes have a processor each. What computes on a GPU of this
machine runs in this process, the only one that has it: threads read ahead, one computes batches,
and the executor has what follows.

A stage that is at work lists what it has done in the journal, a line per item: a hash of all that
the item is made of (the stage's settings, the code of its plugins, the content of what is read),
the files it became, and what the stage wants to know of it later. The next run takes over the
items whose hash is the same and whose files are as they were written, from what stopped runs have
left and from the finished output, by links; so it ends in the bytes that it would have made. A line
follows its files, and half a line is none: whenever a run is killed, what is taken over is whole.
"""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import chain, groupby, islice
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol, TypeVar
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import check_relative, hard_link, output_error
from megloc_kapture.io.kapture import FeatureReader, KaptureFolder
from megloc_kapture.io.output_folders import FileState, state_if_unchanged, state_of
from megloc_kapture.stages.devices import most_at_once, on_gpu

Digest = Callable[[Path], str]
"""Hash of a file's content; raises DataError where it cannot be read."""
Inputs = Callable[[str, Digest], object]
"""What an item of a name is made of, as plain JSON values."""


def feature_inputs(reader: FeatureReader, image: str, digest: Digest) -> list[object]:
    """What is read of an image's features: how they are stored, and their content."""
    if image not in reader:
        return []
    file = Path(reader.where(image))
    in_tar = not file.is_file()
    content = content_of([reader.read(image)]) if in_tar else digest(file)
    return [reader.config.dtype.name, reader.config.dsize, content]


def map_inputs(mapping: KaptureFolder, digest: Digest) -> list[list[str]]:
    """What every query reads of the map: points, observations, cameras, poses."""
    root = mapping.root
    files = [*(root / "reconstruction").rglob("*"), *(root / "sensors").glob("*.txt")]
    return [[str(f.relative_to(root)), digest(f)] for f in sorted(files) if f.is_file()]


def content_of(arrays: Iterable[NDArray[Any]]) -> str:
    """A hash of arrays."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


class _Entry(NamedTuple):
    files: dict[str, FileState]  # by path below the folder
    said: Any


@dataclass(eq=False)
class KeptItems:
    """What a stage has done of its items, in this run and in those before.

    Parameters
    ----------
    settings : hash of all that determines the output beside what items read.
    out : the folder that the stage writes into.
    journal : lines are added as items are done.
    sources : folders that may have items, and their journals; the first that has one counts.
    verify : hash all files that are taken over, see
        :func:`~megloc_kapture.io.output_folders.state_if_unchanged`.
    states : of the files of items that are done, by path below the folder.
    """

    settings: str
    out: Path
    journal: Path
    sources: Sequence[tuple[Path, Path]]
    digest: Digest
    verify: bool = False
    states: dict[str, FileState] = field(default_factory=dict, init=False)
    num_kept: int = field(default=0, init=False)
    num_items: int = field(default=0, init=False)

    def key(self, kind: str, name: str, inputs: Inputs) -> str:
        """The hash that an item is known by."""
        content = [self.settings, kind, name, inputs(name, self.digest)]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def take(self, key: str) -> _Entry | None:
        """Take over the item of a hash, if it is there."""
        self.num_items += 1
        for root, entries in self._entries:
            entry = entries.get(key)
            if entry is not None and self._link(root, entry.files):
                self._note(key, entry)
                self.num_kept += 1
                return entry
        return None

    def add(self, key: str, files: Iterable[Path], said: Any) -> None:
        """Note that an item is done: its files below the folder, and what is said of it."""
        paths = {file.relative_to(self.out).as_posix(): file for file in files}
        try:
            found = {path: self.states.get(path) or state_of(file) for path, file in paths.items()}
        except OSError as error:
            raise output_error(self.out, error) from error
        self._note(key, _Entry(found, said))

    @cached_property
    def _entries(self) -> list[tuple[Path, dict[str, _Entry]]]:
        return [(root, _read_journal(path)) for root, path in self.sources]

    def _link(self, root: Path, files: Mapping[str, FileState]) -> bool:
        """Link an item's files where all are as they were written."""
        for path, state in files.items():
            there = self.states.get(path)  # a file that items share
            if there not in (None, state):
                return False
            if there is None and not state_if_unchanged(root / path, state, verify=self.verify):
                return False
        try:
            for path in files.keys() - self.states.keys():
                hard_link(root / path, self.out / path)
        except OutputError:
            return False
        return True

    def _note(self, key: str, entry: _Entry) -> None:
        self.states.update(entry.files)
        try:
            with open(self.journal, "ab") as file:
                file.write(f"{json.dumps([key, *entry], separators=(',', ':'))}\n".encode())
        except OSError as error:
            raise output_error(self.journal, error) from error


def _read_journal(path: Path) -> dict[str, _Entry]:
    """The items of a journal by their hashes; lines that are cut or spoilt are left out."""
    try:
        lines = path.read_bytes().splitlines()
    except OSError:
        return {}
    found = {}
    for line in lines:
        try:
            key, files, said = json.loads(line)
            states = {check_relative(name): FileState(*state) for name, state in files.items()}
            found[str(key)] = _Entry(states, said)
        except (DataError, ValueError, TypeError, AttributeError):
            continue
    return found


@dataclass
class Items:
    """Items of one kind: those that are done, and how more of them get so.

    ``done``: what is said of each item, by its name; grows as items are added.
    """

    done: dict[str, Any] = field(default_factory=dict)
    _kept: KeptItems | None = None
    _keys: Mapping[str, str] = field(default_factory=dict)

    def label(self, text: str) -> str:
        """The label of a progress bar, with the number of items that need not be done."""
        return f"{text}, {len(self.done)} of {len(self._keys)} kept" if self.done else text

    def add(self, name: str, files: Iterable[Path], said: Any = None) -> None:
        """An item is done: the files it became, and what is said of it, as plain JSON values."""
        self.done[name] = said
        if self._kept is not None:
            self._kept.add(self._keys[name], files, said)


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
    force : go on where the given data contradict themselves.
    """

    executor: Executor | None = None
    track: Track = untracked
    num_threads: int = 1
    kept: KeptItems | None = None
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

    def items(self, kind: str, names: Sequence[str], inputs: Inputs) -> Items:
        """Items that do not depend on each other: those that are done, and what notes new ones.

        Parameters
        ----------
        kind : of the items, where a stage has several.
        inputs : what an item is made of beside the stage's settings and its own name; asked for
            only where something may be kept.
        """
        if self.kept is None:
            return Items()
        keys = {name: self.kept.key(kind, name, inputs) for name in names}
        found = {name: self.kept.take(key) for name, key in keys.items()}
        return Items({name: one.said for name, one in found.items() if one}, self.kept, keys)


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
    root: Path, features_dirs: tuple[Path, ...], links_below: tuple[Path, ...], run_id: str
) -> KaptureFolder:
    return KaptureFolder(root, features_dirs=features_dirs, allow_links_below=links_below)
