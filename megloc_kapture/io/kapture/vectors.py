"""Global features of many images as blocks of unit rows, float32."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.features import FeatureReader

_ROWS_AT_ONCE = 256  # a chunk fits the processor's cache
_ROUNDING = 4e-7  # rows whose squared length is one up to this stay unchanged


class KaptureVectors:
    """Global features of images as blocks of unit rows, without a cache; zero rows stay zero."""

    def __init__(self, reader: FeatureReader, images: Sequence[str]) -> None:
        self._reader = reader
        self._images = images

    def __len__(self) -> int:
        return len(self._images)

    @property
    def dimension(self) -> int:
        return self._reader.config.dsize

    def part(self, start: int, stop: int) -> KaptureVectors:
        return KaptureVectors(self._reader, self._images[start:stop])

    def read(
        self, start: int, stop: int, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Read unit rows of the images ``start`` to ``stop``, (stop - start, D), into ``out``."""
        images = self._images[start:stop]
        rows = np.empty((len(images), self.dimension), np.float32) if out is None else out
        for begin in range(0, len(images), _ROWS_AT_ONCE):
            chunk = rows[begin : begin + _ROWS_AT_ONCE]
            some = images[begin : begin + _ROWS_AT_ONCE]
            with np.errstate(over="ignore"):  # overflow of float32 is refused below
                for row, image in zip(chunk, some, strict=True):
                    row[:] = self._reader.read_unchecked(image)
            with np.errstate(over="ignore", invalid="ignore"):
                squared = np.vecdot(chunk, chunk).astype(np.float64)
            for k in np.flatnonzero(~((squared > 1e-24) & (squared < 1e30))).tolist():
                squared[k] = np.square(chunk[k], dtype=np.float64).sum()
                if not np.isfinite(squared[k]):
                    raise DataError("not all values are finite", path=self._reader.where(some[k]))
            scaled = np.flatnonzero((squared > 0) & (np.abs(squared - 1) > _ROUNDING))
            if len(scaled):
                chunk[scaled] /= np.sqrt(squared[scaled])[:, None]
        return rows
