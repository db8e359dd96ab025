"""The files that a stage wrote: remembered, so that one that is changed, cut or gone is noticed."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import output_error, read_content, write_bytes

# by path in the workspace: size, modification time in ns, SHA-256; of a link 0, 0, what it says
Files = dict[str, tuple[int, int, str]]


def remember_files(record: Path, root: Path, outputs: Iterable[str]) -> None:
    """Write down the files below a stage's outputs, with their hashes.

    Raises
    ------
    OutputError : cannot be written, or one of them is gone already.
    """
    try:
        files = {path: _state(root / path) for path in sorted(_below(root, outputs))}
    except OSError as error:
        raise output_error(root, error) from error
    _write(record, files)


def changed_file(record: Path, root: Path, *, verify: bool = False) -> str:
    """The first file that is not as it was written, and what became of it; empty if all are.

    A file of the same size and modification time counts as the same. One of another time is
    hashed: a workspace may be copied.

    Parameters
    ----------
    verify : hash all of them.
    """
    try:
        files: Files = json.loads(read_content(record))
        touched = False
        for path, (size, time_ns, digest) in files.items():
            there = root / path
            try:
                found = there.lstat()
                if there.is_symlink():
                    same = os.readlink(there) == digest
                elif found.st_size != size:
                    same = False
                elif found.st_mtime_ns == time_ns and not verify:
                    continue
                else:
                    state = _state(there)
                    same, touched = state[2] == digest, touched or state[1] != time_ns
                    files[path] = state
            except OSError:
                return f"{path} is gone"
            if not same:
                return f"{path} was changed since it was written"
    except (DataError, ValueError, TypeError, AttributeError):
        return ""  # written before there were records, or spoilt: nothing is known
    if touched:
        _write(record, files)
    return ""


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


def _state(path: Path) -> tuple[int, int, str]:
    if path.is_symlink():
        return 0, 0, os.readlink(path)
    with open(path, "rb") as file:
        found = os.fstat(file.fileno())
        return found.st_size, found.st_mtime_ns, hashlib.file_digest(file, "sha256").hexdigest()
