"""Reading ``points3d.txt`` and ``observations.txt`` of large maps, in bounded memory.

The file is read in chunks of whole lines, each parsed by the compiled loops of
``text_kernels.py``. None is returned where a line is not in the plain form that these loops
accept: the Python parser then reads the file and says what is wrong, or that nothing is.
"""

from __future__ import annotations

import queue
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io import text_kernels as kernels
from megloc_kapture.io.kapture_csv import check_version
from megloc_kapture.io.text_chunks import CHUNK_BYTES, Chunk, num_threads, read_chunks

_MAX_LATE = 4096

_Result = TypeVar("_Result")

# what the caller does with a line that the loops refuse; it raises where the line is wrong
CheckLine = Callable[[str, int], None]


class ObservationArrays(NamedTuple):
    """All rows of a file: names as raw bytes, sorted; ids index them, in the order of the file."""

    image_names: list[bytes]
    type_names: list[bytes]
    point_ids: NDArray[np.int64]
    image_ids: NDArray[np.int32]
    keypoint_ids: NDArray[np.int32]
    type_ids: NDArray[np.int32]


def read_observation_arrays(
    path: Path, check_line: CheckLine, *, chunk_bytes: int = CHUNK_BYTES
) -> ObservationArrays | None:
    """Read ``observations.txt``; None where a line is unusual.

    Raises
    ------
    DataError : a line is wrong, or the file cannot be read.
    """
    # every thread has its own tables of names; ids become common ones at the end
    threads = num_threads()
    parsers = [_ObservationParser() for _ in range(threads)]
    free: queue.SimpleQueue[int] = queue.SimpleQueue()
    for index in range(threads):
        free.put(index)

    def parse(chunk: Chunk) -> tuple[int, list[_Part], int | None]:
        index = free.get()
        try:
            return index, *parsers[index].parse(chunk)
        finally:
            free.put(index)

    parts: list[tuple[int, _Part]] = []
    for chunk, (index, found, refused) in _in_threads(parse, _chunks(path, chunk_bytes), threads):
        if refused is not None:
            _check_refused(path, chunk, refused, check_line)
            return None
        parts += [(index, part) for part in found]
    image_names, image_maps = _merge([parser.images for parser in parsers])
    type_names, type_maps = _merge([parser.types for parser in parsers])
    total = sum(len(part.point_ids) for _, part in parts)
    result = ObservationArrays(
        image_names,
        type_names,
        np.empty(total, np.int64),
        np.empty(total, np.int32),
        np.empty(total, np.int32),
        np.zeros(total, np.int32),
    )
    start = 0
    for index, part in parts:
        rows = slice(start, start + len(part.point_ids))
        result.point_ids[rows] = part.point_ids
        result.keypoint_ids[rows] = part.keypoint_ids
        np.take(image_maps[index], part.image_ids, out=result.image_ids[rows])
        if len(type_names) > 1:
            np.take(type_maps[index], part.type_ids, out=result.type_ids[rows])
        start = rows.stop
    return result


def read_point_rows(
    path: Path, columns: int, check_line: CheckLine, *, chunk_bytes: int = CHUNK_BYTES
) -> NDArray[np.float64] | None:
    """Read ``points3d.txt`` as float64 (N, columns); None where a line is unusual.

    Raises
    ------
    DataError : a line is wrong, or the file cannot be read.
    """

    def parse(chunk: Chunk) -> tuple[NDArray[np.float64] | None, int | None]:
        _, lines = kernels.count_commas_and_lines(chunk.text[chunk.begin : chunk.end])
        bits = np.empty(lines * columns, np.uint64)
        late = np.empty((_MAX_LATE, 3), np.int64)
        status, line, rows, num_late = kernels.parse_points(
            chunk.text, chunk.begin, chunk.end, columns, bits, late
        )
        if status != kernels.DONE:
            return None, line
        values = bits[: rows * columns].view(np.float64)
        for index, begin, end in late[:num_late].tolist():
            values[index] = float(chunk.text[begin:end].tobytes())
        return values.reshape(rows, columns) if np.isfinite(values).all() else None, None

    parts: list[NDArray[np.float64]] = []
    threads = num_threads()
    for chunk, (values, refused) in _in_threads(parse, _chunks(path, chunk_bytes), threads):
        if refused is not None:
            _check_refused(path, chunk, refused, check_line)
        if values is None:
            return None
        parts.append(values)
    return np.concatenate(parts) if parts else np.empty((0, columns))


