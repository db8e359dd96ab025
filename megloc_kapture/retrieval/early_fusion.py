"""Early fusion: several global descriptors of an image become one longer descriptor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.retrieval.weights import normalized_weights


def concatenate(
    vectors: Sequence[NDArray[np.float32]],
    weights: Sequence[float] | None = None,
    *,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Concatenate the descriptors of several features, row by row.

    The inner product of two rows is the weighted mean of the features' cosines: block i is scaled
    by the square root of ``w_i / sum(w)``. It is what late fusion by the mean gives, in one search.
    A row is of unit length where every feature's is; a feature of zeros, of an image that it finds
    nothing in, takes its share away.

    Parameters
    ----------
    vectors : float (N, D_i), rows of unit length or zero.
    weights : one per feature, positive; all equal by default.
    out : where to write the result.

    Returns
    -------
    float32 (N, sum of D_i).

    Raises
    ------
    OptionError : weights that cannot be used, or none of the features.
    DataError : features of different numbers of images.
    """
    scales = np.sqrt(normalized_weights(weights, len(vectors)))
    if len({len(rows) for rows in vectors}) != 1:
        raise DataError(f"features of {', '.join(str(len(rows)) for rows in vectors)} images")
    shape = (len(vectors[0]), sum(rows.shape[1] for rows in vectors))
    fused = np.empty(shape, dtype=np.float32) if out is None else out
    left = 0
    for rows, scale in zip(vectors, scales.tolist(), strict=True):
        right = left + rows.shape[1]
        np.multiply(rows, np.float32(scale), out=fused[:, left:right])
        left = right
    return fused
