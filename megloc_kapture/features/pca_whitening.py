"""PCA whitening of global descriptors, learnt from few of them.

Jegou and Chum, "Negative evidences and co-occurrences in image retrieval", ECCV 2012: vectors of
several vocabularies are centred, turned into the frame of their principal components, divided by
the deviation along each, cut and scaled to unit length. That makes up for what occurs together and
removes what the vocabularies tell twice.

A map has fewer images than its vectors have dimensions. The deviations along the last components
are then noise, and N vectors in N - 1 dimensions divided by them are all equally unlike. So the
deviation may be taken to a power below one, as AP-GeM's published whitening does (Revaud et al.,
ICCV 2019: the variance to the power 0.25, which is 0.5 here).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError

_COLUMNS = 4096  # dimensions that are held in float64 at once
# variances below this share of the first are rounding of the float32 vectors
_LEAST = 1e-9


@dataclass(frozen=True, eq=False)
class PcaWhitening:
    """``y = projection (x - mean)``, then unit length.

    Attributes
    ----------
    mean : float32 (D,).
    projection : float32 (d, D), rows are scaled principal components, the strongest first.
    """

    mean: NDArray[np.float32]
    projection: NDArray[np.float32]

    def apply(self, vector: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Whiten one vector (D,): float32 (d,), unit length; the zero vector gives zero."""
        if not np.any(vector):
            return np.zeros(len(self.projection), dtype=np.float32)
        whitened = self.projection @ (np.asarray(vector, dtype=np.float32) - self.mean)
        norm = np.linalg.norm(whitened)
        return whitened / norm if norm > 0 else whitened


def learn_whitening(
    vectors: NDArray[np.float32], dimensions: int, power: float = 1.0
) -> PcaWhitening:
    """Learn whitening from vectors (N, D).

    Parameters
    ----------
    vectors : float32; overwritten by the centred ones, they may be large.
    dimensions : at most this many are kept, and never more than the vectors vary in, which is
        less than N.
    power : of the deviation that each component is divided by: 1 whitens, 0 only turns and cuts.

    Raises
    ------
    DataError : fewer than two different vectors.
    """
    mean = vectors.mean(axis=0, dtype=np.float64).astype(np.float32)
    vectors -= mean
    count, size = vectors.shape
    # N x N: its eigenvectors give those of the D x D covariance
    variances, axes = np.linalg.eigh(_gram(vectors) / count)
    variances, axes = variances[::-1], axes[:, ::-1]  # the strongest first
    kept = min(dimensions, count - 1, int((variances > _LEAST * variances[0]).sum()))
    if kept < 1 or variances[0] <= 0:
        raise DataError(
            f"whitening cannot be learnt from {count} images that do not differ: use more images, "
            "or no whitening"
        )
    variances, axes = variances[:kept], axes[:, :kept]
    # rows of unit length in the vectors' space, then divided by the deviations
    rows = (axes / np.sqrt(count * variances) / variances ** (power / 2)).T
    projection = np.empty((kept, size), dtype=np.float32)
    for start in range(0, size, _COLUMNS):
        part = vectors[:, start : start + _COLUMNS].astype(np.float64)
        projection[:, start : start + _COLUMNS] = rows @ part
    # an axis may point either way: its largest entry is positive
    largest = np.take_along_axis(projection, np.abs(projection).argmax(axis=1)[:, None], axis=1)
    projection *= np.where(largest < 0, np.float32(-1), np.float32(1))
    return PcaWhitening(mean, projection)


def _gram(vectors: NDArray[np.float32]) -> NDArray[np.float64]:
    gram = np.zeros((len(vectors), len(vectors)))
    for start in range(0, vectors.shape[1], _COLUMNS):
        part = vectors[:, start : start + _COLUMNS].astype(np.float64)
        gram += part @ part.T
    return gram
