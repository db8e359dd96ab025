"""MATLAB's MAT files up to version 7, through SciPy."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import named, read_content, write_bytes

MatValue: TypeAlias = "NDArray[Any] | str | list[MatValue] | dict[str, MatValue] | None"
"""Numbers in MATLAB's shape, text, a cell or an array of structs as a list, or one struct."""

_HEADER_TEXT = b"MATLAB 5.0 MAT-file".ljust(116)


def read_mat(content: bytes, names: list[str] | None = None) -> dict[str, MatValue]:
    """Return the variables of a MAT file by name; ``names`` None means all."""
    from scipy.io import loadmat

    try:
        variables = loadmat(io.BytesIO(content), variable_names=names)
    except Exception as error:  # SciPy raises many kinds on broken files
        message = f"not a MAT file that SciPy can read ({error}); MATLAB's save -v7 writes them"
        raise DataError(message) from error
    return {n: _plain(value) for n, value in variables.items() if not n.startswith("__")}


def read_mat_array(path: Path | str, name: str) -> NDArray[np.float64]:
    """Return a real array as float64 in MATLAB's shape."""
    with named(path):
        array = read_mat(read_content(path), [name]).get(name)
        if array is None:
            raise DataError(f"no variable {name!r}")
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
            raise DataError(f"{name!r} is no array of real numbers")
        return array.astype(np.float64)


def write_mat_arrays(path: Path | str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write real arrays as MATLAB's save does (v7, compressed), deterministically."""
    from scipy.io import savemat

    out = io.BytesIO()
    savemat(out, dict(arrays), do_compression=True)
    write_bytes(path, _HEADER_TEXT + out.getvalue()[len(_HEADER_TEXT) :])  # without SciPy's date


def _plain(value: Any) -> MatValue:
    if not isinstance(value, np.ndarray):
        return None
    if value.dtype.names:
        structs: list[MatValue] = [
            {name: _plain(row[name]) for name in value.dtype.names} for row in value.ravel("F")
        ]
        return structs[0] if len(structs) == 1 else structs
    if value.dtype == object:
        return [_plain(item) for item in value.ravel("F")]
    return "".join(value.ravel()) if value.dtype.kind == "U" else value