def _in_threads(
    work: Callable[[Chunk], _Result], chunks: Iterator[Chunk], threads: int
) -> Iterator[tuple[Chunk, _Result]]:
    """Every chunk with its result, in order; few chunks are in memory at a time."""
    pending: deque[tuple[Chunk, Future[_Result]]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        for chunk in chunks:
            pending.append((chunk, pool.submit(work, chunk)))
            if len(pending) > threads:
                first, future = pending.popleft()
                yield first, future.result()
        for first, future in pending:
            yield first, future.result()


class _Part(NamedTuple):
    point_ids: NDArray[np.int64]
    image_ids: NDArray[np.int32]
    keypoint_ids: NDArray[np.int32]
    type_ids: NDArray[np.uint8]

    def rows(self, begin: int, end: int) -> _Part:
        return _Part(
            self.point_ids[begin:end],
            self.image_ids[begin:end],
            self.keypoint_ids[begin:end],
            self.type_ids[begin:end],
        )


class _ObservationParser:
    """The tables of names of one thread."""

    def __init__(self) -> None:
        self.images = _NameTable(1 << 14)
        self.types = _NameTable(256)

    def parse(self, chunk: Chunk) -> tuple[list[_Part], int | None]:
        """Rows of a chunk, and the position of the line that was refused, if one was."""
        commas, _ = kernels.count_commas_and_lines(chunk.text[chunk.begin : chunk.end])
        room = commas // 2 + 1
        out = _Part(
            np.empty(room, np.int64),
            np.empty(room, np.int32),
            np.empty(room, np.int32),
            np.empty(room, np.uint8),
        )
        words = chunk.text.view(np.uint64)
        parts = []
        begin = chunk.begin
        while True:
            status, begin, read = kernels.parse_observations(
                chunk.text,
                words,
                begin,
                chunk.end,
                self.images.arrays,
                self.types.arrays,
                tuple(out),
            )
            parts.append(out.rows(0, read))
            if status == kernels.DONE:
                return parts, None
            if status == kernels.REFUSED:
                return parts, int(begin)
            self.images.grow()
            out = out.rows(read, room)


def _merge(tables: list[_NameTable]) -> tuple[list[bytes], list[NDArray[np.int32]]]:
    """Sorted names of all tables, and for each table its ids' places among them."""
    names = [table.names() for table in tables]
    merged = sorted({name for of_table in names for name in of_table})
    places = {name: place for place, name in enumerate(merged)}
    maps = [np.array([places[n] for n in of_table], dtype=np.int32) for of_table in names]
    return merged, maps


def _check_refused(path: Path, chunk: Chunk, begin: int, check_line: CheckLine) -> None:
    before = chunk.text[chunk.begin : begin]
    number = chunk.first_line + int(np.count_nonzero(before == 10))
    text = chunk.text[begin : chunk.end].tobytes()
    try:
        line = text[: text.index(b"\n")].decode("utf-8")
    except UnicodeDecodeError:
        raise DataError("not UTF-8 text", path=path, line=number) from None
    # a comment in another script, or a line blank but for its spaces, is no row
    if line.strip() and not line.startswith("#"):
        check_line(line.removesuffix("\r"), number)


def _chunks(path: Path, chunk_bytes: int) -> Iterator[Chunk]:
    """Chunks of whole lines; the format version is checked on the first."""
    for chunk in read_chunks(path, chunk_bytes):
        if chunk.first_line == 1:
            head = chunk.text[chunk.begin : chunk.end].tobytes().split(b"\n", 1)[0]
            check_version(path, head.decode("utf-8", errors="replace"), required=False)
        yield chunk


class _NameTable:
    """Names seen so far, as the loops keep them: a hash table over words of text."""

    def __init__(self, room: int) -> None:
        slots = np.full(4 * room, -1, np.int32)
        store = np.zeros(16 * room, np.uint64)
        self.arrays = (
            slots,
            store,
            np.zeros(room, np.int64),
            np.zeros(room, np.int64),
            np.zeros(2, np.int64),
        )

    def __len__(self) -> int:
        return int(self.arrays[4][0])

    def grow(self) -> None:
        """Twice the room. The slots are filled again by looking every name up."""
        _, store, starts, lengths, count = self.arrays
        num_names, num_words = count.tolist()
        larger = _NameTable(2 * len(starts))
        longer = np.zeros(max(2 * len(store), len(larger.arrays[1])), np.uint64)
        larger.arrays = (larger.arrays[0], longer, *larger.arrays[2:])
        padded = np.concatenate([store[:num_words], np.zeros(2, np.uint64)])
        for start, length in zip(
            starts[:num_names].tolist(), lengths[:num_names].tolist(), strict=True
        ):
            kernels.add_name(padded, 8 * start, 8 * start + length, larger.arrays)
        self.arrays = larger.arrays

    def names(self) -> list[bytes]:
        _, store, starts, lengths, count = self.arrays
        number = int(count[0])
        content = store.astype("<u8").tobytes()
        return [
            content[8 * start : 8 * start + length]
            for start, length in zip(
                starts[:number].tolist(), lengths[:number].tolist(), strict=True
            )
        ]
