"""TensorFlow's checkpoints (``X.index`` and ``X.data-00000-of-00001``), without TensorFlow.

The index is a sorted string table: blocks of entries whose keys share prefixes with the one before,
each block followed by its compression and a masked CRC-32C, found through a footer and an index
block. Its first entry, with an empty key, describes the bundle; every other maps a variable's
name to type, shape and offset in the data file (tensor_bundle.proto). Variables of TF1 have the
names of the graph; those of object-based checkpoints end in ``/.ATTRIBUTES/VARIABLE_VALUE``.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.compiling import compiled_loop
from megloc_kapture.errors import DataError

_FOOTER_SIZE, _MAGIC = 48, 0xDB4775248B80FB57
_TRAILER_SIZE = 5
_SNAPPY = 1
_STRING, _BFLOAT16 = 7, 14
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # wire types of protocol buffers
_MAX_FIELD = (1 << 29) - 1
# types.proto: DataType to numpy
_TYPES: dict[int, str] = {
    1: "<f4",
    2: "<f8",
    3: "<i4",
    4: "<u1",
    5: "<i2",
    6: "<i1",
    9: "<i8",
    10: "<?",
    _BFLOAT16: "<u2",
    17: "<u2",
    19: "<f2",
    22: "<u4",
    23: "<u8",
}


@dataclass(frozen=True)
class _Entry:
    """BundleEntryProto: type, shape and bytes of a variable."""

    kind: int = 0
    shape: tuple[int, ...] = ()
    shard: int = 0
    offset: int = 0
    size: int = 0
    checksum: int = 0
    sliced: bool = False


def read_tensor_bundle(
    index: bytes, read_shard: Callable[[str], bytes], where: str
) -> dict[str, NDArray[Any]]:
    """All variables of a checkpoint by name, in the machine's byte order; texts are left out.

    bfloat16 becomes float32, which is exact.

    Parameters
    ----------
    index : content of the ``.index`` file.
    read_shard : the content of a data file by the end of its name, ``.data-00000-of-00001``.
    where : the ``.index`` file, for messages.

    Raises
    ------
    DataError : the files are broken (every block and every variable has a checksum), compressed,
        big-endian, or have variables in slices.
    """
    try:
        table = dict(_table_entries(memoryview(index)))
        shards = _number_of_shards(table.pop(b"", None))
        # names that begin with a NUL are those of slices; their variable's own entry says so too
        entries = {_name(k): _entry(v) for k, v in table.items() if not k.startswith(b"\0")}
        contents: dict[int, memoryview] = {}
        found = {}
        for name, entry in entries.items():
            if entry.kind == _STRING:
                continue
            if not 0 <= entry.shard < shards:
                raise WireError(f"{name} is in part {entry.shard} of {shards}")
            if entry.shard not in contents:
                ending = f".data-{entry.shard:05d}-of-{shards:05d}"
                contents[entry.shard] = memoryview(read_shard(ending))
            found[name] = _variable(name, entry, contents[entry.shard])
    except ValueError as error:  # WireError, and numpy's own refusals of a shape
        raise DataError(f"not a checkpoint that can be read: {error}", path=where) from error
    return found


def _table_entries(table: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    if len(table) < _FOOTER_SIZE or int.from_bytes(table[-8:], "little") != _MAGIC:
        raise WireError("it does not end as an index of TensorFlow does")
    _, at = _handle(table[-_FOOTER_SIZE:], 0)  # of the meta index, which is empty
    index, _ = _handle(table[-_FOOTER_SIZE:], at)
    for _, handle in _block_entries(_block(table, *index)):
        span, _ = _handle(handle, 0)
        yield from _block_entries(_block(table, *span))


def _handle(content: memoryview, at: int) -> tuple[tuple[int, int], int]:
    """Offset and size of a block, and the offset after them."""
    offset, at = varint(content, at)
    size, at = varint(content, at)
    return (offset, size), at


def _block(table: memoryview, offset: int, size: int) -> memoryview:
    end = offset + size
    if end + _TRAILER_SIZE > len(table) - _FOOTER_SIZE:
        raise WireError(f"a block of {size} bytes at byte {offset} of {len(table)}")
    compression = table[end]
    if _masked_crc(table[offset : end + 1]) != int.from_bytes(table[end + 1 : end + 5], "little"):
        raise WireError(f"the block at byte {offset} has another checksum: it is damaged")
    if compression == _SNAPPY:
        raise WireError(
            "its index is compressed with snappy; save it again with TensorFlow, which does not "
            "compress"
        )
    if compression:
        raise WireError(f"unknown compression {compression}")
    return table[offset:end]


def _block_entries(block: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    if len(block) < 4:
        raise WireError(f"a block of {len(block)} bytes")
    # at the end: where entries with whole keys begin, and how many of them there are
    end = len(block) - 4 - 4 * int.from_bytes(block[-4:], "little")
    if end < 0:
        raise WireError("a block whose restarts do not fit into it")
    at, key = 0, b""
    while at < end:
        shared, at = varint(block, at)
        unshared, at = varint(block, at)
        size, at = varint(block, at)
        if shared > len(key) or unshared + size > end - at:
            raise WireError("an entry that does not fit into its block")
        key = key[:shared] + bytes(block[at : at + unshared])
        yield key, block[at + unshared : at + unshared + size]
        at += unshared + size


def _number_of_shards(header: memoryview | None) -> int:
    """BundleHeaderProto: num_shards 1, endianness 2."""
    if header is None:
        raise WireError("it has no header")
    shards = 0
    for part in fields(header):
        if part.number == 1:
            shards = part.signed()
        elif part.number == 2 and part.signed():
            raise WireError("it was written on a big-endian machine")
    return shards


def _entry(message: memoryview) -> _Entry:
    """BundleEntryProto: dtype 1, shape 2, shard_id 3, offset 4, size 5, crc32c 6, slices 7."""
    found: dict[str, Any] = {}
    numbers = {1: "kind", 3: "shard", 4: "offset", 5: "size", 6: "checksum"}
    for part in fields(message):
        if part.number == 2:
            found["shape"] = tuple(_shape(part.bytes()))
        elif part.number == 7:
            found["sliced"] = True
        elif part.number in numbers:
            found[numbers[part.number]] = part.signed()
    return _Entry(**found)


def _shape(message: memoryview) -> Iterator[int]:
    """TensorShapeProto: dim 2, of which size 1."""
    for dim in fields(message):
        if dim.number == 2:
            sizes = [part.signed() for part in fields(dim.bytes()) if part.number == 1]
            yield sizes[-1] if sizes else 0


def _variable(name: str, entry: _Entry, shard: memoryview) -> NDArray[Any]:
    if entry.sliced:
        raise WireError(f"{name} is stored in slices, which is not supported")
    if entry.kind not in _TYPES:
        raise WireError(f"{name} has data type {entry.kind}, which is not supported")
    dtype = np.dtype(_TYPES[entry.kind])
    if any(n < 0 for n in entry.shape) or entry.size != math.prod(entry.shape) * dtype.itemsize:
        raise WireError(f"{name} of shape {list(entry.shape)} has {entry.size} bytes")
    if entry.offset < 0 or entry.offset + entry.size > len(shard):
        raise WireError(f"{name} lies beyond the end of the data file: is it cut short?")
    content = shard[entry.offset : entry.offset + entry.size]
    if _masked_crc(content) != entry.checksum:
        raise WireError(f"{name} has another checksum: the data file is damaged")
    values = np.frombuffer(content, dtype).reshape(entry.shape)
    if entry.kind == _BFLOAT16:
        return (values.astype(np.uint32) << 16).view(np.float32)
    return values.astype(dtype.newbyteorder("="))


def _masked_crc(content: memoryview) -> int:
    """CRC-32C, rotated and shifted so that checksums of checksums mean something."""
    crc = crc32c(content)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def _name(key: bytes) -> str:
    try:
        return key.decode()
    except UnicodeDecodeError as error:
        raise WireError(f"a variable's name that is not UTF-8: {key!r}") from error


# -------------------------------------------------------------------- protocol buffers, CRC-32C


class WireError(ValueError):
    """The bytes are no such message or table; becomes a DataError that names the file."""


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message: bytes for wire type 2, else an unsigned number."""

    number: int
    value: int | memoryview

    def signed(self) -> int:
        """An int32 or int64: negative numbers are stored as 64 bits in two's complement."""
        if isinstance(self.value, memoryview):
            raise WireError(f"field {self.number} is bytes where a number should be")
        return self.value - (1 << 64) if self.value >> 63 else self.value

    def bytes(self) -> memoryview:
        """Bytes; raises WireError for a number."""
        if not isinstance(self.value, memoryview):
            raise WireError(f"field {self.number} is a number where bytes should be")
        return self.value


