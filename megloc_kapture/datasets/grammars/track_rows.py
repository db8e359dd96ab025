"""Points with their tracks, a line each: read in bounded memory into arrays.

Small files are read in Python. Large ones go through the compiled loops of ``track_kernels.py`` in
two threads, chunk by chunk; a line the loops refuse goes through the same Python parser, which
raises, or takes it where it is merely unusual.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.grammars.model_lines import Line, ModelLines
from megloc_kapture.io.text_chunks import Chunk, num_threads

ALL_ROWS = 1 << 62
# how many lines Python reads after a refused one: where one is unusual, others will be
_LINES_BY_PYTHON = 100


class Row(NamedTuple):
    """One point: where, its colour, and (image, feature, x, y) or (image, feature) of its track."""

    xyz: list[float]
    rgb: list[int]
    track: list[tuple[int, int]]
    xy: list[tuple[float, float]]


class TrackArrays(NamedTuple):
    """Many points: float64 (P, 3), uint8 (P, 3), int32 (P,); observations: int32 (O,), int32 (O,),
    float32 (O, 2), or (0, 2) where the rows do not say it.
    """

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    lengths: NDArray[np.int32]
    image_ids: NDArray[np.int32]
    feature_ids: NDArray[np.int32]
    xy_px: NDArray[np.float32]

    def point_ids(self) -> NDArray[np.int64]:
        """Rows of the points (O,), one for each observation."""
        return np.repeat(np.arange(len(self.lengths), dtype=np.int64), self.lengths)


@dataclass(frozen=True)
class RowFormat:
    """How rows are read: by Python and by a loop of ``track_kernels``.

    Parameters
    ----------
    parse : one line's values; None for a comment. Raises DataError.
    kernel : name of the compiled loop.
    num_images : image ids in the rows are below it.
    row_bytes, observation_bytes : the least a row and an observation take in the file.
    with_xy : whether observations say where they are.
    """

    parse: Callable[[Line], Row | None]
    kernel: str
    num_images: int
    row_bytes: int
    observation_bytes: int
    with_xy: bool


def read_tracks(
    lines: ModelLines, max_rows: int, row_format: RowFormat, *, compiled: bool
) -> TrackArrays:
    """Read ``max_rows`` rows, or fewer where the file ends before.

    Raises
    ------
    DataError : names file and line.
    """
    table = _Table(row_format.with_xy)
    if compiled:
        _read_chunks(lines, max_rows, row_format, table)
    else:
        _read_lines(lines, max_rows, row_format, table)
    return table.arrays()


def _read_lines(lines: ModelLines, max_rows: int, row_format: RowFormat, table: _Table) -> None:
    while table.num_rows < max_rows and (line := lines.row()) is not None:
        row = row_format.parse(line)
        if row is not None:
            table.add_row(row)


def _read_chunks(lines: ModelLines, max_rows: int, row_format: RowFormat, table: _Table) -> None:
    threads = num_threads()
    # the results of the chunks ahead, in their order; the rows may turn out to end before
    pending: deque[Future[_Block]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        while (left := max_rows - table.num_rows) > 0:
            bytes_ahead = 0
            for index in range(threads + 1):
                if index and left * row_format.row_bytes <= bytes_ahead:
                    break
                chunk = lines.chunk(index)
                if chunk is None:
                    break
                bytes_ahead += chunk.end - chunk.begin
                if index == len(pending):
                    pending.append(pool.submit(_parse, row_format, chunk, left))
            chunk = lines.chunk()
            if chunk is None:
                return
            block = pending.popleft().result()
            if len(block.arrays.lengths) > left:  # begun when more rows were to come
                block = _parse(row_format, chunk, left)
            table.add(block.arrays)
            lines.advance(block.position)
            if block.refused and table.num_rows < max_rows:
                _read_lines(
                    lines,
                    min(max_rows, table.num_rows + _LINES_BY_PYTHON),
                    row_format,
                    table,
                )
                pending = deque()


class _Block(NamedTuple):
    """What a loop read of a chunk, where it stopped, and whether it refused the line there."""

    arrays: TrackArrays
    position: int
    refused: bool


def _parse(row_format: RowFormat, chunk: Chunk, max_rows: int) -> _Block:
    from megloc_kapture.datasets.grammars import track_kernels as kernels
    from megloc_kapture.io.text_kernels import DONE

    size = chunk.end - chunk.begin
    # memory that is never written to costs nothing; what is kept is copied
    rows = min(max_rows, size // row_format.row_bytes + 1)
    room = size // row_format.observation_bytes + 1
    xyz = np.empty(3 * rows, np.uint64)
    rgb = np.empty((rows, 3), np.uint8)
    lengths = np.empty(rows, np.int32)
    images, features = np.empty(room, np.int32), np.empty(room, np.int32)
    xy = np.empty(2 * room if row_format.with_xy else 0, np.uint64)
    status, position, num_rows, num_read = getattr(kernels, row_format.kernel)(
        chunk.text,
        chunk.begin,
        chunk.end,
        max_rows,
        row_format.num_images,
        (xyz, rgb, lengths, images, features, xy),
    )
    arrays = TrackArrays(
        xyz[: 3 * num_rows].view(np.float64).reshape(-1, 3).copy(),
        rgb[:num_rows].copy(),
        lengths[:num_rows].copy(),
        images[:num_read].copy(),
        features[:num_read].copy(),
        xy[: 2 * num_read].view(np.float64).reshape(-1, 2).astype(np.float32),
    )
    return _Block(arrays, int(position), status != DONE)


class _Table:
    """Rows gathered in blocks, joined at the end."""

    def __init__(self, with_xy: bool) -> None:
        self._with_xy = with_xy
        self._blocks: list[TrackArrays] = []
        self._rows: list[Row] = []
        self.num_rows = 0

    def add_row(self, row: Row) -> None:
        self._rows.append(row)
        self.num_rows += 1
        if len(self._rows) == 1 << 12:
            self._close_rows()

    def add(self, block: TrackArrays) -> None:
        self._close_rows()
        self._blocks.append(block)
        self.num_rows += len(block.lengths)

    def arrays(self) -> TrackArrays:
        self._close_rows()
        if not self._blocks:
            self._blocks.append(_arrays([], self._with_xy))
        # field by field, and each let go before the next: the peak is little more than the result
        fields = [deque(parts) for parts in zip(*self._blocks, strict=True)]
        self._blocks = []
        joined = []
        for parts in fields:
            joined.append(np.concatenate(parts))
            parts.clear()
        return TrackArrays(*joined)

    def _close_rows(self) -> None:
        if self._rows:
            self._blocks.append(_arrays(self._rows, self._with_xy))
            self._rows = []


def _arrays(rows: list[Row], with_xy: bool) -> TrackArrays:
    tracks = np.array([pair for row in rows for pair in row.track], np.int32).reshape(-1, 2)
    xy = [place for row in rows for place in row.xy] if with_xy else []
    return TrackArrays(
        np.array([row.xyz for row in rows], np.float64).reshape(-1, 3),
        np.array([row.rgb for row in rows], np.uint8).reshape(-1, 3),
        np.array([len(row.track) for row in rows], np.int32),
        tracks[:, 0].copy(),
        tracks[:, 1].copy(),
        np.array(xy, np.float32).reshape(-1, 2),
    )
