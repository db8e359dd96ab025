"""Writing that leaves the old state or the new one, never something in between.

A file is written beside its place under a name that no reader lists (``.<token>.tmp``) and then
renamed over it. That protects from killed runs and full disks. There is no fsync: after a power
cut the file system decides, and a thousand small feature files would pay for it.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import secrets
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from megloc_kapture.errors import OutputError

TEMPORARY_SUFFIX = ".tmp"


def output_error(path: Path | str, error: OSError) -> OutputError:
    """The :class:`OutputError` for an ``OSError`` met while writing ``path``."""
    reason = error.strerror or str(error) or type(error).__name__
    return OutputError(f"{path}: cannot write: {reason}")


@contextlib.contextmanager
def atomic_write(path: Path | str) -> Iterator[BinaryIO]:
    """Open a binary file that takes the place of ``path`` when the block ends well.

    Missing parent folders are made. When the block raises, the temporary file is removed and
    ``path`` is as it was.

    Raises
    ------
    OutputError : the file cannot be written (disk full, permission, ...); names ``path``.
    """
    path = Path(path)
    temporary = path.parent / f".{secrets.token_hex(8)}{TEMPORARY_SUFFIX}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            # mode "x" and not mkstemp, whose files are closed to everybody else
            with open(temporary, "xb") as file:
                yield file
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        if error.filename is not None and not _concerns(error, path, temporary):
            raise  # not from writing: the block met it while reading something else
        raise output_error(path, error) from error


def _concerns(error: OSError, path: Path, temporary: Path) -> bool:
    named = os.fspath(error.filename)
    ours = {os.fspath(path), os.fspath(temporary), *map(os.fspath, path.parents)}
    return named in ours


def write_bytes(path: Path | str, content: bytes) -> None:
    """Write a whole file atomically; see :func:`atomic_write`."""
    with atomic_write(path) as file:
        file.write(content)


def replace_directory(new: Path, place: Path) -> None:
    """Put folder ``new`` in the place of folder ``place``, which need not exist.

    Both must be on one file system. On Linux the two are exchanged in one step, so that a run
    killed here leaves either the old or the new folder at ``place``; what was there before is
    then removed. A run killed during that removal leaves a rest at ``new``'s old name.

    Raises
    ------
    OutputError : ``place`` is a file or a link (a user's link is not ours to replace), or the
        file system refuses; names ``place``.
    """
    new, place = Path(new), Path(place)
    if place.is_symlink() or (place.exists() and not place.is_dir()):
        raise OutputError(f"{place}: is a link or a file, not a folder; move it away first")
    try:
        if not place.exists():
            place.parent.mkdir(parents=True, exist_ok=True)
            os.rename(new, place)
            return
        if _exchange(new, place):
            shutil.rmtree(new)
            return
        old = place.with_name(f".{place.name}.{secrets.token_hex(8)}{TEMPORARY_SUFFIX}")
        os.rename(place, old)
        os.rename(new, place)
        shutil.rmtree(old)
    except OSError as error:
        raise output_error(place, error) from error


def _exchange(first: Path, second: Path) -> bool:
    """Swap two paths in one step; False where the system has no such call."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        renameat2 = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    at_fdcwd, rename_exchange = -100, 2
    done = renameat2(
        at_fdcwd, os.fsencode(first), at_fdcwd, os.fsencode(second), ctypes.c_uint(rename_exchange)
    )
    if done == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):
        return False
    raise OSError(code, os.strerror(code), os.fspath(second))
