"""Compilation of loops with numba at their first call; the result is cached on disk.

numba compiles a cached loop again only if the loop's own file changes. The name in the cache
therefore contains a digest of the other files that define loops called by this one.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit
from numba.core.dispatcher import Dispatcher


def compiled_loop(function: Callable[..., Any]) -> Any:
    """Compile a function at its first call, to run without the GIL, and cache the result on disk.

    Division by zero gives infinity or NaN, as in numpy. If the function calls loops from other
    files, import these by name before this decorator runs.
    """
    called = _called_elsewhere(function)
    if called:
        function.__qualname__ = f"{function.__qualname__}_{called}"
    try:
        return njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # no writable cache in package or home
        return njit(nogil=True, error_model="numpy")(function)


def _called_elsewhere(function: Callable[..., Any]) -> str:
    """Return a digest of the files of imported loops; an empty text if none is imported."""
    others = [
        value.py_func
        for value in function.__globals__.values()
        if isinstance(value, Dispatcher) and value.py_func.__module__ != function.__module__
    ]
    # the name of an imported loop contains the digest of the loops that it imports in turn
    parts = {
        f"{other.__module__} {other.__qualname__} ".encode()
        + Path(other.__code__.co_filename).read_bytes()
        for other in others
    }
    return hashlib.sha256(b"".join(sorted(parts))).hexdigest()[:12] if parts else ""
