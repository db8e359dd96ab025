"""MATLAB files (version 5 to v7): one array of real numbers, by its name.

A file may come from anywhere, and its counts are believed only as far as its bytes can bear
them; general readers allocate what a broken file tells them to, or fail in ways of their own.
What is not asked for is neither unpacked nor kept. Version 7.3 is HDF5, another format.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.kapture_csv import read_content

_HEADER_BYTES = 128
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
_INT8, _INT32, _UINT32 = 1, 5, 6
_REAL_CLASSES = (6, 7)  # double, single
_COMPLEX_FLAG = 0x0800
# no stream of zlib unpacks to more than this many times its size
_MAX_RATIO = 1032
_HEAD_BYTES = 512  # enough for an array's flags, dimensions and name
_MAX_DIMENSIONS = 8
_COMPRESSION = 1  # higher takes six times as long and saves two percent of a scan
_HDF5_MARK = b"\x89HDF\r\n\x1a\n"


@dataclass(frozen=True)
class _Piece:
    """Bytes of a file, with what an error says about them."""

    data: memoryview
    order: str
    path: Path
    offset: int  # in the file, of the variable they belong to

    def broken(self, why: str) -> DataError:
        return DataError(f"{why}, in the variable at byte {self.offset}", path=self.path)

    def element(self, at: int, wanted: tuple[int, ...], what: str) -> tuple[int, memoryview, int]:
        """The data element at ``at``: its type, its bytes, and where the next one begins."""
        if at + 8 > len(self.data):
            raise self.broken(f"truncated before its {what}")
        word, size = struct.unpack_from(f"{self.order}II", self.data, at)
        kind, small, begin = word, word >> 16, at + 8
        if small:  # up to four bytes stand in the tag itself
            kind, size, begin = word & 0xFFFF, small, at + 4
        if kind not in wanted:
            raise self.broken(f"its {what} have the data type {kind}, not {wanted[0]}")
        if small > 4 or begin + size > len(self.data):
            raise self.broken(f"its {what} take {size} bytes, more than there are")
        return kind, self.data[begin : begin + size], (begin + size + 7) // 8 * 8


def read_mat_array(path: Path | str, name: str) -> NDArray[np.float64]:
    """Read the array ``name`` of real numbers (MATLAB's double or single).

    Returns
    -------
    float64, of the shape it has in MATLAB.

    Raises
    ------
    DataError : missing, truncated, another format, no such variable, or it is no array of real
        numbers; names the file, and the byte where the variable begins.
    """
    path = Path(path)
    content = read_content(path, text=False)
    found = []
    for kind, stored in _variables(content, _byte_order(content, path), path):
        head = stored if kind == _MATRIX else _unpacked(stored, _HEAD_BYTES)
        own_name = _array_name(head)
        if own_name == name:
            return _array(stored if kind == _MATRIX else _unpacked(stored))
        found.append(own_name)
    names = ", ".join(map(repr, found[:5])) or "none"
    raise DataError(f"no variable {name!r}; it has {names}", path=path)


def _byte_order(content: bytes, path: Path) -> str:
    if _HDF5_MARK in (content[:8], content[512:520]) or content.startswith(b"MATLAB 7.3"):
        raise DataError(
            "a MATLAB 7.3 (HDF5) file; expected version 5 to 7: save it again with -v7", path=path
        )
    order = {b"IM": "<", b"MI": ">"}.get(content[_HEADER_BYTES - 2 : _HEADER_BYTES])
    if order is None:
        raise DataError("not a MATLAB file of version 5 to 7", path=path)
    return order


def _variables(content: bytes, order: str, path: Path) -> Iterator[tuple[int, _Piece]]:
    """The variables of a file as they are stored: _MATRIX or _COMPRESSED, and the bytes."""
    view, at = memoryview(content), _HEADER_BYTES
    while at < len(view):
        rest = _Piece(view[at:], order, path, at)
        if len(rest.data) < 8:
            raise rest.broken("truncated")
        kind, size = struct.unpack_from(f"{order}II", rest.data)
        if kind not in (_MATRIX, _COMPRESSED):
            raise rest.broken(f"data type {kind}, not an array")
        if 8 + size > len(rest.data):
            raise rest.broken(f"truncated: {size} bytes announced, {len(rest.data) - 8} there")
        yield kind, replace(rest, data=rest.data[8 : 8 + size])
        at += 8 + size


def _unpacked(stored: _Piece, limit: int | None = None) -> _Piece:
    """The array in a compressed element; with a limit, only so many bytes of its beginning."""
    stream = zlib.decompressobj()
    try:
        tag = stream.decompress(stored.data, 8)
        if len(tag) < 8:
            raise stored.broken("truncated")
        kind, size = struct.unpack(f"{stored.order}II", tag)
        if kind != _MATRIX:
            raise stored.broken(f"data type {kind}, not an array")
        if not 0 < size <= _MAX_RATIO * len(stored.data):
            raise stored.broken(f"{size} bytes announced, more than there can be")
        if limit is not None:
            return replace(
                stored, data=memoryview(stream.decompress(stream.unconsumed_tail, limit))
            )
        data = stream.decompress(stream.unconsumed_tail, size)
        more = stream.decompress(stream.unconsumed_tail, 1)  # reads the check sum at the end
    except zlib.error as error:
        raise stored.broken(f"cannot be unpacked ({error})") from error
    if len(data) != size or more:
        found = f"{len(data)} and more" if more else str(len(data))
        raise stored.broken(f"{size} bytes announced, {found} there")
    if not stream.eof:
        raise stored.broken("truncated")
    return replace(stored, data=memoryview(data))


def _array_name(variable: _Piece) -> str:
    _, _, at = variable.element(0, (_UINT32,), "flags")
    _, _, at = variable.element(at, (_INT32,), "dimensions")
    _, name, _ = variable.element(at, (_INT8,), "name")
    return bytes(name).decode("latin-1")


def _array(variable: _Piece) -> NDArray[np.float64]:
    order = variable.order
    _, flags, at = variable.element(0, (_UINT32,), "flags")
    if len(flags) != 8:
        raise variable.broken(f"its flags take {len(flags)} bytes, not 8")
    word = struct.unpack_from(f"{order}I", flags)[0]
    if word & 0xFF not in _REAL_CLASSES or word & _COMPLEX_FLAG:
        raise variable.broken(f"no array of real numbers (class {word & 0xFF})")
    _, dimensions, at = variable.element(at, (_INT32,), "dimensions")
    if len(dimensions) % 4 or not 2 <= len(dimensions) // 4 <= _MAX_DIMENSIONS:
        raise variable.broken(f"its dimensions take {len(dimensions)} bytes")
    shape = struct.unpack(f"{order}{len(dimensions) // 4}i", dimensions)
    _, _, at = variable.element(at, (_INT8,), "name")
    kind, numbers, _ = variable.element(at, tuple(_NUMBERS), "numbers")
    dtype = np.dtype(order + _NUMBERS[kind])
    if min(shape) < 0 or math.prod(shape) * dtype.itemsize != len(numbers):
        raise variable.broken(f"its {len(numbers)} bytes are not {shape} numbers")
    return np.frombuffer(numbers, dtype).astype(np.float64).reshape(shape, order="F")


def write_mat_arrays(path: Path | str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write real arrays as MATLAB's save does (v7, compressed), the same bytes each time.

    Raises
    ------
    ValueError : an array that is neither float64, float32 nor uint8, or has one dimension.
    OutputError : the file cannot be written.
    """
    content = b"MATLAB 5.0 MAT-file".ljust(_HEADER_BYTES - 12) + bytes(8) + b"\x00\x01IM"
    for name, array in arrays.items():
        packed = zlib.compress(_stored(name, array), _COMPRESSION)
        content += struct.pack("<II", _COMPRESSED, len(packed)) + packed
    write_bytes(path, content)


def _stored(name: str, array: NDArray[Any]) -> bytes:
    """The element of an array, with its tag."""
    kinds = {"float64": (6, 9), "float32": (7, 7), "uint8": (9, 2)}
    if array.dtype.name not in kinds or array.ndim < 2:
        raise ValueError(f"cannot write {name}: {array.dtype} of {array.ndim} dimensions")
    array_class, number = kinds[array.dtype.name]
    parts = (
        (_UINT32, struct.pack("<II", array_class, 0)),
        (_INT32, struct.pack(f"<{array.ndim}i", *array.shape)),
        (_INT8, name.encode("ascii")),
        (number, array.astype(array.dtype.newbyteorder("<")).tobytes(order="F")),
    )
    body = b"".join(
        struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8) for kind, data in parts
    )
    return struct.pack("<II", _MATRIX, len(body)) + body
