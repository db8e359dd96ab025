"""Many pieces of files of one known size, read straight into the rows of an array."""

from __future__ import annotations

import errno
import mmap
import os
import stat

import numpy as np
from numpy.typing import NDArray

# what lies between two rows is read over where it is less: a call costs more
_LARGEST_GAP = 1 << 16
_ROWS_PER_CALL = 512  # each with what lies before it: the system takes 1024 buffers at once


def read_rows_at(
    descriptor: int, offsets: NDArray[np.int64], into: NDArray[np.int64], rows: NDArray[np.uint8]
) -> bool:
    """Read pieces of a file, piece k from ``offsets[k]`` into the row ``into[k]``.

    Parameters
    ----------
    descriptor : of the open file; its position is neither used nor changed.
    offsets, into : int64 (K,), in any order.
    rows : uint8 (N, B), C-contiguous; B bytes are a piece.

    Returns
    -------
    Whether the file had all of them.

    Raises
    ------
    OSError : as the system says it.
    """
    width = rows.shape[1]
    flat = rows.reshape(-1).data
    between = memoryview(bytearray(_LARGEST_GAP))
    order = np.argsort(offsets, kind="stable")
    starts, places = offsets[order], into[order] * width
    gaps = np.diff(starts) - width
    # a new call where pieces are far apart, or overlap: one image asked for twice
    breaks = np.flatnonzero((gaps < 0) | (gaps >= _LARGEST_GAP)) + 1
    first = 0
    for stop in [*breaks.tolist(), len(starts)]:
        while first < stop:
            last = min(first + _ROWS_PER_CALL, stop)
            buffers = [flat[place : place + width] for place in places[first:last].tolist()]
            skipped = [between[:gap] for gap in gaps[first : last - 1].tolist()]
            woven = [view for pair in zip(buffers, skipped, strict=False) for view in pair]
            woven.append(buffers[-1])
            expected = int(starts[last - 1] - starts[first]) + width
            if os.preadv(descriptor, woven, int(starts[first])) != expected:
                one_by_one = zip(buffers, starts[first:last].tolist(), strict=True)
                if not all(read_fully(descriptor, view, start) for view, start in one_by_one):
                    return False
            first = last
    return True


def map_rows(descriptor: int, offsets: NDArray[np.int64], width: int) -> NDArray[np.uint8] | None:
    """Pieces of a file at a constant stride, as they lie in the system's cache: not copied.

    New memory costs more than reading does: the system clears each page before it is written.

    Parameters
    ----------
    offsets : int64 (K,), where the pieces begin.
    width : bytes of a piece.

    Returns
    -------
    uint8 (K, width), not writable, or None where the pieces lie otherwise or beyond the file's end.
    The file must not be cut while the rows are used: the system would end the process.

    Raises
    ------
    OSError : as the system says it.
    """
    if len(offsets) < 2:
        return None
    stride = int(offsets[1] - offsets[0])
    first, end = int(offsets[0]), int(offsets[-1]) + width
    if stride < width or (np.diff(offsets) != stride).any():
        return None
    if end > os.fstat(descriptor).st_size:
        return None
    begin = first - first % mmap.ALLOCATIONGRANULARITY
    # populated: one call instead of an interruption for every few pages
    flags = mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0)
    mapped = mmap.mmap(descriptor, end - begin, flags=flags, prot=mmap.PROT_READ, offset=begin)
    shape, strides = (len(offsets), width), (stride, 1)
    return np.ndarray(shape, np.uint8, buffer=mapped, offset=first - begin, strides=strides)


def read_fully(descriptor: int, view: memoryview, offset: int) -> bool:
    """Fill ``view`` with what a file has from ``offset`` on; whether there was enough."""
    done = 0
    while done < len(view):  # one call gives 2 GiB at most
        read = os.preadv(descriptor, [view[done:]], offset + done)
        if read == 0:
            return False
        done += read
    return True


def read_file_row(folder: int, name: str, row: memoryview) -> int | None:
    """Read a whole file into ``row``, in three calls to the system where the size is as expected.

    Parameters
    ----------
    folder : descriptor of the open folder.
    name : of the file in it, one component.

    Returns
    -------
    Its size, -1 where there is no such plain file, or None where it is a link, which is not
    followed. The row is filled only where the size is that of the row.

    Raises
    ------
    OSError : as the system says it.
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
        # one byte more than expected: tells a longer file
        try:
            read = os.preadv(descriptor, [row, bytearray(1)], 0)
        except OSError as error:
            if error.errno in (errno.EISDIR, errno.ESPIPE):  # a folder, a pipe
                return -1
            raise
        if read == len(row):
            return read
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            return -1
        if found.st_size == len(row) and not read_fully(descriptor, row, 0):
            return read  # being cut while we read
        return found.st_size
    finally:
        os.close(descriptor)
