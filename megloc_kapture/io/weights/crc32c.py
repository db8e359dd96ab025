"""CRC-32C (Castagnoli), by which TensorFlow guards its checkpoints; zlib has another polynomial."""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.compiling import compiled_loop

_POLYNOMIAL = 0x82F63B78  # bits reversed (RFC 3720, section 12.1)


def _table() -> NDArray[np.uint32]:
    crc = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        crc = np.where(crc & 1, (crc >> 1) ^ np.uint32(_POLYNOMIAL), crc >> 1)
    return crc.astype(np.uint32)


_TABLE = _table()


@compiled_loop
def update(content):
    """The checksum of bytes, uint8 (N,)."""
    crc = np.uint32(0xFFFFFFFF)
    for byte in content:
        crc = _TABLE[(crc ^ byte) & np.uint32(0xFF)] ^ (crc >> np.uint32(8))
    return crc ^ np.uint32(0xFFFFFFFF)
