"""Large text files in chunks of whole lines, in bounded memory, for compiled loops to read."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_csv import BYTE_ORDER_MARK

CHUNK_BYTES = 1 << 23
# the loops run at half a gigabyte per second and thread; two keep up with most disks
MAX_THREADS = 2
# zeros after the end of a chunk: the loops look some bytes ahead
PADDING = 32
# no row of any format here comes near it; a file without line breaks shall not fill the memory
MAX_LINE_BYTES = 1 << 28


class Chunk(NamedTuple):
    """Whole lines: ``text[begin:end]`` ends with a line break, zeros follow."""

    text: NDArray[np.uint8]
    begin: int
    end: int
    first_line: int


def num_threads() -> int:
    """How many threads read chunks at once."""
    return max(1, min(MAX_THREADS, os.cpu_count() or 1))


def read_chunks(path: Path, chunk_bytes: int = CHUNK_BYTES) -> Iterator[Chunk]:
    """Chunks of a file, each in memory of its own; a missing last line break is added.

    The first chunk begins after the byte order mark, if there is one.

    Raises
    ------
    DataError : missing or not readable, or a line longer than ``MAX_LINE_BYTES``.
    """
    try:
        with io.FileIO(path, "rb") as file:
            yield from _read_chunks(path, file, chunk_bytes)
    except FileNotFoundError as error:
        raise DataError("file is missing", path=path) from error
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror}", path=path) from error


def _read_chunks(path: Path, file: io.FileIO, chunk_bytes: int) -> Iterator[Chunk]:
    rest = np.empty(0, np.uint8)
    line = 1
    first = True
    while True:
        # as much again as what is left over: a line longer than a chunk is not copied too often
        room = len(rest) + max(chunk_bytes, len(rest))
        text = np.empty((room + 1 + PADDING + 7) // 8 * 8, np.uint8)
        text[: len(rest)] = rest
        read = file.readinto(text.data[len(rest) : room])
        filled = len(rest) + read
        if read:
            end = _last_break(text, filled) + 1
        elif filled:
            text[filled] = 10  # the last line lacks its break
            end = filled = filled + 1
        else:
            return
        rest = text[end:filled].copy()
        if len(rest) > MAX_LINE_BYTES:
            line += int(np.count_nonzero(text[:end] == 10))
            raise DataError(f"a line of more than {MAX_LINE_BYTES} bytes", path=path, line=line)
        if end == 0:
            continue  # a line longer than a chunk
        text[end:] = 0
        begin = 0
        if first and text[: len(BYTE_ORDER_MARK)].tobytes() == BYTE_ORDER_MARK:
            begin = len(BYTE_ORDER_MARK)
        first = False
        yield Chunk(text, begin, end, line)
        line += int(np.count_nonzero(text[:end] == 10))


def _last_break(text: NDArray[np.uint8], filled: int) -> int:
    """Position of the last line break before ``filled``, or -1."""
    step = 1 << 12
    for stop in range(filled, 0, -step):
        start = max(0, stop - step)
        found = np.flatnonzero(text[start:stop] == 10)
        if len(found):
            return start + int(found[-1])
    return -1
