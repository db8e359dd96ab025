"""The wire format, against messages that the package onnx (Google's protobuf) encodes."""

from __future__ import annotations

from contextlib import suppress

import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.io.protobuf_wire import WireError, fields, signed, varint

INT64 = st.integers(-(1 << 63), (1 << 63) - 1)


@given(st.lists(INT64), st.text(), INT64, st.lists(st.floats(width=32, allow_nan=False)))
def test_reads_what_protobuf_writes(
    dims: list[int], name: str, number: int, floats: list[float]
) -> None:
    tensor = onnx.TensorProto(dims=dims, name=name, float_data=floats)
    attribute = onnx.AttributeProto(i=number, f=0.5, t=tensor)
    read = {field.number: field for field in fields(memoryview(attribute.SerializeToString()))}
    assert read[3].signed() == number
    assert read[2].integer() == 0x3F000000  # 0.5 as the bits of a float
    inner = list(fields(read[5].bytes()))
    assert [signed(n) for field in inner if field.number == 1 for n in field.integers()] == dims
    assert [bytes(field.bytes()) for field in inner if field.number == 8] == [name.encode()]


def test_repeated_numbers_may_be_packed_or_not() -> None:
    packed, single = b"\x0a\x03\x01\xac\x02", b"\x08\x01\x08\xac\x02"
    for message in (packed, single):
        assert [n for f in fields(memoryview(message)) for n in f.integers()] == [1, 300]


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (b"\x80", "no number at byte 0"),
        (b"\x08" + b"\xff" * 10 + b"\x01", "no number at byte 1"),
        (b"\x08" + b"\xff" * 9 + b"\x02", "no number at byte 1"),  # 65 bits
        (b"\x0a\x05abc", "5 bytes wanted at byte 2 of 5"),
        (b"\x0d\x00\x00", "4 bytes wanted"),
        (b"\x09\x00\x00", "8 bytes wanted"),
        (b"\x0b", "wire type 3"),
        (b"\x00\x00", "field number 0"),
    ],
)
def test_what_is_no_message(message: bytes, reason: str) -> None:
    with pytest.raises(WireError, match=reason):
        list(fields(memoryview(message)))


def test_a_field_of_another_kind() -> None:
    number, text = fields(memoryview(b"\x08\x01\x12\x01a"))
    with pytest.raises(WireError, match="field 1 is a number where bytes should be"):
        number.bytes()
    with pytest.raises(WireError, match="field 2 is bytes where a number should be"):
        text.integer()


@given(st.binary())
def test_any_bytes_end_or_are_refused(content: bytes) -> None:
    with suppress(WireError):
        for field in fields(memoryview(content)):
            field.integers()


@given(st.integers(0, (1 << 64) - 1))
def test_varints(number: int) -> None:
    coded = b""
    rest = number
    while rest >= 128:
        coded += bytes([rest % 128 + 128])
        rest //= 128
    coded += bytes([rest])
    assert varint(memoryview(b"\xff" + coded + b"\xff"), 1) == (number, 1 + len(coded))
