"""Variables of MATLAB's MAT files (level 5, as ``save -v7`` writes them), plain data only.

:func:`read_mat` reads all of a file, :func:`read_mat_array` one array of a large one, of which
nothing else is unpacked. SciPy's reader says of itself that it is not made for files from
strangers: a wrong type code lets it follow a wild pointer. This one takes numbers, text, cells and
structs, and skips everything else (objects, functions, sparse and complex arrays), whose size
every element tells; counts are believed only as far as the file's bytes can bear them.

Format: MathWorks, MAT-File Format, chapter 1, level 5.
"""

from __future__ import annotations

import contextlib
import io
import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import named, read_content, write_bytes

MatValue: TypeAlias = "NDArray[Any] | str | list[MatValue] | dict[str, MatValue] | None"
"""Numbers (MATLAB's shape), text, a cell or an array of structs, one struct; None: not read."""

_HEADER = 128
_ENDIAN = {b"IM": "<", b"MI": ">"}
_LEVEL_5, _LEVEL_7_3 = 0x0100, 0x0200
_HDF5_MARK = b"\x89HDF\r\n\x1a\n"
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"} | {
    12: "i8",
    13: "u8",
}
_TEXT = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _CHAR, _NUMBERS = 1, 2, 4, range(6, 16)
_COMPLEX = 0x0800
_DEEPEST = 32  # cells in structs in cells: a file that goes on is refused
_LARGEST = 1 << 31  # bytes of one variable unpacked; NetVLAD's has 0.6e9
_MAX_RATIO = 1032  # no stream of zlib unpacks to more than this many times its size
_HEAD_BYTES = 512  # enough for an array's flags, dimensions and name
_CHUNK = 1 << 20


class _BrokenError(ValueError):
    """The bytes are no MAT file; becomes a DataError that names the file and the variable."""


class _Head(NamedTuple):
    """The beginning of an array; ``values_at`` is the offset of its values."""

    kind: int
    is_complex: bool
    shape: tuple[int, ...]
    name: str
    values_at: int


def read_mat(content: bytes) -> dict[str, MatValue]:
    """All variables of a MAT file by name; nothing of the file is run.

    Parameters
    ----------
    content : the file's bytes. Arrays of a file that is not compressed are views of them.

    Raises
    ------
    DataError : no MAT file of level 5, damaged, or larger unpacked than 2 GiB; names the byte where
        the broken variable begins.
    """
    order = _byte_order(content)
    found: dict[str, MatValue] = {}
    for offset, kind, body in _variables(content, order):
        with _variable_at(offset):
            if kind == _COMPRESSED:
                kind, body, _ = _element(_unpacked(body, order), 0, order)
            if kind == _MATRIX:
                name, value = _matrix(body, order, 0)
                found[name] = value
    return found


def read_mat_array(path: Path | str, name: str) -> NDArray[np.float64]:
    """Read the array ``name`` of real numbers, float64 and of the shape it has in MATLAB.

    Other variables are neither unpacked nor kept.

    Raises
    ------
    DataError : missing, truncated, another format, no such variable, or it is no array of real
        numbers; names the file, and the byte where the variable begins.
    """
    content = read_content(path)
    names = []
    with named(path):
        order = _byte_order(content)
        for offset, kind, body in _variables(content, order):
            with _variable_at(offset):
                if kind not in (_MATRIX, _COMPRESSED):
                    raise _BrokenError(f"data type {kind}, not an array")
                start = body
                if kind == _COMPRESSED:  # the array's beginning, behind the element's tag
                    start = memoryview(zlib.decompressobj().decompress(body, 8 + _HEAD_BYTES))[8:]
                head = _head(start, order)
                if head.name != name:
                    names.append(head.name)
                    continue
                if head.kind not in _NUMBERS or head.is_complex:
                    raise _BrokenError(f"no array of real numbers (class {head.kind})")
                if kind == _COMPRESSED:
                    _, body, _ = _element(_unpacked(body, order), 0, order)
                return _numbers(body, head.values_at, order, head.shape).astype(np.float64)
        there = ", ".join(map(repr, names[:5])) or "none"
        raise DataError(f"no variable {name!r}; it has {there}")


