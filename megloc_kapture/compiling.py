"""How compiled loops are compiled: at the first call, once per machine.

numba keeps what it compiled on disk and compiles again when the loop's own file changes. It does
not look at the files of other loops that are called, and would go on with what they were. So those
are part of the name that a loop is kept under.
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
    """Compile at the first call, without the interpreter's lock, and keep the result on disk.

    A division by zero gives infinity or NaN, as in numpy. Loops of other files that are called must
    be imported by name before.
    """
    called = _called_elsewhere(function)
    if called:
        function.__qualname__ = f"{function.__qualname__}_{called}"
    try:
        return njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # neither the package nor the home can be written to: nowhere to keep it
        return njit(nogil=True, error_model="numpy")(function)


def _called_elsewhere(function: Callable[..., Any]) -> str:
    """A digest of the loops of other files that the function's file has; empty without any."""
    others = [
        value.py_func
        for value in function.__globals__.values()
        if isinstance(value, Dispatcher) and value.py_func.__module__ != function.__module__
    ]
    # their names bear the digests of what they call in turn
    parts = {
        f"{other.__module__} {other.__qualname__} ".encode()
        + Path(other.__code__.co_filename).read_bytes()
        for other in others
    }
    return hashlib.sha256(b"".join(sorted(parts))).hexdigest()[:12] if parts else ""
