"""Global descriptors of a database: an array, or a source that is read block by block."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.retrieval.fusion import concatenate


class VectorBlocks(Protocol):
    """Global descriptors of a database, of which no more than a block has to be in memory.

    Rows are of unit length, so that the inner product is the cosine; a zero row, of an image
    without features, is similar to nothing. A source that refuses values that are not finite may
    have an attribute ``finite = True``: its rows are not looked at again.
    """

    def __len__(self) -> int:
        """Number of rows."""
        ...

    @property
    def dimension(self) -> int:
        """Length D of a row."""
        ...

    def read(
        self, start: int, stop: int, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """The rows from ``start`` to ``stop``, float32 (stop - start, D).

        They may be in ``out``, a C-contiguous array of that shape: memory that is used again and
        again is much faster than new memory. They are not written to.
        """
        ...


VectorSource = VectorBlocks | NDArray[np.floating[Any]]


class ArrayBlocks:
    """An array (N, D) of unit or zero rows as a source of blocks; DataError if it is not 2-D."""

    def __init__(self, rows: NDArray[np.floating[Any]]) -> None:
        if rows.ndim != 2:
            raise DataError(f"global descriptors {rows.shape} are of different dimensions")
        self._rows = rows

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def dimension(self) -> int:
        return self._rows.shape[1]

    def read(
        self, start: int, stop: int, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        # a view where the array is float32 already
        return np.ascontiguousarray(self._rows[start:stop], dtype=np.float32)


class ConcatenatedBlocks:
    """Several features of the same images as one: early fusion, block by block.

    Raises DataError for sources of different lengths, OptionError for weights that cannot be used,
    see :func:`.fusion.concatenate`.
    """

    def __init__(
        self, sources: Sequence[VectorSource], weights: Sequence[float] | None = None
    ) -> None:
        self._sources = [as_blocks(source) for source in sources]
        self._weights = weights
        self._length = common_length(self._sources)
        self.read(0, 0)  # refuses weights now, not in the middle of a search

    def __len__(self) -> int:
        return self._length

    @property
    def dimension(self) -> int:
        return sum(source.dimension for source in self._sources)

    def read(
        self, start: int, stop: int, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        rows = [source.read(start, stop) for source in self._sources]
        return concatenate(rows, self._weights, out=out)


def as_blocks(source: VectorSource) -> VectorBlocks:
    """The source itself, or the array as one."""
    return ArrayBlocks(source) if isinstance(source, np.ndarray) else source


def common_length(sources: Sequence[VectorBlocks]) -> int:
    """Number of rows that all sources have; DataError where there is none, or they differ."""
    lengths = {len(source) for source in sources}
    if len(lengths) != 1:
        raise DataError(f"features of one set of images have {sorted(lengths)} rows")
    return lengths.pop()
