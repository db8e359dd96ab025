"""Items of a stage (an image, a pair) that runs before have done: taken over, not done again.

A stage that is at work lists what it has done in a journal, a line per item: a hash of all that
the item is made of (the stage's settings, the code of its plugins, the content of what is read),
the files it became, and what the stage wants to know of it later. The next run takes over the
items whose hash is the same and whose files are as they were written, from what stopped runs have
left and from the finished output, by links; so it ends in the bytes that it would have made. A line
follows its files, and half a line is none: whenever a run is killed, what is taken over is whole.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import check_relative, hard_link, output_error
from megloc_kapture.io.kapture import FeatureReader, KaptureFolder
from megloc_kapture.io.output_folders import FileState, state_if_unchanged, state_of

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
    """

    def __init__(
        self,
        settings: str,
        out: Path,
        journal: Path,
        sources: Sequence[tuple[Path, Path]],
        digest: Digest,
        *,
        verify: bool = False,
    ) -> None:
        self._settings, self._out, self._journal = settings, out, journal
        self._sources, self._digest, self._verify = sources, digest, verify
        self.states: dict[str, FileState] = {}
        """Of the files of items that are done, by path below the folder."""
        self.num_kept = self.num_items = 0

    def key(self, kind: str, name: str, inputs: Inputs) -> str:
        """The hash that an item is known by."""
        content = [self._settings, kind, name, inputs(name, self._digest)]
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
        paths = {file.relative_to(self._out).as_posix(): file for file in files}
        try:
            found = {path: self.states.get(path) or state_of(file) for path, file in paths.items()}
        except OSError as error:
            raise output_error(self._out, error) from error
        self._note(key, _Entry(found, said))

    @cached_property
    def _entries(self) -> list[tuple[Path, dict[str, _Entry]]]:
        return [(root, _read_journal(path)) for root, path in self._sources]

    def _link(self, root: Path, files: Mapping[str, FileState]) -> bool:
        """Link an item's files where all are as they were written."""
        for path, state in files.items():
            there = self.states.get(path)  # a file that items share
            if there not in (None, state):
                return False
            if there is None and not state_if_unchanged(root / path, state, verify=self._verify):
                return False
        try:
            for path in files.keys() - self.states.keys():
                hard_link(root / path, self._out / path)
        except OutputError:
            return False
        return True

    def _note(self, key: str, entry: _Entry) -> None:
        self.states.update(entry.files)
        try:
            with open(self._journal, "ab") as file:
                file.write(f"{json.dumps([key, *entry], separators=(',', ':'))}\n".encode())
        except OSError as error:
            raise output_error(self._journal, error) from error


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

    Attributes
    ----------
    done : what is said of each item, by its name; grows as items are added.
    """

    done: dict[str, Any] = field(default_factory=dict)
    _kept: KeptItems | None = None
    _keys: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, kept: KeptItems | None, kind: str, names: Sequence[str], inputs: Inputs) -> Items:
        """See :meth:`megloc_kapture.stages.work.Work.items`."""
        if kept is None:
            return cls()
        keys = {name: kept.key(kind, name, inputs) for name in names}
        found = {name: kept.take(key) for name, key in keys.items()}
        return cls({name: one.said for name, one in found.items() if one}, kept, keys)

    def label(self, text: str) -> str:
        """The label of a progress bar, with the number of items that need not be done."""
        return f"{text}, {len(self.done)} of {len(self._keys)} kept" if self.done else text

    def add(self, name: str, files: Iterable[Path], said: Any = None) -> None:
        """An item is done: the files it became, and what is said of it, as plain JSON values."""
        self.done[name] = said
        if self._kept is not None:
            self._kept.add(self._keys[name], files, said)
