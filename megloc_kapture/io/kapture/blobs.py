"""Many small binary files ("blobs"), each by its path below a folder, as files or in one tar.

The tar, kapture's form for large sets, is read through an index of offsets, so that any number of
threads can read from it at once, and written so that equal content gives equal bytes (no dates, no
users) and a killed run loses at most the blob it was writing.
"""

from __future__ import annotations

import contextlib
import errno
import io
import mmap
import os
import stat
import tarfile
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import (
    Roots,
    check_no_escape,
    check_relative,
    named,
    output_error,
    safe_join,
)

_TAR_BLOCK = 512
_TAR_RECORD = 20 * _TAR_BLOCK


# ------------------------------------------------------------------------------------------ reading


class FolderBlobs:
    """Blobs as files below ``folder`` with the given suffix; links may not leave ``roots``."""

    def __init__(self, roots: Roots, folder: Path, suffix: str) -> None:
        self._roots, self._suffix = roots, suffix
        self._folder = check_no_escape(roots, folder)

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
            raise _unreadable(path, error) from error

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
            raise _unreadable(path, error) from error

    def read_rows(self, names: Sequence[str], rows: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Read blobs of one size into the rows (N, B) of an array, C-contiguous.

        Returns their sizes, int64 (N,), -1 where there is no such blob: only the rows of those of
        size B are filled.
        """
        # a folder is opened, and its links are followed, once for all of its files that are read
        sizes = np.full(len(names), -1, dtype=np.int64)
        for above, group in groupby(
            enumerate(names), lambda item: check_relative(item[1]).rpartition("/")[0]
        ):
            descriptor = self._open_folder(above)
            if descriptor is None:
                continue
            try:
                for k, name in group:
                    size = _read_file_row(descriptor, name.rpartition("/")[2], rows[k].data)
                    if size is None:  # a link: where it leads to is checked
                        size = self.size(name) if name in self else -1
                        if size == rows.shape[1]:
                            rows[k].data[:] = self.read(name)
                    sizes[k] = size
            except OSError as error:
                raise _unreadable(self._folder / above, error) from error
            finally:
                os.close(descriptor)
        return sizes

    def where(self, name: str) -> str:
        return str(self._folder / name)

    def _open_folder(self, relative: str) -> int | None:
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
            raise _unreadable(Path(folder), error) from error


def _read_file_row(folder: int, name: str, row: memoryview) -> int | None:
    """Read a file of an open folder into ``row``, which is filled where sizes agree.

    Returns its size, -1 where there is no such plain file, None for a link, which is not followed.
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
        if found.st_size == len(row) and not _read_fully(descriptor, row, 0):
            return 0  # being cut while it is read
        return found.st_size
    finally:
        os.close(descriptor)


class TarBlobs:
    """Blobs in an uncompressed tar; of members with one name the last counts."""

    def __init__(self, roots: Roots, path: Path, suffix: str) -> None:
        self._path = check_no_escape(roots, path)
        index, _ = index_tar(path)
        self._index = {name: span for name, span in index.items() if name.endswith(suffix)}
        self._file = _open(path)

    def names(self) -> list[str]:
        return sorted(self._index)

    def __contains__(self, name: object) -> bool:
        return name in self._index

    def size(self, name: str) -> int:
        return self._span(name)[1]

    def read(self, name: str) -> bytearray:
        offset, size = self._span(name)
        content = bytearray(size)
        with memoryview(content) as view:
            self._fill(view, offset, name)
        return content

    def read_rows(self, names: Sequence[str], rows: NDArray[np.uint8]) -> NDArray[np.int64]:
        """See :meth:`FolderBlobs.read_rows`."""
        offsets, sizes = self._spans(names)
        for k in np.flatnonzero(sizes == rows.shape[1]).tolist():
            self._fill(rows[k].data, int(offsets[k]), names[k])
        return sizes

    def map_rows(self, names: Sequence[str], width: int) -> NDArray[np.uint8] | None:
        """Blobs of ``width`` bytes in the system's cache, not copied: uint8 (N, width), read only.

        None where they are of another size or lie at no constant stride. The tar must not be cut
        while the rows are used: the system would end the process.
        """
        offsets, sizes = self._spans(names)
        if len(names) < 2 or (sizes != width).any():
            return None
        stride = int(offsets[1] - offsets[0])
        first, end = int(offsets[0]), int(offsets[-1]) + width
        if stride < width or (np.diff(offsets) != stride).any():
            return None
        begin = first - first % mmap.ALLOCATIONGRANULARITY
        # populated: one call instead of an interruption for every few pages
        flags = mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0)
        try:
            descriptor = self._file.fileno()
            if end > os.fstat(descriptor).st_size:
                return None
            mapped = mmap.mmap(
                descriptor, end - begin, flags=flags, prot=mmap.PROT_READ, offset=begin
            )
        except OSError as error:
            raise _unreadable(self._path, error) from error
        return np.ndarray(
            (len(names), width), np.uint8, mapped, offset=first - begin, strides=(stride, 1)
        )

    def where(self, name: str) -> str:
        return f"{self._path}[{name}]"

    def _fill(self, view: memoryview, offset: int, name: str) -> None:
        try:
            if not _read_fully(self._file.fileno(), view, offset):
                raise DataError(f"truncated at member {name!r}", path=self._path)
        except OSError as error:
            raise _unreadable(self._path, error) from error

    def _spans(self, names: Sequence[str]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Offsets and sizes of blobs; size -1 of those that are not there."""
        spans = [self._index.get(name, (0, -1)) for name in names]
        offsets, sizes = np.array(spans, dtype=np.int64).reshape(-1, 2).T
        return offsets, sizes

    def _span(self, name: str) -> tuple[int, int]:
        span = self._index.get(name)
        if span is None:
            raise DataError(f"no member {name!r}", path=self._path)
        return span

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "_file"}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        self._file = _open(self._path)


BlobSource: TypeAlias = FolderBlobs | TarBlobs


def index_tar(path: Path, *, repair: bool = False) -> tuple[dict[str, tuple[int, int]], int]:
    """The regular files of a tar: name -> (offset, size), and the end of the last one.

    An empty file counts as an empty tar. With ``repair`` an incomplete last member is left out,
    instead of refused. Raises DataError for what is not a tar, compressed, truncated, holds links
    or devices, or names a path outside.
    """
    index: dict[str, tuple[int, int]] = {}
    end = 0
    try:
        total = path.stat().st_size
        if total == 0:
            return {}, 0
        with open(path, "rb") as file:
            if not any(file.read(_TAR_BLOCK)):
                return {}, 0  # an empty tar, closed as such; or a killed run's first member
            file.seek(0)
            with tarfile.TarFile(fileobj=file, mode="r", encoding="utf-8", errors="strict") as tar:
                while (member := tar.next()) is not None:
                    # a negative size would walk backwards, for ever (CVE-2025-8194)
                    if member.size < 0 or tar.offset <= end:
                        raise DataError("broken member header", path=path)
                    if member.offset_data + member.size > total:
                        if repair:
                            return index, end
                        raise DataError(f"truncated at member {member.name!r}", path=path)
                    end = tar.offset
                    tar.members = []  # type: ignore[attr-defined]  # it keeps all it met
                    if member.isdir():
                        continue
                    if not member.isreg() or member.issparse():
                        raise DataError(f"member {member.name!r} is not a plain file", path=path)
                    index[_member_name(member.name, path)] = (member.offset_data, member.size)
                    if tar.pax_headers:
                        continue  # of the whole tar: they hold for what follows
                    for name, begin, size in _plain_members(file.fileno(), end, total):
                        index[_member_name(name, path)] = (begin, size)
                        end = tar.offset = begin + -(-size // _TAR_BLOCK) * _TAR_BLOCK
            # tarfile takes a broken header for the end of the archive; the end must be zeros
            file.seek(end)
            if not repair and any(file.read(_TAR_BLOCK)):
                raise DataError(f"broken or truncated after byte {end}", path=path)
    except FileNotFoundError as error:
        raise DataError("file is missing", path=path) from error
    except (
        *(tarfile.TarError, OSError, ValueError, EOFError, RecursionError, KeyError),
        *(OverflowError, MemoryError),  # a size that no file has
    ) as error:
        if repair and index:
            return index, end
        raise DataError(f"not a readable uncompressed tar ({error})", path=path) from error
    return index, end


def _plain_members(descriptor: int, at: int, total: int) -> Iterator[tuple[str, int, int]]:
    """Name, offset and size of the plain files from ``at`` on, up to the first unusual member.

    ``tarfile`` takes four times as long for each; what is not exactly as expected is left to it.
    """
    while True:
        header = os.pread(descriptor, _TAR_BLOCK, at)
        size, checksum = header[124:135], header[148:154]
        if (
            header[257:262] != b"ustar"
            or header[156:157] != tarfile.REGTYPE
            or not (size.isdigit() and checksum.isdigit() and header[135] in (0, 32))
            # its own field counts as eight spaces
            or sum(header) - sum(header[148:156]) + 8 * 32 != int(checksum, 8)
        ):
            return
        name, prefix = (part.partition(b"\0")[0] for part in (header[:100], header[345:500]))
        at += _TAR_BLOCK
        if name.endswith(b"/") or at + int(size, 8) > total:
            return
        yield (prefix + b"/" + name if prefix else name).decode("utf-8"), at, int(size, 8)
        at += -(-int(size, 8) // _TAR_BLOCK) * _TAR_BLOCK


def _member_name(name: str, path: Path) -> str:
    with named(path):
        return check_relative(name.removeprefix("./"))  # as `tar cf x.tar .` names them


# ------------------------------------------------------------------------------------------ writing


class TarBlobWriter:
    """Append blobs to a tar, which is made where it does not exist.

    Members have date 0, user 0 and mode 0644. A member that a killed run left incomplete is cut
    off when the tar is opened again, one that a full disk left is cut off at once. Raises
    OutputError where the tar cannot be written, DataError where a file of that name is none.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._index: dict[str, tuple[int, int]] = {}
            self._end = 0
            if path.exists():
                self._index, self._end = index_tar(path, repair=True)
            self._fd = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise output_error(path, error) from error
        self._open = True
        self._cut()  # what a killed run left incomplete

    def __contains__(self, name: str) -> bool:
        return name in self._index

    def write(self, name: str, content: bytes) -> Path:
        """Append one; returns the tar's file."""
        if not self._open:
            raise ValueError(f"{self._path}: is closed")
        member = tarfile.TarInfo(check_relative(name))
        member.size = len(content)
        member.mode = 0o644
        header = member.tobuf(format=tarfile.PAX_FORMAT, encoding="utf-8", errors="strict")
        padding = b"\0" * (-len(content) % _TAR_BLOCK)
        try:
            # header last: what a killed run leaves is not taken for a member
            _pwrite_all(self._fd, content + padding, self._end + len(header))
            _pwrite_all(self._fd, header, self._end)
        except OSError as error:
            self._cut()
            raise output_error(self._path, error) from error
        self._index[name] = (self._end + len(header), len(content))
        self._end += len(header) + len(content) + len(padding)
        return self._path

    def close(self) -> None:
        if not self._open:
            return
        self._open = False
        try:
            size = -(-(self._end + 2 * _TAR_BLOCK) // _TAR_RECORD) * _TAR_RECORD
            try:
                _pwrite_all(self._fd, b"\0" * (size - self._end), self._end)
            finally:
                os.close(self._fd)
        except OSError as error:
            raise output_error(self._path, error) from error

    def _cut(self) -> None:
        with contextlib.suppress(OSError):
            os.ftruncate(self._fd, self._end)


def _pwrite_all(fd: int, content: bytes, offset: int) -> None:
    view = memoryview(content)
    while view:
        written = os.pwrite(fd, view, offset)
        view, offset = view[written:], offset + written


def _open(path: Path) -> io.FileIO:
    try:
        return io.FileIO(path, "rb")
    except OSError as error:
        raise _unreadable(path, error) from error


def _read_fully(descriptor: int, view: memoryview, offset: int) -> bool:
    """Fill ``view`` with what a file has from ``offset`` on; False where there is not enough."""
    done = 0
    while done < len(view):  # one call gives 2 GiB at most
        read = os.preadv(descriptor, [view[done:]], offset + done)
        if read == 0:
            return False
        done += read
    return True


def _unreadable(path: Path, error: OSError) -> DataError:
    """The error for a file that the system does not give."""
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return DataError("file is missing", path=path)
    return DataError(f"cannot read: {error.strerror}", path=path)
