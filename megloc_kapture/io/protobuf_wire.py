"""The wire format of protocol buffers, as far as two containers of weights need it.

A message is a sequence of fields: a varint of field number and wire type, then the value
(protobuf.dev, "Encoding"). Groups, which nobody has written since 2008, are refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
_MAX_FIELD = (1 << 29) - 1


class WireError(ValueError):
    """The bytes are no message; what reads a file makes a DataError of it."""


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message; ``value`` is bytes for wire type 2, else an unsigned number."""

    number: int
    kind: int
    value: int | memoryview

    def integer(self) -> int:
        """A number, unsigned; raises WireError for bytes."""
        if isinstance(self.value, memoryview):
            raise WireError(f"field {self.number} is bytes where a number should be")
        return self.value

    def signed(self) -> int:
        """An int32 or int64: negative numbers are stored as 64 bits in two's complement."""
        return signed(self.integer())

    def bytes(self) -> memoryview:
        """Bytes; raises WireError for a number."""
        if not isinstance(self.value, memoryview):
            raise WireError(f"field {self.number} is a number where bytes should be")
        return self.value

    def integers(self) -> list[int]:
        """The unsigned numbers of a repeated field: one, or several packed into bytes."""
        if not isinstance(self.value, memoryview):
            return [self.value]
        numbers, at = [], 0
        while at < len(self.value):
            number, at = varint(self.value, at)
            numbers.append(number)
        return numbers


def fields(message: memoryview) -> Iterator[Field]:
    """The fields of a message in the order they stand in it; raises WireError."""
    at = 0
    while at < len(message):
        key, at = varint(message, at)
        number, kind = key >> 3, key & 7
        if not 0 < number <= _MAX_FIELD:
            raise WireError(f"field number {number}")
        value: int | memoryview
        if kind == VARINT:
            value, at = varint(message, at)
        elif kind in (FIXED64, FIXED32):
            size = 8 if kind == FIXED64 else 4
            value, at = int.from_bytes(_take(message, at, size), "little"), at + size
        elif kind == BYTES:
            size, at = varint(message, at)
            value, at = _take(message, at, size), at + size
        else:
            raise WireError(f"wire type {kind}")
        yield Field(number, kind, value)


def varint(message: memoryview, at: int) -> tuple[int, int]:
    """The number of at most 64 bits that starts at a place, and the place after it."""
    number = shift = 0
    for place in range(at, min(at + 10, len(message))):
        number |= (message[place] & 0x7F) << shift
        if message[place] < 0x80:
            if number >> 64:
                break
            return number, place + 1
        shift += 7
    raise WireError(f"no number at byte {at}")


def signed(number: int) -> int:
    """A number of 64 bits as two's complement."""
    return number - (1 << 64) if number >> 63 else number


def _take(message: memoryview, at: int, size: int) -> memoryview:
    if size > len(message) - at:
        raise WireError(f"{size} bytes wanted at byte {at} of {len(message)}")
    return message[at : at + size]
