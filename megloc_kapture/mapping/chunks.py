"""Compiled loops over parts of a range, on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def in_chunks(count: int, size: int, work: Callable[[int, int], object]) -> None:
    """Call ``work(first, last)`` for parts of ``range(count)``, which must not mind the order."""
    chunks = [(first, min(first + size, count)) for first in range(0, count, size)]
    if len(chunks) < 2:
        for first, last in chunks:
            work(first, last)
        return
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as executor:
        for done in [executor.submit(work, first, last) for first, last in chunks]:
            done.result()
