"""The files that a stage wrote: remembered, so that one that is changed, cut or gone is noticed."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import output_error, read_content, write_bytes
from megloc_kapture.io.output_folders import FileState, state_if_unchanged, state_of

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
    verify : hash all of them, see :func:`~megloc_kapture.io.output_folders.state_if_unchanged`.
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