def fields(message: memoryview) -> Iterator[Field]:
    """The fields of a message in their order (protobuf.dev, "Encoding"); raises WireError.

    Groups, which nobody has written since 2008, are refused.
    """
    at = 0
    while at < len(message):
        key, at = varint(message, at)
        number, kind = key >> 3, key & 7
        if not 0 < number <= _MAX_FIELD:
            raise WireError(f"field number {number}")
        if kind == _VARINT:
            value, at = varint(message, at)
            yield Field(number, value)
        elif kind in (_FIXED64, _BYTES, _FIXED32):
            size = 8 if kind == _FIXED64 else 4
            if kind == _BYTES:
                size, at = varint(message, at)
            if size > len(message) - at:
                raise WireError(f"{size} bytes wanted at byte {at} of {len(message)}")
            part, at = message[at : at + size], at + size
            yield Field(number, part if kind == _BYTES else int.from_bytes(part, "little"))
        else:
            raise WireError(f"wire type {kind}")


def varint(message: memoryview, at: int) -> tuple[int, int]:
    """The number of at most 64 bits that starts at an offset, and the offset after it."""
    number = shift = 0
    for offset in range(at, min(at + 10, len(message))):
        number |= (message[offset] & 0x7F) << shift
        if message[offset] < 0x80:
            if number >> 64:
                break
            return number, offset + 1
        shift += 7
    raise WireError(f"no number at byte {at}")


def crc32c(content: bytes | memoryview) -> int:
    """CRC-32C (Castagnoli) of some bytes; zlib's checksum has another polynomial."""
    return int(_crc32c(np.frombuffer(content, np.uint8)))


def _crc32c_table() -> NDArray[np.uint32]:
    crc = np.arange(256, dtype=np.uint32)
    for _ in range(8):  # the polynomial's bits reversed (RFC 3720, section 12.1)
        crc = np.where(crc & 1, (crc >> 1) ^ np.uint32(0x82F63B78), crc >> 1)
    return crc.astype(np.uint32)


_CRC32C_TABLE = _crc32c_table()


@compiled_loop
def _crc32c(content):
    crc = np.uint32(0xFFFFFFFF)
    for byte in content:
        crc = _CRC32C_TABLE[(crc ^ byte) & np.uint32(0xFF)] ^ (crc >> np.uint32(8))
    return crc ^ np.uint32(0xFFFFFFFF)
