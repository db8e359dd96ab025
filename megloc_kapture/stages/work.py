"""Per-image and per-pair work: in order, with bounded memory and a progress bar."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol, TypeVar
from uuid import uuid4

from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.stages.kept_items import Inputs, Items, KeptItems

Item = TypeVar("Item")
Result = TypeVar("Result")


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
        function: Callable[[Item], Result],
        items: Iterable[Item],
        label: str,
        total: int | None = None,
    ) -> Iterator[Result]:
        """Results in the order of the items, with a progress bar.

        Parameters
        ----------
        function : of a module, so that it can be sent to another process.
        items : paths and numbers; arrays of an image are read where the work is done.
        total : number of items, where they have no length.
        """
        if total is None:
            items = items if isinstance(items, Sequence) else list(items)
            total = len(items)
        return self.track(ordered_map(function, items, self.executor), total, label)

    def items(self, kind: str, names: Sequence[str], inputs: Inputs) -> Items:
        """Items that do not depend on each other: those that are done, and what notes new ones.

        Parameters
        ----------
        kind : of the items, where a stage has several.
        inputs : what an item is made of beside the stage's settings and its own name; asked for
            only where something may be kept.
        """
        return Items.of(self.kept, kind, names, inputs)


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
