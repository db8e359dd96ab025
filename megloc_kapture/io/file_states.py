"""What is remembered of a file that was written, so that one changed, cut or gone is noticed."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from stat import S_ISLNK, S_ISREG
from typing import NamedTuple


class FileState(NamedTuple):
    """Of a file: size, time of modification, hash of the content; of a link 0, 0, what it says."""

    size: int
    time_ns: int
    sha256: str


def state_of(path: Path) -> FileState:
    """The state of a file or link; raises OSError."""
    if path.is_symlink():
        return FileState(0, 0, os.readlink(path))
    with open(path, "rb") as file:
        found, digest = os.fstat(file.fileno()), hashlib.file_digest(file, "sha256")
        return FileState(found.st_size, found.st_mtime_ns, digest.hexdigest())


def state_if_unchanged(path: Path, known: FileState, *, verify: bool = False) -> FileState | None:
    """The state of a file whose content is still what is known; None where it is not, or is gone.

    A file of the same size and time counts as the same. One of another time is hashed: it may have
    been copied.

    Parameters
    ----------
    verify : hash it in any case.
    """
    try:
        found = path.lstat()
        if S_ISREG(found.st_mode):
            if found.st_size != known.size:
                return None
            if found.st_mtime_ns == known.time_ns and not verify:
                return known
        elif not S_ISLNK(found.st_mode):
            return None
        state = state_of(path)
    except OSError:
        return None
    return state if state.sha256 == known.sha256 else None
