"""TensorFlow checkpoints, written without TensorFlow: what readers of them are tried on."""

from __future__ import annotations

import io
import struct
import tarfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.weights.tensorflow import crc32c

Arrays = Mapping[str, NDArray[np.float32]]

SHARD = ".data-00000-of-00001"


def write_tensorflow_checkpoint(path: Path, variables: Arrays) -> None:
    """Write ``X.index``, which is ``path``, and the data beside it."""
    index, data = tensorflow_checkpoint(variables)
    path.write_bytes(index)
    path.with_name(path.stem + SHARD).write_bytes(data)


def write_saved_model(path: Path, folder: str, variables: Arrays) -> None:
    """Write a SavedModel as it is published, ``X.tar.gz`` with one folder; its graph is none."""
    index, data = tensorflow_checkpoint(variables)
    members = {
        "saved_model.pb": b"graph",
        "variables/variables.index": index,
        f"variables/variables{SHARD}": data,
    }
    with tarfile.open(path, "w:gz", compresslevel=0) as archive:
        for name, content in members.items():
            member = tarfile.TarInfo(f"{folder}/{name}")
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))


def tensorflow_checkpoint(variables: Arrays) -> tuple[bytes, bytes]:
    """Index and data of a TensorFlow checkpoint: a sorted string table of one block.

    The format is that which :mod:`megloc_kapture.io.weights.tensorflow` describes; every key is
    written whole.
    """
    data, rows = io.BytesIO(), [(b"", b"\x08\x01")]
    for name in sorted(variables):
        content = variables[name].tobytes()
        dims = [b"\x08" + _varint(n) for n in variables[name].shape]
        shape = b"".join(b"\x12" + _varint(len(dim)) + dim for dim in dims)
        entry = b"\x08\x01\x12" + _varint(len(shape)) + shape
        entry += b"\x20" + _varint(data.tell()) + b"\x28" + _varint(len(content))
        rows.append((name.encode(), entry + b"\x35" + struct.pack("<I", _masked(content))))
        data.write(content)
    table = io.BytesIO()
    handle = _add_block(table, rows)
    footer = _add_block(table, []) + _add_block(table, [(b"\xff", handle)])
    end = footer.ljust(40, b"\0") + struct.pack("<Q", 0xDB4775248B80FB57)
    return table.getvalue() + end, data.getvalue()


def _add_block(table: io.BytesIO, rows: list[tuple[bytes, bytes]]) -> bytes:
    """Append a block with its trailer; its handle: where it lies, and how long it is."""
    block, restarts = b"", []
    for key, value in rows:
        restarts.append(len(block))
        block += b"\0" + _varint(len(key)) + _varint(len(value)) + key + value
    restarts = restarts or [0]
    block += struct.pack(f"<{len(restarts) + 1}I", *restarts, len(restarts))
    handle = _varint(table.tell()) + _varint(len(block))
    table.write(block + b"\0" + struct.pack("<I", _masked(block + b"\0")))
    return handle


def _varint(number: int) -> bytes:
    out = b""
    while number >= 0x80:
        out += bytes([number & 0x7F | 0x80])
        number >>= 7
    return out + bytes([number])


def _masked(content: bytes) -> int:
    crc = crc32c(content)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF
