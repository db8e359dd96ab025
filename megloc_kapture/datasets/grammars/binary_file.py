"""A binary file read from its beginning to its end, never beyond, with errors that say where."""

from __future__ import annotations

import os
import stat
import struct
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError

_BUFFER_BYTES = 1 << 20
_MAX_NAME_BYTES = 4096


def check_plain(path: Path) -> None:
    """Refuse what is no file: a pipe or a device might never end.

    Raises
    ------
    DataError : missing, not a plain file, or out of reach.
    """
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError as error:
        raise DataError("file is missing", path=path) from error
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror}", path=path) from error
    if not stat.S_ISREG(mode):
        raise DataError("not a plain file", path=path)


class BinaryFile:
    """A little-endian file; every count is compared with the size before memory is taken.

    Use as a context manager.

    Raises
    ------
    DataError : missing, not readable, or not a plain file.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        check_plain(self.path)
        try:
            self._file = open(self.path, "rb", buffering=_BUFFER_BYTES)  # noqa: SIM115
            self.size = os.fstat(self._file.fileno()).st_size
        except FileNotFoundError as error:
            raise DataError("file is missing", path=path) from error
        except OSError as error:
            raise DataError(f"cannot read: {error.strerror}", path=path) from error
        self.position = 0

    def error(self, message: str, position: int | None = None) -> DataError:
        """The error for what stands at a position, by default the present one."""
        place = self.position if position is None else position
        return DataError(f"{message} (byte {place} of {self.size})", path=self.path)

    def take(self, num_bytes: int, what: str) -> bytes:
        """The next bytes.

        Raises
        ------
        DataError : the file ends before.
        """
        self._check(num_bytes, what)
        try:
            content = self._file.read(num_bytes)
        except OSError as error:
            raise DataError(f"cannot read: {error.strerror}", path=self.path) from error
        if len(content) != num_bytes:
            raise self.error(f"the file ends within {what}")
        self.position += num_bytes
        return content

    def skip(self, num_bytes: int, what: str) -> None:
        """Pass over the next bytes; see :meth:`take`."""
        self._check(num_bytes, what)
        self.position += num_bytes
        self._file.seek(self.position)

    def rest(self) -> NDArray[np.uint8]:
        """Everything from here to the end, uint8."""
        return np.frombuffer(self.take(self.size - self.position, "the file"), np.uint8)

    def unpack(self, record: struct.Struct, what: str) -> tuple[Any, ...]:
        """The values of the next record."""
        return record.unpack(self.take(record.size, what))

    def count(self, what: str, item_bytes: int) -> int:
        """The next uint64, a number of things that take at least ``item_bytes`` each.

        Raises
        ------
        DataError : what is left of the file cannot hold that many.
        """
        start = self.position
        number = int.from_bytes(self.take(8, f"the number of {what}"), "little")
        if number * item_bytes > self.size - self.position:
            raise self.error(f"{number} {what} do not fit into the file", start)
        return number

    def name(self, what: str) -> bytes:
        """The next bytes up to a NUL, which is taken too.

        Raises
        ------
        DataError : no NUL within 4096 bytes.
        """
        available = min(_MAX_NAME_BYTES + 1, self.size - self.position)
        content = b""
        while len(content) < available:
            content += self._file.read(min(256, available - len(content)))
            end = content.find(b"\0")
            if end >= 0:
                self.position += end + 1
                self._file.seek(self.position)
                return content[:end]
        raise self.error(f"{what} does not end")

    def finish(self, what: str) -> None:
        """Raise DataError where bytes follow after all that was to come."""
        if self.position != self.size:
            raise self.error(f"{self.size - self.position} bytes follow after the last of {what}")

    def _check(self, num_bytes: int, what: str) -> None:
        if num_bytes > self.size - self.position:
            raise self.error(f"the file ends within {what}")

    def __enter__(self) -> BinaryFile:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()
