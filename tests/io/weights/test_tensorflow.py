"""TensorFlow's checkpoints, as TensorFlow wrote them (tests/io/weights/data/tensor_bundle)."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights.tensorflow import (
    WireError,
    crc32c,
    fields,
    read_tensor_bundle,
    varint,
)

WRITTEN = Path(__file__).parent / "data" / "tensor_bundle"
FOOTER = struct.pack("<Q", 0xDB4775248B80FB57)


def ramp(shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """As data/tensor_bundle/make_bundles.py has it."""
    return (np.arange(int(np.prod(shape))) / 4 - 1).reshape(shape).astype(dtype)


def read(stem: str) -> dict[str, NDArray[Any]]:
    index = (WRITTEN / f"{stem}.index").read_bytes()
    return read_tensor_bundle(
        index, lambda ending: (WRITTEN / f"{stem}{ending}").read_bytes(), stem
    )


def coded(number: int) -> bytes:
    out = b""
    while number >= 0x80:
        out += bytes([number & 0x7F | 0x80])
        number >>= 7
    return out + bytes([number])


def masked(content: bytes) -> int:
    crc = crc32c(content)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def block(entries: Iterable[tuple[bytes, bytes]], restart_every: int = 16) -> bytes:
    """A block as the format's description has it: keys share what they can with the one before."""
    out, restarts, before = b"", [], b""
    for row, (key, value) in enumerate(entries):
        shared = 0
        if row % restart_every == 0:
            restarts.append(len(out))
        else:
            while shared < min(len(key), len(before)) and key[shared] == before[shared]:
                shared += 1
        out += coded(shared) + coded(len(key) - shared) + coded(len(value))
        out += key[shared:] + value
        before = key
    return out + struct.pack(f"<{len(restarts) + 1}I", *restarts, len(restarts))


def index_file(blocks: Iterable[bytes], compression: int = 0) -> bytes:
    """A table of blocks, each with its trailer, found through an index block and the footer."""

    def add(content: bytes) -> bytes:
        nonlocal out
        handle = coded(len(out)) + coded(len(content))
        kind = bytes([compression])
        out += content + kind + struct.pack("<I", masked(content + kind))
        return handle

    out = b""
    handles = [(bytes([255, row]), add(content)) for row, content in enumerate(blocks)]
    footer = add(block([])) + add(block(handles))
    return out + footer.ljust(40, b"\0") + FOOTER


def entry(dtype: int, shape: tuple[int, ...], offset: int, content: bytes) -> bytes:
    dims = b"".join(b"\x12" + coded(len(d)) + d for d in (b"\x08" + coded(n) for n in shape))
    place = b"\x20" + coded(offset) + b"\x28" + coded(len(content))
    kind = b"\x08" + coded(dtype) + b"\x12" + coded(len(dims)) + dims
    return kind + place + b"\x35" + struct.pack("<I", masked(content))


HEADER = (b"", b"\x08\x01")
ONE = np.float32(1).tobytes()


def small(value: bytes, *, header: bytes = HEADER[1]) -> bytes:
    """An index of one variable ``a``."""
    return index_file([block([(b"", header), (b"a", value)])])


def test_tf1_graph() -> None:
    found = read("graph.ckpt-7")
    truth: dict[str, NDArray[Any]] = {"conv0/kernel": ramp((3, 3, 1, 2), np.float32)}
    for layer in range(12):
        for kind in ("moving_mean", "moving_variance"):
            truth[f"conv{layer}/bn/{kind}"] = ramp((layer,), np.float32) + np.float32(layer)
    truth["tower/conv1/instance_max"] = np.float32(3.25)
    truth["global_step"] = np.int64(-7)
    for dtype in ("float64", "float16", "int32", "int16", "int8"):
        truth[f"kinds/{dtype}"] = ramp((2, 5), np.float64).astype(dtype)
    for dtype in ("uint8", "uint16", "uint32", "uint64"):
        truth[f"kinds/{dtype}"] = np.array([0, 1, np.iinfo(dtype).max], dtype)
    truth["kinds/bool"] = np.array([True, False, True])
    truth["kinds/bfloat16"] = np.array([1.5, -2.25], np.float32)
    assert found.keys() == truth.keys()  # the text is left out
    for name, values in truth.items():
        assert found[name].dtype == values.dtype, name
        np.testing.assert_array_equal(found[name], values, err_msg=name, strict=True)


