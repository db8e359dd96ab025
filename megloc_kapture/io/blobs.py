"""Many small binary files under one folder, or the same in one tar: the two forms of kapture.

A blob is named by its path below the folder. The tar form is read through an index of offsets,
so that any number of threads can read from it at once, and written so that equal content gives
equal bytes (no dates, no users) and a killed run loses at most the blob it was writing.
"""

from __future__ import annotations

import contextlib
import io
import os
import tarfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import output_error, write_bytes
from megloc_kapture.io.paths import Roots, check_no_escape, check_relative, safe_join
from megloc_kapture.io.row_reading import map_rows, read_file_row, read_fully, read_rows_at
from megloc_kapture.io.tar_runs import names_of_run, stride_of

_TAR_BLOCK = 512
_TAR_RECORD = 20 * _TAR_BLOCK


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
            return safe_join(self._folder, name).is_file()
        except (DataError, OSError):
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
        sizes = np.full(len(names), -1, dtype=np.int64)
        width = rows.shape[1]
        flat = rows.reshape(-1).data
        parent, descriptor = "", None
        try:
            for k, name in enumerate(names):
                above, slash, last = check_relative(name).rpartition("/")
                if descriptor is None or above + slash != parent:
                    if descriptor is not None:
                        os.close(descriptor)
                    parent, descriptor = above + slash, self._open_folder(above)
                if descriptor is None:
                    continue
                row = flat[k * width : (k + 1) * width]
                size = read_file_row(descriptor, last, row)
                if size is None:  # a link: where it leads to is checked
                    size = -1 if name not in self else self.size(name)
                    if size == width:
                        row[:] = self.read(name)
                sizes[k] = size
        except OSError as error:
            raise _unreadable(self._folder / name, error) from error
        finally:
            if descriptor is not None:
                os.close(descriptor)
        return sizes

    def where(self, name: str) -> str:
        return str(self._folder / name)

    def _open_folder(self, relative: str) -> int | None:
        """A descriptor of a folder below, None where there is none."""
        path = check_no_escape(self._roots, self._folder / relative)
        try:
            return os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except (FileNotFoundError, NotADirectoryError):
            return None

    def _checked(self, name: str) -> Path:
        return check_no_escape(self._roots, safe_join(self._folder, name))

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


class TarBlobs:
    """Blobs in an uncompressed tar; of members with one name the last counts."""

    def __init__(self, roots: Roots, path: Path, suffix: str) -> None:
        self._path = check_no_escape(roots, path)
        index, _ = index_tar(path)
        self._index = {name: place for name, place in index.items() if name.endswith(suffix)}
        self._file = _open(path)

    def names(self) -> list[str]:
        return sorted(self._index)

    def __contains__(self, name: object) -> bool:
        return name in self._index

    def size(self, name: str) -> int:
        return self._place(name)[1]

    def read(self, name: str) -> bytearray:
        offset, size = self._place(name)
        content = bytearray(size)
        try:
            with memoryview(content) as view:
                if not read_fully(self._file.fileno(), view, offset):
                    raise DataError(f"truncated at member {name!r}", path=self._path)
        except OSError as error:
            raise _unreadable(self._path, error) from error
        return content

    def read_rows(self, names: Sequence[str], rows: NDArray[np.uint8]) -> NDArray[np.int64]:
        offsets, sizes = self._places(names)
        wanted = np.flatnonzero(sizes == rows.shape[1])
        try:
            if not read_rows_at(self._file.fileno(), offsets[wanted], wanted, rows):
                raise DataError("truncated while it was read", path=self._path)
        except OSError as error:
            raise _unreadable(self._path, error) from error
        return sizes

    def map_rows(self, names: Sequence[str], width: int) -> NDArray[np.uint8] | None:
        """Blobs of ``width`` bytes that lie at a constant stride, see :func:`.map_rows`."""
        offsets, sizes = self._places(names)
        if (sizes != width).any():
            return None
        try:
            return map_rows(self._file.fileno(), offsets, width)
        except OSError as error:
            raise _unreadable(self._path, error) from error

    def where(self, name: str) -> str:
        return f"{self._path}[{name}]"

    def _places(self, names: Sequence[str]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Offsets and sizes of blobs; size -1 of those that are not there."""
        absent = (0, -1)
        places = [self._index.get(name, absent) for name in names]
        offsets, sizes = np.array(places, dtype=np.int64).reshape(-1, 2).T
        return offsets, sizes

    def _place(self, name: str) -> tuple[int, int]:
        place = self._index.get(name)
        if place is None:
            raise DataError(f"no member {name!r}", path=self._path)
        return place

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "_file"}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        self._file = _open(self._path)


def index_tar(path: Path, *, repair: bool = False) -> tuple[dict[str, tuple[int, int]], int]:
    """Where each regular file of a tar lies: name -> (offset, size), and the end of the last one.

    An empty file counts as an empty tar. With ``repair`` an incomplete
    last member is left out, instead of refused.

    Raises
    ------
    DataError : not a tar, compressed, truncated, holds links or devices, or names a path outside.
    """
    index: dict[str, tuple[int, int]] = {}
    end = 0
    layout = (0, 0)
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
                    before, layout = layout, (member.offset_data - member.offset, member.size)
                    if layout != before or tar.pax_headers:
                        continue
                    # two alike: more of them will follow
                    header_bytes, size = layout
                    run = names_of_run(
                        file.fileno(), end, total, header_bytes=header_bytes, size=size
                    )
                    stride = stride_of(header_bytes, size)
                    begins = range(end + header_bytes, total, stride)
                    for name, begin in zip(_member_names(run, path), begins, strict=False):
                        index[name] = (begin, size)
                    end += len(run) * stride
                    tar.offset = end  # where it goes on
            _check_end(path, file, end, repair)
    except FileNotFoundError as error:
        raise DataError("file is missing", path=path) from error
    except (tarfile.TarError, OSError, ValueError, EOFError, RecursionError, KeyError) as error:
        if repair and index:
            return index, end
        raise DataError(f"not a readable uncompressed tar ({error})", path=path) from error
    return index, end


def _check_end(path: Path, file: BinaryIO, end: int, repair: bool) -> None:
    """tarfile takes a broken header for the end of the archive; the end must be zeros."""
    file.seek(end)
    if not repair and any(file.read(_TAR_BLOCK)):
        raise DataError(f"broken or truncated after byte {end}", path=path)


def _member_names(names: list[str], path: Path) -> list[str]:
    """:func:`_member_name` of each; names that are plain need one look at all of them."""
    if names:
        try:
            check_relative("/".join(names))  # an empty component where one begins or ends with "/"
        except DataError:
            return [_member_name(name, path) for name in names]
    return names


def _member_name(name: str, path: Path) -> str:
    try:
        return check_relative(name.removeprefix("./"))  # as `tar cf x.tar .` names them
    except DataError as error:
        raise DataError(error.message, path=path) from None


# ------------------------------------------------------------------------------------ writing


class FolderBlobWriter:
    """Write blobs as files below ``folder``, each atomically."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __contains__(self, name: str) -> bool:
        try:
            return safe_join(self._folder, name).is_file()
        except OSError:
            return False  # too long a name, or a folder closed to us: writing will say so

    def write(self, name: str, content: bytes) -> None:
        write_bytes(safe_join(self._folder, name), content)

    def close(self) -> None:
        pass


class TarBlobWriter:
    """Append blobs to a tar, which is made where it does not exist.

    Members have date 0, user 0 and mode 0644. A member that a killed run left incomplete is cut
    off when the tar is opened again, one that a full disk left is cut off at once.

    Raises
    ------
    OutputError : the tar cannot be written; names it.
    DataError : what stands at its place is not a tar.
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
        self._cut()

    def __contains__(self, name: str) -> bool:
        return name in self._index

    def write(self, name: str, content: bytes) -> None:
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


def _unreadable(path: Path, error: OSError) -> DataError:
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return DataError("file is missing", path=path)
    return DataError(f"cannot read: {error.strerror}", path=path)
