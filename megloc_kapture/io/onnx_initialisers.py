"""The initialisers of an ONNX file, by name: its weights, without the package onnx.

Field numbers are those of onnx.proto3 (ModelProto.graph 7, GraphProto.initializer 5, TensorProto).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.protobuf_wire import (
    BYTES,
    FIXED32,
    FIXED64,
    Field,
    WireError,
    fields,
    signed,
)

_GRAPH = 7
_INITIALIZER, _SPARSE_INITIALIZER = 5, 15
_DIMS, _DATA_TYPE, _NAME, _RAW, _DATA_LOCATION = 1, 2, 8, 9, 14
_FLOATS, _INT32S, _INT64S, _DOUBLES, _UINT64S = 4, 5, 7, 10, 11

_BFLOAT16 = 16
# TensorProto.DataType: numpy type, and the field that holds values outside raw_data
_TYPES: dict[int, tuple[str, int]] = {
    1: ("<f4", _FLOATS),
    2: ("<u1", _INT32S),
    3: ("<i1", _INT32S),
    4: ("<u2", _INT32S),
    5: ("<i2", _INT32S),
    6: ("<i4", _INT32S),
    7: ("<i8", _INT64S),
    9: ("<?", _INT32S),
    10: ("<f2", _INT32S),
    11: ("<f8", _DOUBLES),
    12: ("<u4", _UINT64S),
    13: ("<u8", _UINT64S),
    _BFLOAT16: ("<u2", _INT32S),
}
# these are kept as the numbers that their bits make
_BITS = {10: "<u2", _BFLOAT16: "<u2"}


def read_initialisers(content: bytes, where: str) -> dict[str, NDArray[Any]]:
    """All initialisers of a model, by name; bfloat16 becomes float32, which is exact.

    Parameters
    ----------
    where : the file, for messages.

    Raises
    ------
    DataError : not an ONNX model, or one whose weights lie elsewhere or are of a kind that
        weights are not (text, sparse).
    """
    found: dict[str, NDArray[Any]] = {}
    graphs = 0
    try:
        for part in fields(memoryview(content)):
            if part.number != _GRAPH:
                continue
            graphs += 1
            for item in fields(part.bytes()):
                if item.number == _SPARSE_INITIALIZER:
                    raise WireError("sparse initialisers are not supported")
                if item.number == _INITIALIZER:
                    name, values = _tensor(item.bytes())
                    if name in found:
                        raise WireError(f"two initialisers {name!r}")
                    found[name] = values
    except ValueError as error:  # WireError, and numpy's own refusals of a shape
        raise DataError(f"not an ONNX file that can be read: {error}", path=where) from error
    if not graphs:
        raise DataError("not an ONNX file that can be read: no graph in it", path=where)
    return found


def _tensor(message: memoryview) -> tuple[str, NDArray[Any]]:
    shape: list[int] = []
    name, kind = "", 0
    raw: memoryview | None = None
    stored: dict[int, list[Field]] = {}
    for field in fields(message):
        if field.number == _DIMS:
            shape += map(signed, field.integers())
        elif field.number == _DATA_TYPE:
            kind = field.integer()
        elif field.number == _NAME:
            name = _text(field)
        elif field.number == _RAW:
            raw = field.bytes()
        elif field.number == _DATA_LOCATION and field.integer():
            raise WireError(f"the weights {name!r} lie in another file")
        else:
            stored.setdefault(field.number, []).append(field)
    if kind not in _TYPES:
        raise WireError(f"initialiser {name!r} has data type {kind}, which is not supported")
    dtype, place = _TYPES[kind]
    dtype = _BITS.get(kind, dtype)
    if raw is not None:
        if len(raw) % np.dtype(dtype).itemsize:
            raise WireError(f"initialiser {name!r} has {len(raw)} bytes")
        values = np.frombuffer(raw, dtype)
    else:
        values = _values(stored.get(place, []), place, dtype)
    if any(size < 0 for size in shape) or math.prod(shape) != len(values):
        raise WireError(f"initialiser {name!r} of shape {shape} has {len(values)} values")
    return name, _widened(values, kind).reshape(shape)


def _values(stored: list[Field], place: int, dtype: str) -> NDArray[Any]:
    if place in (_FLOATS, _DOUBLES):
        size = np.dtype(dtype).itemsize
        single = FIXED32 if size == 4 else FIXED64
        if any(field.kind not in (BYTES, single) for field in stored):
            raise WireError("a number of another size than its data type's")
        whole = b"".join(
            field.integer().to_bytes(size, "little") if field.kind == single else field.bytes()
            for field in stored
        )
        return np.frombuffer(whole, dtype)
    numbers = [number for field in stored for number in field.integers()]
    if dtype not in ("<u4", "<u8") and dtype not in _BITS.values():
        numbers = list(map(signed, numbers))
    try:
        return np.array(numbers, dtype=dtype)
    except OverflowError as error:
        raise WireError(f"a number that does not fit: {error}") from error


def _widened(values: NDArray[Any], kind: int) -> NDArray[Any]:
    """A copy in the machine's own byte order, bits turned into the numbers they mean."""
    if kind == _BFLOAT16:
        return (values.astype(np.uint32) << 16).view(np.float32)
    values = values.view(_TYPES[kind][0])
    return values.astype(values.dtype.newbyteorder("="))


def _text(field: Field) -> str:
    try:
        return bytes(field.bytes()).decode()
    except UnicodeDecodeError as error:
        raise WireError("a name that is not UTF-8") from error