def test_tf2_objects() -> None:
    found = read("object")
    ending = "/.ATTRIBUTES/VARIABLE_VALUE"
    assert set(found) == {
        f"model/{name}{ending}" for name in ("kernel", "empty", "parts/0", "parts/1", "parts/2")
    }
    np.testing.assert_array_equal(found[f"model/kernel{ending}"], ramp((2, 3), np.float32))
    assert found[f"model/empty{ending}"].shape == (0, 4)
    assert found[f"model/parts/2{ending}"] == 2
    with pytest.raises(DataError, match="sliced is stored in slices"):
        read("sliced")


@pytest.mark.parametrize("restart_every", [1, 3, 16])
def test_several_blocks_and_shared_beginnings(restart_every: int) -> None:
    truth = {
        f"layer_{n:03d}/{kind}": np.full(n % 3, n, np.float32)
        for n in range(40)
        for kind in ("bias", "kernel")
    }
    rows, content = [HEADER], b""
    for name, values in truth.items():
        rows.append((name.encode(), entry(1, values.shape, len(content), values.tobytes())))
        content += values.tobytes()
    blocks = [block(rows[at : at + 7], restart_every) for at in range(0, len(rows), 7)]
    found = read_tensor_bundle(index_file(blocks), lambda _: content, "x.index")
    assert list(found) == list(truth)
    for name, values in truth.items():
        np.testing.assert_array_equal(found[name], values)


def test_several_data_files() -> None:
    value = entry(1, (), 0, ONE) + b"\x18\x01"  # in the second of two
    asked = []

    def shard(ending: str) -> bytes:
        asked.append(ending)
        return ONE

    assert read_tensor_bundle(small(value, header=b"\x08\x02"), shard, "x.index") == {"a": 1}
    assert asked == [".data-00001-of-00002"]


BROKEN = {
    "empty": (b"", "does not end as an index"),
    "not a table": (b"x" * 100, "does not end as an index"),
    "snappy": (index_file([block([HEADER])], compression=1), "compressed with snappy"),
    "unknown compression": (index_file([block([HEADER])], compression=7), "compression 7"),
    "no header": (index_file([block([(b"a", entry(1, (), 0, ONE))])]), "no header"),
    "big-endian": (small(b"", header=b"\x08\x01\x10\x01"), "big-endian"),
    "text": (small(entry(8, (), 0, ONE)), "data type 8"),
    "wrong size": (small(entry(1, (3,), 0, ONE)), r"a of shape \[3\] has 4 bytes"),
    "beyond the data": (small(entry(1, (), 2, ONE)), "beyond the end of the data file"),
    "wrong checksum": (small(entry(1, (), 0, ONE)[:-1] + b"\0"), "the data file is damaged"),
    "no such part": (small(entry(1, (), 0, ONE) + b"\x18\x05"), "part 5 of 1"),
    "negative part": (small(entry(1, (), 0, ONE) + b"\x18" + b"\xff" * 9 + b"\x01"), "part -1"),
    "many dimensions": (small(entry(1, (1,) * 80, 0, ONE)), "cannot|dimension"),
    "huge and empty": (small(entry(1, (1 << 62, 1 << 62, 0), 0, b"")), "not a checkpoint"),
    "name": (index_file([block([HEADER, (b"\xff", entry(1, (), 0, ONE))])]), "not UTF-8"),
    "shares too much": (index_file([b"\x05\x00\x00" + bytes(4)]), "does not fit into its block"),
    "too many restarts": (index_file([b"\xff\xff\xff\xff"]), "restarts do not fit"),
}