def write_mat_arrays(path: Path | str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write real arrays as MATLAB's save does (v7, compressed), the same bytes each time.

    Raises
    ------
    ValueError : an array of fewer than two dimensions, which MATLAB does not know.
    OutputError : the file cannot be written.
    """
    from scipy.io import savemat

    for name, array in arrays.items():
        if array.ndim < 2 or array.dtype.kind not in "fiu":
            raise ValueError(f"cannot write {name}: {array.dtype} of {array.ndim} dimensions")
    out = io.BytesIO()
    savemat(out, dict(arrays), do_compression=True)
    text = b"MATLAB 5.0 MAT-file".ljust(_HEADER - 12)  # SciPy's has the date
    write_bytes(path, text + out.getvalue()[len(text) :])


@contextlib.contextmanager
def _variable_at(offset: int) -> Iterator[None]:
    """Name the variable in a DataError, of all that may be wrong with its bytes."""
    try:
        yield
    except (ValueError, struct.error, zlib.error) as error:
        raise DataError(
            f"not a MAT file that can be read: {error}, in the variable at byte {offset}"
        ) from error


def _byte_order(content: bytes) -> str:
    problem = None
    order = _ENDIAN.get(content[_HEADER - 2 : _HEADER], "")
    version = struct.unpack_from(order + "H", content, _HEADER - 4)[0] if order else None
    if (
        version == _LEVEL_7_3
        or _HDF5_MARK in (content[:8], content[512:520])
        or content.startswith(b"MATLAB 7.3")
    ):
        problem = "it is of level 7.3 (HDF5); save it with -v7"
    elif version is None:
        problem = "it is none of level 5, as MATLAB's save -v7 writes them"
    elif version != _LEVEL_5:
        problem = f"its level is {version:#x}, not {_LEVEL_5:#x}"
    if problem:
        raise DataError(f"not a MAT file that can be read: {problem}")
    return order


def _variables(content: bytes, order: str) -> Iterator[tuple[int, int, memoryview]]:
    """Offset, type and bytes of the elements of a file."""
    at, view = _HEADER, memoryview(content)
    while at < len(content):
        offset = at
        with _variable_at(offset):
            kind, body, at = _element(view, at, order)
        yield offset, kind, body


def _element(data: memoryview, at: int, order: str) -> tuple[int, memoryview, int]:
    """Type and bytes of the element at an offset, and the offset of the next one."""
    if at + 8 > len(data):
        raise _BrokenError("it ends too early")
    kind, size = struct.unpack_from(order + "II", data, at)
    if kind >> 16:  # up to four bytes stand in the tag itself
        kind, size, start, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if size > 4:
            raise _BrokenError(f"{size} bytes where 4 fit")
    else:
        start = at + 8
        # all but packed elements fill up to whole eights; the last one of a file need not
        after = start + size + (0 if kind == _COMPRESSED else -size % 8)
    if start + size > len(data):
        raise _BrokenError(f"it ends too early: {size} bytes announced, {len(data) - start} there")
    return kind, data[start : start + size], after


def _unpacked(packed: memoryview, order: str) -> memoryview:
    """The one element in a packed element, in memory that may be written to."""
    tag = zlib.decompressobj().decompress(packed[:_CHUNK], 8)
    size = struct.unpack(order + "II", tag)[1] + 8
    if size > _LARGEST:
        raise _BrokenError(f"a variable of {size} bytes, more than {_LARGEST}")
    if size > _MAX_RATIO * len(packed):
        raise _BrokenError(f"{size} bytes announced, more than there can be")
    # memory is asked for in one piece, as joining pieces would need it twice, and taken as it fills
    unpacked, filled, stream = np.empty(size, np.uint8), 0, zlib.decompressobj()
    for start in range(0, len(packed), _CHUNK):
        part = stream.decompress(packed[start : start + _CHUNK], size - filled + 1)
        if filled + len(part) > size:
            raise _BrokenError("more is packed in an element than it says")
        unpacked[filled : filled + len(part)] = np.frombuffer(part, np.uint8)
        filled += len(part)
    if filled < size or not stream.eof:
        raise _BrokenError("it ends too early")
    return unpacked.data


def _head(data: memoryview, order: str) -> _Head:
    _, flags, at = _element(data, 0, order)
    word = struct.unpack_from(order + "I", flags)[0]
    _, sizes, at = _element(data, at, order)
    shape = struct.unpack(f"{order}{len(sizes) // 4}i", sizes)
    if len(shape) < 2 or len(shape) > 32 or min(shape) < 0:
        raise _BrokenError(f"an array of shape {shape[:4]}")
    _, letters, at = _element(data, at, order)
    name = bytes(letters).decode("latin-1")
    return _Head(word & 0xFF, bool(word & _COMPLEX), shape, name, at)


def _matrix(data: memoryview, order: str, depth: int) -> tuple[str, MatValue]:
    """Name and value of an array."""
    if len(data) == 0:
        return "", np.zeros((0, 0))
    if depth > _DEEPEST:
        raise _BrokenError(f"more than {_DEEPEST} arrays in one another")
    kind, is_complex, shape, name, at = _head(data, order)
    if kind == _CELL:
        return name, _items(data, at, order, depth, math.prod(shape))
    if kind == _STRUCT:
        return name, _structs(data, at, order, depth, math.prod(shape))
    if kind == _CHAR:
        return name, _text(data, at, order)
    if kind in _NUMBERS and not is_complex:
        return name, _numbers(data, at, order, shape)
    return name, None


def _items(data: memoryview, at: int, order: str, depth: int, count: int) -> list[MatValue]:
    """``count`` arrays one after another."""
    if count * 8 > len(data) - at:
        raise _BrokenError(f"{count} arrays in {len(data) - at} bytes")
    items = []
    for _ in range(count):
        kind, body, at = _element(data, at, order)
        if kind != _MATRIX:
            raise _BrokenError(f"type {kind} where an array should be")
        items.append(_matrix(body, order, depth + 1)[1])
    return items


def _structs(data: memoryview, at: int, order: str, depth: int, count: int) -> MatValue:
    """One struct, or the list of several."""
    _, length, at = _element(data, at, order)
    width = struct.unpack(order + "i", length)[0]
    _, letters, at = _element(data, at, order)
    if width < 1 or len(letters) % width:
        raise _BrokenError(f"names of fields of {width} letters in {len(letters)}")
    names = [
        bytes(letters[start : start + width]).split(b"\0")[0].decode("latin-1")
        for start in range(0, len(letters), width)
    ]
    if not names:
        return {}
    items = _items(data, at, order, depth, count * len(names))
    rows = [
        dict(zip(names, items[start : start + len(names)], strict=True))
        for start in range(0, len(items), len(names))
    ]
    return rows[0] if count == 1 else list(rows)


def _text(data: memoryview, at: int, order: str) -> str:
    kind, letters, _ = _element(data, at, order)
    encoding = _TEXT.get(kind)
    if encoding is None:
        raise _BrokenError(f"text of type {kind}")
    if encoding in ("utf-16", "utf-32"):
        encoding += "-le" if order == "<" else "-be"
    return bytes(letters).decode(encoding)


def _numbers(data: memoryview, at: int, order: str, shape: tuple[int, ...]) -> NDArray[Any]:
    kind, values, _ = _element(data, at, order)
    stored = _STORED.get(kind)
    if stored is None:
        raise _BrokenError(f"numbers of type {kind}")
    dtype = np.dtype(order + stored)
    if math.prod(shape) * dtype.itemsize != len(values):
        raise _BrokenError(f"{len(values)} bytes for an array {shape} of {dtype.name}")
    return np.frombuffer(values, dtype).reshape(shape, order="F")
