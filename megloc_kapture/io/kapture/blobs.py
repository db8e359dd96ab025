"""Many small binary files ("blobs") under one folder; ``tars.py`` has the same in one tar.

A blob is named by its path below the folder.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import write_bytes
from megloc_kapture.io.paths import Roots, check_no_escape, check_relative, safe_join


class BlobSource(Protocol):
    """Blobs to read, by name."""

    def names(self) -> list[str]: ...
    def __contains__(self, name: object) -> bool: ...
    def size(self, name: str) -> int: ...
    def read(self, name: str) -> bytearray: ...
    def where(self, name: str) -> str: ...

    def read_rows(self, names: Sequence[str], rows: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Read blobs of one size into the rows (N, B) of an array, C-contiguous.

        Returns their sizes, int64 (N,), -1 where there is no such blob: only the rows of those of
        size B are filled.
        """
        ...


class FolderBlobs:
    """Blobs as files below ``folder`` with the given suffix; links may not leave ``roots``."""

    def __init__(self, roots: Roots, folder: Path, suffix: str) -> None:
        self._roots = roots
        self._folder = check_no_escape(roots, folder)
        self._suffix = suffix

    def names(self) -> list[str]:
        return sorted(self._walk(self._folder, ""))

    def __contains__(self, name: object) -> bool:
        if not isinstance(name, str):
            return False
        try:
            return os.path.isfile(f"{self._folder}/{check_relative(name)}")
        except DataError:
            return False

    def size(self, name: str) -> int:
        path = self._checked(name)
        try:
            return path.stat().st_size
        except OSError as error:
            raise unreadable(path, error) from error

    def read(self, name: str) -> bytearray:
        path = self._checked(name)
        try:
            with open(path, "rb", buffering=0) as file:
                content = bytearray(os.fstat(file.fileno()).st_size)
                read = file.readinto(content)
                if read != len(content):  # a file of two gigabytes, or one that is being cut
                    content = content[: read or 0] + file.readall()
                return content
        except OSError as error:
            raise unreadable(path, error) from error

    def read_rows(self, names: Sequence[str], rows: NDArray[np.uint8]) -> NDArray[np.int64]:
        # a folder is opened, and its links are followed, once for all of its files that are read
        sizes = np.full(len(names), -1, dtype=np.int64)
        for above, group in groupby(
            enumerate(names), lambda item: check_relative(item[1]).rpartition("/")[0]
        ):
            descriptor = self._open_folder(above)
            if descriptor is None:
                continue
            try:
                for k, _ in group:
                    sizes[k] = self._read_row(descriptor, names[k], rows[k].data)
            except OSError as error:
                raise unreadable(self._folder / above, error) from error
            finally:
                os.close(descriptor)
        return sizes

    def where(self, name: str) -> str:
        return str(self._folder / name)

    def _read_row(self, folder: int, name: str, row: memoryview) -> int:
        """Read a file of an open folder into a row, filled where sizes agree; its size or -1."""
        size = _read_file_row(folder, name.rpartition("/")[2], row)
        if size is None:  # a link: where it leads to is checked
            size = self.size(name) if name in self else -1
            if size == len(row):
                row[:] = self.read(name)
        return size

    def _open_folder(self, relative: str) -> int | None:
        """A descriptor of a folder below, None where there is none."""
        path = check_no_escape(self._roots, self._folder / relative)
        try:
            return os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except (FileNotFoundError, NotADirectoryError):
            return None

    def _checked(self, name: str) -> Path:
        path, below = safe_join(self._folder, name), str(self._folder)
        for part in name.split("/"):  # following no links takes a fraction of the time
            below = f"{below}/{part}"
            if os.path.islink(below):
                return check_no_escape(self._roots, path)
        return path

    def _walk(self, folder: Path | str, prefix: str) -> Iterator[str]:
        try:
            with os.scandir(folder) as entries:
                for entry in entries:
                    if entry.is_symlink():
                        check_no_escape(self._roots, Path(entry.path))
                    if entry.is_dir(follow_symlinks=False):
                        yield from self._walk(entry.path, f"{prefix}{entry.name}/")
                    elif entry.name.endswith(self._suffix) and entry.is_file():
                        yield prefix + entry.name
        except OSError as error:
            raise unreadable(Path(folder), error) from error


def _read_file_row(folder: int, name: str, row: memoryview) -> int | None:
    """Read the file ``name`` of an open folder into ``row``, which is filled where sizes agree.

    Returns its size, -1 where there is no such plain file, None where it is a link, which is not
    followed.
    """
    try:
        # not blocking: a pipe would wait for somebody to write
        flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        descriptor = os.open(name, flags, dir_fd=folder)
    except FileNotFoundError:
        return -1
    except OSError as error:
        if error.errno == errno.ELOOP:
            return None
        raise
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            return -1
        if found.st_size == len(row) and not read_fully(descriptor, row, 0):
            return 0  # being cut while it is read
        return found.st_size
    finally:
        os.close(descriptor)


class FolderBlobWriter:
    """Write blobs as files below ``folder``, each atomically."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __contains__(self, name: str) -> bool:
        try:
            return safe_join(self._folder, name).is_file()
        except OSError:
            return False  # too long a name, or a folder closed to us: writing will say so

    def write(self, name: str, content: bytes) -> Path:
        """Write one; returns its file."""
        path = safe_join(self._folder, name)
        write_bytes(path, content)
        return path

    def close(self) -> None:
        pass


def read_fully(descriptor: int, view: memoryview, offset: int) -> bool:
    """Fill ``view`` with what a file has from ``offset`` on; False where there is not enough."""
    done = 0
    while done < len(view):  # one call gives 2 GiB at most
        read = os.preadv(descriptor, [view[done:]], offset + done)
        if read == 0:
            return False
        done += read
    return True


def unreadable(path: Path, error: OSError) -> DataError:
    """The error for a file that the system does not give."""
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return DataError("file is missing", path=path)
    return DataError(f"cannot read: {error.strerror}", path=path)
