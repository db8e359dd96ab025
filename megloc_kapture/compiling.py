"""Compilation of loops: at the first call, cached once per machine.

numba invalidates its cache only for changes of the loop's own file. So the cached name contains a
digest of the called loops of other files.
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
    """Compile at the first call, without the interpreter's lock, and cache the result on disk.

    Division by zero gives infinity or NaN, as in numpy. Loops called from other files must be
    imported by name beforehand.
    """
    called = _called_elsewhere(function)
    if called:
        function.__qualname__ = f"{function.__qualname__}_{called}"
    try:
        return njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # no writable cache in package or home
        return njit(nogil=True, error_model="numpy")(function)


def _called_elsewhere(function: Callable[..., Any]) -> str:
    """Return a digest of loops imported from other files, or an empty text without any."""
    others = [
        value.py_func
        for value in function.__globals__.values()
        if isinstance(value, Dispatcher) and value.py_func.__module__ != function.__module__
    ]
    # their names contain the digests of the loops that they call
    parts = {
        f"{other.__module__} {other.__qualname__} ".encode()
        + Path(other.__code__.co_filename).read_bytes()
        for other in others
    }
    return hashlib.sha256(b"".join(sorted(parts))).hexdigest()[:12] if parts else ""