@pytest.mark.parametrize(("index", "message"), BROKEN.values(), ids=BROKEN)
def test_what_is_wrong_is_named(index: bytes, message: str) -> None:
    with pytest.raises(DataError, match=rf"^x\.index: .*({message})"):
        read_tensor_bundle(index, lambda _: ONE, "x.index")


def test_every_damaged_byte_is_noticed() -> None:
    """All that is read is guarded by checksums; the footer says where things lie."""
    index = (WRITTEN / "object.index").read_bytes()
    data = (WRITTEN / "object.data-00000-of-00001").read_bytes()
    whole = read_tensor_bundle(index, lambda _: data, "x.index")
    unnoticed = []
    for at in range(len(index) - 48):
        broken = index[:at] + bytes([index[at] ^ 1]) + index[at + 1 :]
        with suppress(DataError):
            assert read_tensor_bundle(broken, lambda _: data, "x.index").keys() == whole.keys()
            unnoticed.append(at)
    # the empty block of meta data and its trailer, which are not read
    assert len(unnoticed) == 8 + 5
    numbers = sum(values.nbytes for values in whole.values())
    noticed = 0
    for at in range(len(data)):
        broken = data[:at] + bytes([data[at] ^ 128]) + data[at + 1 :]
        try:
            read_tensor_bundle(index, lambda _, content=broken: content, "x.index")
        except DataError:
            noticed += 1
    assert noticed == numbers


@given(st.binary(max_size=60), st.binary(max_size=40), st.booleans())
def test_any_bytes_behind_right_checksums_give_data_errors(
    content: bytes, data: bytes, whole: bool
) -> None:
    """Mutations of a whole file stop at its checksums; these go on to the parsers."""
    index = index_file([content]) if whole else small(content)
    with suppress(DataError):
        read_tensor_bundle(index, lambda _: data, "x.index")


def test_checksum_of_the_standard() -> None:
    # RFC 3720, appendix B.4, and the usual check value
    known = {bytes(32): 0x8A9136AA, b"\xff" * 32: 0x62A8AB43, bytes(range(32)): 0x46DD794E}
    for content, crc in (known | {b"123456789": 0xE3069283, b"": 0}).items():
        assert crc32c(content) == crc


INT64 = st.integers(-(1 << 63), (1 << 63) - 1)


@given(st.lists(INT64), st.text(), INT64, st.lists(st.floats(width=32, allow_nan=False)))
def test_reads_what_protobuf_writes(
    dims: list[int], name: str, number: int, floats: list[float]
) -> None:
    tensor = onnx.TensorProto(dims=dims, name=name, float_data=floats)
    attribute = onnx.AttributeProto(i=number, f=0.5, t=tensor)
    read = {field.number: field for field in fields(memoryview(attribute.SerializeToString()))}
    assert read[3].signed() == number
    assert read[2].signed() == 0x3F000000  # 0.5 as the bits of a float
    inner = list(fields(read[5].bytes()))
    assert [field.signed() for field in inner if field.number == 1] == dims
    assert [bytes(field.bytes()) for field in inner if field.number == 8] == [name.encode()]


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (b"\x80", "no number at byte 0"),
        (b"\x08" + b"\xff" * 9 + b"\x02", "no number at byte 1"),  # 65 bits
        (b"\x0a\x05abc", "5 bytes wanted at byte 2 of 5"),
        (b"\x0d\x00\x00", "4 bytes wanted"),
        (b"\x09\x00\x00", "8 bytes wanted"),
        (b"\x0b", "wire type 3"),
        (b"\x00\x00", "field number 0"),
        (b"\x08\x01", "field 1 is a number where bytes should be"),
    ],
)
def test_what_is_no_message(message: bytes, reason: str) -> None:
    with pytest.raises(WireError, match=reason):
        [field.bytes() for field in fields(memoryview(message))]


@given(st.integers(0, (1 << 64) - 1))
def test_varints(number: int) -> None:
    content = coded(number)
    assert varint(memoryview(b"\xff" + content + b"\xff"), 1) == (number, 1 + len(content))
