"""The global features of many images at once: float32 rows, or blocks of unit rows.

A map of ten thousand images has some hundred megabytes of them, so they are read straight into
their rows and scaled while they are in the processor's cache; vectors of unit length that lie alike
in one tar are used where they lie.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.blobs import TarBlobs
from megloc_kapture.io.kapture.features import SUFFIX, FeatureReader

_CHUNK_BYTES = 1 << 22  # few enough calls, and little enough for a cache
_THREADS = 4  # more do not copy faster from memory to memory
# squared lengths that float32 holds without loss; others are computed in float64
_SQUARED_LENGTHS = (1e-24, 1e30)
_UNIT = 4e-7  # a squared length that far from one is one, but for rounding


class KaptureVectors:
    """Global features of images as blocks of unit rows; zero rows stay zero.

    A source of blocks as ``megloc_kapture.retrieval.search.VectorBlocks`` says it: nothing is kept
    between reads, so any number of images will do.
    """

    def __init__(self, reader: FeatureReader, images: Sequence[str]) -> None:
        self._reader = reader
        self._images = images

    def __len__(self) -> int:
        return len(self._images)

    @property
    def dimension(self) -> int:
        """Length D of a vector."""
        return self._reader.config.dsize

    def part(self, start: int, stop: int) -> KaptureVectors:
        """Those of the images ``start`` to ``stop``."""
        return KaptureVectors(self._reader, self._images[start:stop])

    def read(
        self, start: int, stop: int, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Unit rows of the images ``start`` to ``stop``, float32 (stop - start, D).

        Parameters
        ----------
        out : where to write them, C-contiguous; a new array by default. It stays as it is where
            the rows lie as they should in a tar: then those are returned, and cannot be written.

        Raises
        ------
        DataError : an image has no vector, one that is cut, or one with values that are not
            finite; names it.
        """
        images = self._images[start:stop]
        mapped = self._mapped(images)
        if mapped is not None and _are_unit(mapped):
            return mapped
        rows = np.empty((len(images), self.dimension), np.float32) if out is None else out
        step = max(1, _CHUNK_BYTES // self._reader.config.row_bytes)

        def read_chunk(chunk: slice) -> None:
            same = self._reader.config.dtype == rows.dtype
            stored = rows[chunk] if same else np.empty(rows[chunk].shape, self._reader.config.dtype)
            read_stored(self._reader, images[chunk], stored)
            if not same:
                with np.errstate(over="ignore"):
                    rows[chunk] = stored
            bad = _scale_to_unit_length(rows[chunk])
            if bad is not None:
                where = self._reader.where(images[chunk][bad])
                raise DataError("not all values are finite", path=where)

        _each(
            read_chunk, [slice(k, min(k + step, len(images))) for k in range(0, len(images), step)]
        )
        return rows

    def _mapped(self, images: Sequence[str]) -> NDArray[Any] | None:
        """Vectors (N, D) where they lie, if they lie alike in one tar; they cannot be written.

        The tar must not be cut while they are used.
        """
        source, config = self._reader.sources[0], self._reader.config
        if not isinstance(source, TarBlobs):
            return None
        names = [image + SUFFIX["global_features"] for image in images]
        rows = source.map_rows(names, config.row_bytes)
        return None if rows is None else rows.view(config.dtype)


def read_stored(reader: FeatureReader, images: Sequence[str], rows: NDArray[Any]) -> None:
    """Read global features of images into the rows of an array, unchecked but for their size.

    Parameters
    ----------
    rows : (N, dsize), C-contiguous, of the configuration's dtype.

    Raises
    ------
    DataError : an image has none, or one that is cut; names it.
    """
    todo = np.arange(len(images))
    content = rows.view(np.uint8)
    for source in reader.sources:
        if len(todo) == 0:
            return
        names = [images[k] + SUFFIX["global_features"] for k in todo.tolist()]
        whole = len(todo) == len(images)
        here = content if whole else np.empty((len(todo), content.shape[1]), dtype=np.uint8)
        sizes = source.read_rows(names, here)
        for k in np.flatnonzero((sizes >= 0) & (sizes != reader.config.row_bytes)).tolist():
            reader.num_rows(source, names[k], int(sizes[k]))  # says what is wrong
        found = sizes >= 0
        if not whole:
            content[todo[found]] = here[found]
        todo = todo[~found]
    if len(todo):
        raise DataError(
            f"{len(todo)} images have no global feature of type {reader.type_name}, "
            f"the first is {images[int(todo[0])]}"
        )


def _each(work: Callable[[slice], None], chunks: Sequence[slice]) -> None:
    """Do all chunks, on a few threads: what takes time is the system's, and vector arithmetic.

    Of several errors that of the first chunk is raised.
    """
    threads = min(_THREADS, os.cpu_count() or 1, len(chunks))
    if threads < 2:
        for chunk in chunks:
            work(chunk)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, chunks))


def _are_unit(rows: NDArray[Any]) -> bool:
    """True for float32 rows of unit length, as most methods store them."""
    if rows.dtype != np.dtype("<f4") or not rows.dtype.isnative:
        return False
    with np.errstate(over="ignore", invalid="ignore"):
        # in one thread: it is as fast as the memory is
        lengths = np.vecdot(rows, rows)
    return bool((np.abs(lengths - 1) <= _UNIT).all())


def _scale_to_unit_length(rows: NDArray[np.float32]) -> int | None:
    """Scale rows (N, D) in place; the first that cannot be, or None."""
    with np.errstate(over="ignore", invalid="ignore"):
        squared = np.vecdot(rows, rows)
    least, largest = _SQUARED_LENGTHS
    usual = (squared >= least) & (squared <= largest)
    scale = np.ones(len(rows), dtype=np.float32)
    np.divide(1, np.sqrt(squared, where=usual, out=scale), where=usual, out=scale)
    for k in np.flatnonzero(~usual).tolist():
        row = rows[k].astype(np.float64)
        if not np.isfinite(row).all():
            return k
        length = np.linalg.norm(row)
        if length > 0:
            rows[k] = row / length
    scale[np.abs(squared - 1) <= _UNIT] = 1
    if (scale != 1).any():
        np.multiply(rows, scale[:, None], out=rows)
    return None
