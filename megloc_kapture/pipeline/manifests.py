"""Manifests: what a stage did, and whether it must run again.

A stage's fingerprint is a hash of its name, its version, its options, the code of its plugins and
the fingerprints of what it reads: hashes of content, whether from outside the workspace or of what
another stage wrote. So a stage runs again exactly when something that could change its output has
changed.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from stat import S_ISREG
from typing import Any

from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import output_error, read_content, read_json_model, write_bytes
from megloc_kapture.io.output_folders import FileState, state_if_unchanged, state_of
from megloc_kapture.values import Options


class Manifest(Options):
    """``stages/NAME.json``."""

    stage: str
    version: int
    options: dict[str, Any]
    inputs: dict[str, str] = Field(description="what was read: name to fingerprint")
    fingerprint: str
    content: str = Field(default="", description="hash of the outputs; none where they are links")
    outputs: tuple[str, ...]
    counts: dict[str, float] = Field(default_factory=dict)
    seconds: float
    started: str
    versions: dict[str, str]

    @property
    def output(self) -> str:
        """The fingerprint of the outputs, by which those that read them know them again."""
        return self.content or self.fingerprint


def fingerprint(
    stage: str, version: int, options: Mapping[str, Any], inputs: Mapping[str, str]
) -> str:
    """Hash of everything that determines a stage's output."""
    content = {"stage": stage, "version": version, "options": dict(options), "inputs": dict(inputs)}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def read_manifest(path: Path) -> Manifest | None:
    """The manifest, None where there is none that can be read: then the stage has to run."""
    try:
        return read_json_model(path, Manifest)
    except DataError:
        return None


class FileHashes:
    """SHA-256 of files, remembered by size and modification time.

    Hashing a large dataset at each start would cost a minute; a file whose size and times are
    those of last time has last time's hash.
    """

    def __init__(self, path: Path, written: Mapping[str, FileState] | None = None) -> None:
        """``path`` is where they are remembered; ``written`` are files whose state is known."""
        self._written = written or {}
        self._seen: dict[str, list[Any]] = {}
        content = None
        with suppress(OSError, ValueError):
            content = json.loads(path.read_text(encoding="utf-8"))
        self._known: dict[str, list[Any]] = content if isinstance(content, dict) else {}

    def of_file(self, path: Path) -> str:
        """Hash of one file's content; raises DataError when it cannot be read."""
        try:
            stat = os.stat(path)
            if not S_ISREG(stat.st_mode):
                raise DataError("not a plain file", path=path)
            key = str(path)
            written = self._written.get(key)
            if written is not None and written[:2] == (stat.st_size, stat.st_mtime_ns):
                return written.sha256
            state = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]
            known = self._known.get(key)
            if isinstance(known, list) and known[:4] == state and len(known) == 5:
                self._seen[key] = known
                return str(known[4])
            with open(path, "rb") as file:
                sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise DataError(f"cannot be read: {error.strerror}", path=path) from error
        self._seen[key] = [*state, sha256]
        return sha256

    def of_files(self, root: Path, files: Iterable[Path]) -> str:
        """One hash of many files: their names relative to ``root`` and their contents."""
        digest = hashlib.sha256()
        for file in sorted(files):
            digest.update(f"{os.path.relpath(file, root)}\0{self.of_file(file)}\0".encode())
        return digest.hexdigest()

    def content(self) -> dict[str, list[Any]]:
        """What to remember: the files asked for this time."""
        return dict(sorted(self._seen.items()))


Files = dict[str, FileState]  # by path in the workspace


def remember_files(
    record: Path, root: Path, outputs: Iterable[str], known: Mapping[str, FileState]
) -> str:
    """Write down the files below a stage's outputs, with their hashes.

    Parameters
    ----------
    known : states of files that were hashed when they were written.

    Returns
    -------
    One hash of their names and contents; none where there are links, which do not say what is at
    their ends.

    Raises
    ------
    OutputError : cannot be written, or one of them is gone already.
    """
    files: Files = {}
    digest, has_links = hashlib.sha256(), False
    try:
        for path in sorted(_below(root, outputs)):
            before, place = known.get(path), root / path
            state = None if before is None else state_if_unchanged(place, before)
            files[path] = state = state or state_of(place)
            digest.update(f"{path}\0{state.sha256}\0".encode())
            has_links = has_links or place.is_symlink()
    except OSError as error:
        raise output_error(root, error) from error
    _write(record, files)
    return "" if has_links else digest.hexdigest()


def changed_file(record: Path, root: Path, *, verify: bool = False) -> str:
    """The first file that is not as it was written, and what became of it; empty if all are.

    Parameters
    ----------
    verify : hash all of them, see :func:`~megloc_kapture.io.file_states.state_if_unchanged`.
    """
    files = written_files(record)
    touched = False
    for path, known in files.items():
        state = state_if_unchanged(root / path, known, verify=verify)
        if state is None:
            there = os.path.lexists(root / path)
            return f"{path} {'was changed since it was written' if there else 'is gone'}"
        files[path], touched = state, touched or state != known
    if touched:
        _write(record, files)
    return ""


def written_files(record: Path) -> Files:
    """The files that a record lists; none where it is of another time, or spoilt."""
    try:
        content = json.loads(read_content(record))
        return {path: FileState(*state) for path, state in content.items()}
    except (DataError, ValueError, TypeError, AttributeError):
        return {}


def _write(record: Path, files: Files) -> None:
    write_bytes(record, (json.dumps(files) + "\n").encode())


def _below(root: Path, outputs: Iterable[str]) -> Iterator[str]:
    """Files and links at and below paths; links are not followed."""
    for output in outputs:
        place = root / output
        if place.is_symlink() or not place.is_dir():
            yield output
            continue
        for folder, names, files in os.walk(place):
            here = os.path.relpath(folder, root)
            links = (name for name in names if os.path.islink(os.path.join(folder, name)))
            yield from (f"{here}/{name}" for name in (*files, *links))
